// Layers: the list of them, and what the chosen one is set to. The server has the paint; see layers.py.

import { element, make } from "./elements.js";
import { BLENDS, act, check, choice, icon, percent, section, slider } from "./panel.js";

export class Layers {
  constructor(painting) {
    this.painting = painting;
    this.stack = []; // from the lowest to the highest, as the server tells
    this.chosen = null; // a layer's number; null: the texture itself
    this.mask = false; // whether the chosen layer's mask is painted
    this.wanted = 0; // layers that were asked for and are to be chosen
  }

  build() {
    const set = (name, text) => (value) => this.send("set", text, { [name]: value }), part = { min: 0, max: 1, step: 0.01 };
    const opacity = slider("layer-opacity", "Opacity", part, (value) => (element("layer-opacity-text").textContent = percent(value)));
    opacity[1].addEventListener("change", ({ target }) => set("opacity", "Opacity of a layer")(Number(target.value)));
    const title = make("input", { type: "text", id: "layer-title", maxlength: 40, onchange: ({ target }) => (target.value.trim() ? set("title", "Rename a layer")(target.value.trim()) : this.show()) });
    return section("layers", "Layers",
      make("div", { class: "bar" },
        act("layer-add", "more", "Add a layer above", () => this.make("add", "Add a layer")),
        act("layer-up", "up", "Move the layer up", () => this.move(1)),
        act("layer-down", "down", "Move the layer down", () => this.move(-1)),
        act("layer-copy", "copy", "Copy the layer", () => this.make("copy", "Copy a layer")),
        act("layer-merge", "merge", "Merge with the layer below", () => this.make("merge", "Merge layers")),
        act("layer-delete", "remove", "Delete the layer", () => this.send("delete", "Delete a layer"))),
      make("ul", { id: "stack" }),
      make("div", { id: "layer" },
        make("label", { for: "layer-title" }, "Name"), title,
        ...opacity,
        ...choice("layer-blend", "Blend mode", BLENDS, set("blend", "Blend mode of a layer")),
        check("layer-mask", "has a mask", set("hasMask", "Mask of a layer")),
        check("layer-masked", "paint the mask: the brush shows, the eraser hides", (mask) => this.choose(this.chosen, mask))));
  }

  get layer() {
    return this.stack.find(({ number }) => number === this.chosen);
  }

  // What commands that paint name.
  get target() {
    return this.chosen === null ? {} : { layer: this.chosen, mask: this.mask };
  }

  // Why nothing can be painted; or nothing.
  get hindrance() {
    return this.layer?.isVisible === false ? "This layer is hidden: show it to paint on it." : "";
  }

  choose(number, mask = false) {
    this.chosen = number;
    this.mask = mask && Boolean(this.layer?.hasMask);
    this.painting.beneath.ask();
    this.show();
  }

  send(action, name, more = {}) {
    this.painting.sending.send({ kind: "layer", name, action, ...(this.chosen === null ? {} : { layer: this.chosen }), ...more });
  }

  make(action, name) {
    this.wanted += 1;
    this.send(action, name);
  }

  move(by) {
    this.send("move", "Move a layer", { place: this.stack.indexOf(this.layer) + by });
  }

  // The server has told of the stack as it is now.
  arrived(stack = []) {
    const known = new Set(this.stack.map(({ number }) => number)), fresh = stack.find(({ number }) => !known.has(number));
    this.stack = stack;
    if (fresh && this.wanted) {
      this.wanted -= 1;
      this.chosen = fresh.number;
      this.mask = false;
    }
    if (!this.layer) this.chosen = null;
    this.mask &&= Boolean(this.layer?.hasMask);
    if (stack.length) element("layers").open ||= !this.wasOpened;
    this.wasOpened ||= stack.length > 0;
    this.show();
  }

  show() {
    const { stack, layer } = this, place = stack.indexOf(layer);
    element("stack").replaceChildren(...[...stack].reverse().map((each) => this.row(each)), this.row(null));
    element("layer").hidden = !layer;
    for (const id of ["layer-up", "layer-down", "layer-copy", "layer-merge", "layer-delete"]) element(id).disabled = !layer;
    if (!layer) return;
    element("layer-up").disabled = place === stack.length - 1;
    element("layer-down").disabled = place === 0;
    element("layer-merge").disabled = place === 0 || [layer, stack[place - 1]].some(({ isVisible, blend }) => !isVisible || blend !== "over");
    element("layer-title").value = layer.title;
    element("layer-opacity").value = layer.opacity;
    element("layer-opacity-text").textContent = percent(layer.opacity);
    element("layer-blend").value = layer.blend;
    element("layer-mask").checked = layer.hasMask;
    element("layer-masked").checked = this.mask;
    element("layer-masked").parentElement.hidden = !layer.hasMask;
  }

  row(layer) {
    const number = layer?.number ?? null, isSeen = layer?.isVisible ?? true, title = layer?.title ?? "Texture";
    const eye = make("button", { type: "button", class: "eye", title: isSeen ? "Hide" : "Show", "aria-label": `${isSeen ? "Hide" : "Show"} ${title}`, disabled: !layer, onclick: () => this.painting.sending.send({ kind: "layer", name: isSeen ? "Hide a layer" : "Show a layer", action: "set", layer: number, isVisible: !isSeen }) }, icon(isSeen ? "seen" : "hidden"));
    const name = make("button", { type: "button", class: "name", "aria-current": number === this.chosen ? "true" : false, onclick: () => this.choose(number) }, title);
    const how = layer ? [layer.blend === "over" ? "" : layer.blend, layer.opacity < 1 ? percent(layer.opacity) : ""].filter(Boolean).join(", ") : "";
    name.append(make("small", {}, how));
    return make("li", { class: isSeen ? "" : "unseen" }, eye, name);
  }
}
