// Exports files to download: the painted texture, or the model with it. See octex/viewer/downloads.py.

import { element, make } from "./elements.js";
import { button, check, choice, section } from "./panel.js";

const KINDS = [
  ["glb", ".glb: model with images"],
  ["vertices", ".glb: coloured vertices"],
  ["ply", ".ply: coloured vertices"],
  ["octex", ".octex: texture"],
  ["octz", ".octz: texture, small file"],
  ["html", ".html: page to look at"],
];
const UVS = [["auto", "the model’s, or new ones"], ["keep", "the model’s"], ["atlas", "new ones"]];
const SIZES = [["auto", "as fine as the texture"], ...["512", "1024", "2048", "4096", "8192"].map((size) => [size, `${size} pixels`])];
const STAGES = { unwrap: "Unwrapping", bake: "Baking images", pack: "Packing", write: "Writing" };
const OPTIONS = { glb: "export-images", vertices: "export-vertices", ply: "export-vertices" }; // elements with options of a kind
const POLL = 50; // milliseconds between checks whether all strokes are painted

export class Exporting {
  constructor(painting) {
    this.painting = painting;
    this.events = null; // the server's event stream while a file is made
    this.wanted = { kind: "glb", uv: "auto", size: "auto", divide: "yes" };
  }

  get section() {
    const set = (name) => (value) => this.set({ [name]: value });
    const divide = check("export-divide", "more vertices where the colours need them", (on) => this.set({ divide: on ? "yes" : "no" }));
    divide.firstChild.checked = true;
    return section("export", "Export",
      ...choice("export-kind", "File", KINDS, set("kind")),
      make("div", { id: "export-images" }, ...choice("export-uv", "UVs", UVS, set("uv")), ...choice("export-size", "Images", SIZES, set("size"))),
      make("div", { id: "export-vertices", hidden: true }, divide),
      make("div", { class: "buttons" }, button("export-begin", "Export", () => (this.events ? this.end("Cancelled.") : this.begin()))),
      make("progress", { id: "export-progress", max: 1, hidden: true }),
      make("p", { id: "export-note", role: "status" }));
  }

  set(change) {
    Object.assign(this.wanted, change);
    for (const id of Object.values(OPTIONS)) element(id).hidden = id !== OPTIONS[this.wanted.kind];
  }

  // Export a file when the texture has all strokes of this page. The user can paint meanwhile.
  async begin() {
    const waiting = (this.events = { close() {} }); // the user may cancel from now on
    while (this.events === waiting && this.painting.isBusy) {
      this.showProgress("Waiting for your strokes");
      await new Promise((resume) => setTimeout(resume, POLL));
    }
    if (this.events !== waiting) return;
    this.showProgress("Starting");
    const events = (this.events = new EventSource(`export?${new URLSearchParams(this.wanted)}`));
    const on = (name, run) => events.addEventListener(name, ({ data }) => run(data && JSON.parse(data)));
    on("progress", ({ stage, share }) => this.showProgress(STAGES[stage] ?? "Working", share));
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
  exportCopy() {
    if (this.events) return;
    element("export").open = true;
    element("export").scrollIntoView({ block: "nearest" });
    element("export-kind").value = "octex";
    this.set({ kind: "octex" });
    this.begin();
  }

  showProgress(text, share = null) {
    const bar = element("export-progress");
    element("export-begin").textContent = "Cancel";
    element("export-note").textContent = `${text} …`;
    element("export-note").classList.remove("bad");
    bar.hidden = false;
    if (share > 0) bar.value = share;
    else bar.removeAttribute("value");
  }

  // Show the server's questions about changed files, with their answers: of the saved texture, and of the opened one.
  showQuestions({ output, opened }) {
    const box = element("question"), { commands } = this.painting, name = "Take the file’s version", key = output + opened;
    const answer = (id, text, title, run) => Object.assign(button(id, text, run), { title });
    const take = (file) => answer(`take-${file}`, "Take the file’s", "Undo brings back what is painted here.", () => commands.send({ kind: "take", name, file }));
    box.hidden = !key;
    if (!key || this.asked === key) return void (this.asked = key);
    this.asked = key;
    const ask = (question, ...answers) => (question ? [make("span", {}, question), make("div", { class: "buttons" }, ...answers)] : []);
    box.replaceChildren(
      ...ask(output,
        answer("replace", "Keep what is painted here", "The other version stays beside it, under another name.", () => commands.send({ kind: "save", replace: true })),
        take("output"), button("copy", "Download a copy of mine", () => this.exportCopy())),
      ...ask(opened, answer("keep", "Keep what is painted here", "The file stays as it is.", () => commands.send({ kind: "keep" })), take("opened")));
    box.scrollIntoView({ block: "nearest" });
  }

  // End or cancel: the server stops its work when the event stream closes.
  end(text, isBad = false) {
    this.events?.close();
    this.events = null;
    element("export-begin").textContent = "Export";
    element("export-progress").hidden = true;
    element("export-note").textContent = text;
    element("export-note").classList.toggle("bad", isBad);
  }
}
