// Files to download: the texture as it is painted, or the model with it. See downloads.py.

import { element, make } from "./elements.js";
import { check, choice, section } from "./panel.js";

const KINDS = [
  ["glb", ".glb: model with images"],
  ["vertices", ".glb: coloured vertices"],
  ["ply", ".ply: coloured vertices"],
  ["octex", ".octex: texture"],
  ["octz", ".octz: texture, small file"],
  ["html", ".html: page to look at"],
];
const COORDINATES = [["auto", "the model’s, or new ones"], ["keep", "the model’s"], ["atlas", "new ones"]];
const SIZES = [["auto", "as fine as the texture"], ...["512", "1024", "2048", "4096", "8192"].map((size) => [size, `${size} pixels`])];
const STAGES = { unwrap: "Laying out", bake: "Painting images", pack: "Packing", write: "Writing" };
const OPTIONS = { glb: "export-images", vertices: "export-vertices", ply: "export-vertices" };

export class Exporting {
  constructor(painting) {
    this.painting = painting;
    this.events = null; // while a file is made
    this.wanted = { kind: "glb", uv: "auto", size: "auto", divide: "yes" };
  }

  // The controls of it.
  get section() {
    const set = (name) => (value) => this.set({ [name]: value });
    const divide = check("export-divide", "more vertices where the colours need them", (on) => this.set({ divide: on ? "yes" : "no" }));
    divide.firstChild.checked = true;
    return section("export", "Export",
      ...choice("export-kind", "File", KINDS, set("kind")),
      make("div", { id: "export-images" }, ...choice("export-uv", "UVs", COORDINATES, set("uv")), ...choice("export-size", "Images", SIZES, set("size"))),
      make("div", { id: "export-vertices", hidden: true }, divide),
      make("div", { class: "buttons" }, make("button", { type: "button", id: "export-begin", onclick: () => (this.events ? this.end("Cancelled.") : this.begin()) }, "Export")),
      make("progress", { id: "export-progress", max: 1, hidden: true }),
      make("p", { id: "export-note", role: "status" }));
  }

  set(change) {
    Object.assign(this.wanted, change);
    for (const id of Object.values(OPTIONS)) element(id).hidden = id !== OPTIONS[this.wanted.kind];
  }

  // Make a file once all that was painted here is in the texture. Painting goes on meanwhile.
  async begin() {
    this.events = { close() {} }; // it may be cancelled from now on
    const waits = this.events;
    while (this.events === waits && this.painting.isBusy) {
      this.show("Waiting for your strokes");
      await new Promise((resume) => setTimeout(resume, 50));
    }
    if (this.events !== waits) return;
    this.show("Starting");
    const events = (this.events = new EventSource(`export?${new URLSearchParams(this.wanted)}`));
    const on = (name, run) => events.addEventListener(name, ({ data }) => run(data && JSON.parse(data)));
    on("progress", ({ stage, share }) => this.show(STAGES[stage] ?? "Working", share));
    on("fault", ({ why }) => this.end(`Not exported: ${why}`, true));
    on("error", () => this.end("Not exported: the connection is lost.", true));
    on("done", ({ number, name, bytes }) => {
      this.end(`${name}, ${(bytes / 1e6).toLocaleString("en", { maximumSignificantDigits: 2 })} MB`);
      const link = make("a", { href: `export/${number}`, download: name });
      document.body.append(link);
      link.click();
      link.remove();
    });
  }

  // Download a copy of the texture.
  copy() {
    if (this.events) return;
    element("export").open = true;
    element("export-kind").value = "octex";
    this.set({ kind: "octex" });
    this.begin();
  }

  show(text, share = null) {
    const bar = element("export-progress");
    element("export-begin").textContent = "Cancel";
    element("export-note").textContent = `${text} …`;
    element("export-note").classList.remove("bad");
    bar.hidden = false;
    if (share > 0) bar.value = share;
    else bar.removeAttribute("value");
  }

  // Ask what a save could not decide: a question of the server's, or none.
  ask(question) {
    const box = element("question"), { sending } = this.painting;
    box.hidden = !question;
    if (!question || box.firstChild?.textContent === question) return;
    const answer = (text, id, run) => make("button", { type: "button", id, onclick: run }, text);
    const replace = answer("Replace it", "replace", () => sending.send({ kind: "save", replace: true }));
    const copy = answer("Keep it, download a copy", "copy", () => this.copy());
    box.replaceChildren(make("span", {}, question), make("div", { class: "buttons" }, replace, copy));
  }

  // No file is made any more; closing the line stops what the server does for it.
  end(text, isBad = false) {
    this.events?.close();
    this.events = null;
    element("export-begin").textContent = "Export";
    element("export-progress").hidden = true;
    element("export-note").textContent = text;
    element("export-note").classList.toggle("bad", isBad);
  }
}
