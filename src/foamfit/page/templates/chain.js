// The chain beside its loop, at an instant that is chosen or played.
export function render({ model, el }) {
  const draw = (parent, tag, given, text = "") => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(given)) made.setAttribute(name, value);
    made.textContent = text;
    parent.append(made);
    return made;
  };
  const BASE = 132, TALL = 112, LEFT = 118, WIDE = 180; // of the drawing
  const svg = draw(el, "svg", { viewBox: "0 0 310 150", role: "img", "aria-label": "The chain and its loop" });
  const springs = draw(svg, "g", {}), striker = draw(svg, "rect", { x: 14, width: 62, height: 6, class: "steel" });
  draw(svg, "rect", { x: 8, y: BASE, width: 74, height: 4, class: "steel" });
  draw(svg, "path", { d: `M${LEFT} 16V${BASE}H${LEFT + WIDE}`, class: "axes" });
  draw(svg, "text", { x: LEFT - 5, y: 10 }, "stress");
  draw(svg, "text", { x: LEFT + WIDE, y: BASE + 13, "text-anchor": "end" }, "strain");
  const loop = draw(svg, "path", { class: "loop" }), point = draw(svg, "circle", { r: 4.5 });
  const side = document.createElement("div"), play = document.createElement("button");
  const slider = document.createElement("input"), told = document.createElement("p");
  Object.assign(slider, { type: "range", min: 0, step: 1, ariaLabel: "instant along the loop" });
  side.append(play, slider, told);
  el.append(side);
  let cells = [], places = [], timer = 0, fresh = true;

  function show() {
    const { strain, stress, unit, heights, snapped, ...of } = model.frames, i = slider.valueAsNumber;
    let top = BASE;
    cells.forEach(([cell, coil], k) => {
      const tall = TALL * heights[k][i], part = tall / 8;
      top -= tall;
      cell.setAttribute("y", top);
      cell.setAttribute("height", tall);
      cell.setAttribute("fill-opacity", 0.06 + 0.84 * (snapped[k][i] || 0));
      const turns = [30, -30, 30, -30, 30, -30].map((dx, j) => `L${45 + dx * 0.7} ${top + (j + 1.5) * part}`);
      coil.setAttribute("d", `M45 ${top}V${top + part}${turns.join("")}L45 ${top + 7 * part}V${top + tall}`);
    });
    striker.setAttribute("y", Math.min(top, BASE - TALL * of.top[i]) - 6);
    point.setAttribute("cx", places[i][0]);
    point.setAttribute("cy", places[i][1]);
    const name = (k) => (snapped.length > 1 ? `s${k + 1} ` : "");
    const shares = snapped.map((one, k) => `${name(k)}${Math.round(100 * one[i])} %`);
    const some = shares.filter((_, k) => Number.isFinite(snapped[k][i])).join(", ");
    told.textContent = `strain ${(100 * strain[i]).toFixed(1)} %, ${stress[i].toPrecision(3)} ${unit}` + (some && `; snapped ${some}`);
    slider.setAttribute("aria-valuetext", told.textContent);
  }
  function build() {
    const { strain, stress, heights } = model.frames;
    el.style.visibility = strain ? "" : "hidden";
    if (!strain) return stop();
    const scale = (values, from, long) => {
      const low = Math.min(...values, 0), wide = Math.max(...values) - low || 1;
      return values.map((value) => Math.round(10 * (from + long * (value - low) / wide)) / 10);
    };
    const x = scale(strain, LEFT + 4, WIDE - 8), y = scale(stress, BASE - 4, 24 - BASE);
    places = x.map((one, i) => [one, y[i]]);
    loop.setAttribute("d", `M${places.join("L")}`);
    if (cells.length !== heights.length) {
      springs.replaceChildren();
      cells = heights.map(() => [draw(springs, "rect", { x: 18, width: 54, class: "cell" }), draw(springs, "path", { class: "coil" })]);
    }
    slider.max = strain.length - 1;
    if (fresh) slider.value = strain.indexOf(Math.max(...strain));
    show();
  }
  function stop() {
    clearInterval(timer);
    timer = 0;
    play.textContent = "Play";
  }
  play.addEventListener("click", () => {
    if (timer) return stop();
    if (fresh || slider.value === slider.max) slider.value = 0;
    fresh = false;
    play.textContent = "Pause";
    timer = setInterval(() => {
      slider.stepUp();
      show();
      if (slider.value === slider.max) stop();
    }, 50);
  });
  slider.addEventListener("input", () => { fresh = false; stop(); show(); });
  model.on("frames", build);
  model.on("remove", stop);
  stop();
  build();
}
