// A slider and a number for each parameter. One move is under way at a time; the last one waits.
export function render({ model, el }) {
  const list = document.createElement("div");
  list.className = "list";
  const told = document.createElement("p");
  told.setAttribute("role", "status");
  const key = document.createElement("p");
  key.className = "key";
  key.innerHTML = '<i class="interval"></i> 95 % interval of the fit <span><i class="range"></i> its range</span>';
  el.append(told, list, key);
  let inputs = {}, waiting = {}, busy = false;
  const STEPS = 1000;
  const digits = (value) => Number(value.toPrecision(5));

  function flush() {
    if (busy || !Object.keys(waiting).length) return;
    busy = true;
    model.send_msg({ moves: waiting });
    waiting = {};
  }
  function move(name, value) {
    waiting[name] = value;
    flush();
  }
  function place(row, value) {
    return Math.round(STEPS * Math.min(Math.max((value - row.low) / (row.high - row.low), 0), 1));
  }
  function show(values) {
    for (const [name, value] of Object.entries(values)) {
      const own = inputs[name];
      if (!own) continue;
      own.slider.value = place(own.row, value);
      own.slider.setAttribute("aria-valuetext", `${digits(value)} ${own.row.unit}`);
      own.number.value = digits(value);
    }
  }
  function build() {
    list.replaceChildren();
    [inputs, waiting, busy] = [{}, {}, false];
    key.hidden = !model.rows.some((row) => row.interval || row.range);
    key.lastChild.hidden = !model.rows.some((row) => row.range);
    for (const row of model.rows) {
      const line = document.createElement("div");
      line.className = "row";
      const label = document.createElement("label");
      const slider = document.createElement("input"), track = document.createElement("div");
      const number = document.createElement("input");
      const unit = document.createElement("span");
      label.textContent = row.name;
      label.htmlFor = slider.id = `slider-${row.name}`;
      Object.assign(slider, { type: "range", min: 0, max: STEPS, step: 1 });
      Object.assign(number, { type: "number", step: "any" });
      number.setAttribute("aria-label", `${row.name} as a number${row.unit ? ", " + row.unit : ""}`);
      unit.textContent = row.unit;
      slider.addEventListener("input", () => {
        const value = row.low + (row.high - row.low) * slider.value / STEPS;
        number.value = digits(value);
        slider.setAttribute("aria-valuetext", `${digits(value)} ${row.unit}`);
        move(row.name, value);
      });
      // As it is typed, for JupyterLab keeps Enter to itself; put right once it has been.
      number.addEventListener("input", () => {
        const value = number.valueAsNumber;
        if (!(value >= row.least && value <= row.most)) return;
        slider.value = place(row, value);
        move(row.name, value);
      });
      number.addEventListener("change", () => {
        const value = Math.min(Math.max(number.valueAsNumber, row.least), row.most);
        if (!Number.isFinite(value)) return;
        show({ [row.name]: value });
        move(row.name, value);
      });
      // The range of the fit below its interval.
      track.className = "track";
      track.append(slider);
      for (const kind of ["range", "interval"]) {
        if (!row[kind]) continue;
        const bar = document.createElement("i"), [from, to] = row[kind].map((end) => place(row, end));
        bar.className = kind;
        // The middle of the thumb goes from half its width, 1rem, to as far from the other end.
        const along = (part) => `(100% - 1rem) * ${part / STEPS}`;
        Object.assign(bar.style, { left: `calc(.5rem + ${along(from)})`, width: `calc(${along(to - from)})` });
        track.append(bar);
        track.title += `${kind} ${row[kind].map(digits).join(" to ")} ${row.unit}  `;
      }
      inputs[row.name] = { row, slider, number };
      // Whether a fit holds it where it stands.
      const held = document.createElement("label"), box = document.createElement("input");
      held.className = "held";
      Object.assign(box, { type: "checkbox", checked: row.held });
      box.setAttribute("aria-label", `${row.name} fixed in the fit`);
      box.addEventListener("change", () => model.send_msg({ held: { [row.name]: box.checked } }));
      held.append(box, "fixed");
      line.append(label, track, number, unit, held);
      list.append(line);
    }
    show(Object.fromEntries(model.rows.map((row) => [row.name, row.value])));
  }
  function tell() {
    told.textContent = model.told;
    told.className = model.wrong ? "told error" : "told";
  }
  function wait() {
    list.inert = model.waiting;
  }
  function tick() {
    list.className = model.ticks ? "list ticks" : "list";
  }
  model.on("rows", build);
  model.on("ticks", tick);
  model.on("waiting", wait);
  model.on(["told", "wrong"], tell);
  model.on("msg:custom", (told) => {
    if (told.values) show(told.values);
    if (told.drawn) { busy = false; flush(); }
  });
  build();
  tell();
  tick();
  wait();
}
