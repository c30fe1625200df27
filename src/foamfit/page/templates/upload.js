// A file that is dropped or chosen is sent to the page's own address; the answer is shown as text.
export function render({ model, el }) {
  const zone = document.createElement("div");
  zone.className = "zone";
  const label = document.createElement("label");
  label.textContent = "Drop a CSV here (and its TOML), or choose them";
  label.htmlFor = "file";
  const input = document.createElement("input");
  Object.assign(input, { type: "file", id: "file", multiple: true });
  input.accept = ".csv,.txt,.tsv,.dat,.gz,.xlsx,.toml";
  const told = document.createElement("p");
  told.setAttribute("role", "status");
  zone.append(label, input, told);
  el.append(zone);

  async function send(files) {
    // The table last: it is read as soon as it is there.
    const sorted = [...files].sort((a, b) => b.name.endsWith(".toml") - a.name.endsWith(".toml"));
    let received = 0;
    for (const file of sorted) {
      told.className = "";
      told.textContent = `reading ${file.name} …`;
      if (file.size > model.limit) {
        told.className = "error";
        told.textContent = `${file.name} is larger than ${model.limit / 2 ** 20} MB, the limit of the page; use foamfit fit in a terminal.`;
        continue;
      }
      try {
        const answer = await fetch(`${model.address}?name=${encodeURIComponent(file.name)}`, {
          method: "POST", body: file, headers: { "Content-Type": "application/octet-stream" },
        });
        told.textContent = await answer.text();
        if (answer.ok) received += 1; else told.className = "error";
      } catch {
        told.className = "error";
        told.textContent = "The page is not running any more; start foamfit page again.";
      }
    }
    input.value = "";
    if (received) model.send_msg({ received });
  }
  input.addEventListener("change", () => send(input.files));
  // Anywhere on the page: beside the zone the browser would leave the page for the file.
  const files = (e) => e.dataTransfer?.types.includes("Files");
  for (const kind of ["dragenter", "dragover"])
    document.addEventListener(kind, (e) => {
      if (!files(e)) return;
      e.preventDefault();
      zone.classList.add("over");
    });
  document.addEventListener("dragleave", (e) => {
    if (!e.relatedTarget) zone.classList.remove("over");
  });
  document.addEventListener("drop", (e) => {
    if (!files(e)) return;
    e.preventDefault();
    zone.classList.remove("over");
    send(e.dataTransfer.files);
  });
}
