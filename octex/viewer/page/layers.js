// Layers: the list of them, what the chosen one is set to, and the eraser. The server has the paint; see layers.py.

import { BrushDrag } from "./brush.js";
import { element, make } from "./elements.js";
import { BLENDS, ICONS, act, check, choice, icon, percent, section, slider } from "./panel.js";

Object.assign(ICONS, {
  eraser: "M15.6 3.2a2 2 0 0 0-2.8 0L3.2 12.8a2 2 0 0 0 0 2.8L7.6 20H21v-2.2h-7.2l7-7a2 2 0 0 0 0-2.8zM8.5 17.8l-3.7-3.6 4-4 4.5 4.5-3.1 3.1z",
  up: "m12 5 7 7-1.7 1.7-4.1-4.1V19h-2.4V9.6l-4.1 4.1L5 12z",
  down: "m12 19-7-7 1.7-1.7 4.1 4.1V5h2.4v9.4l4.1-4.1L19 12z",
  copy: "M8 3h12v14H8zm2.2 2.2v9.6h7.6V5.2zM4 7h2.2v11.8H16V21H4z",
  merge: "M4 4h16v2.2H4zm0 13.8h16V20H4zM10.8 7.5h2.4v4.6l2-2L16.9 11.8 12 16.6 7.1 11.8l1.7-1.7 2 2z",
  remove: "M9 3h6l1 2h4v2.2H4V5h4zM5.5 8.6h13L17.6 21H6.4zm4 2.2v8h1.6v-8zm3.4 0v8h1.6v-8z",
  seen: "M12 5C6.5 5 2.7 9.4 1.5 12c1.2 2.6 5 7 10.5 7s9.3-4.4 10.5-7C21.3 9.4 17.5 5 12 5zm0 2.2c3.8 0 6.7 2.8 8 4.8-1.3 2-4.2 4.8-8 4.8S5.3 14 4 12c1.3-2 4.2-4.8 8-4.8zm0 1.6a3.2 3.2 0 1 0 0 6.4 3.2 3.2 0 0 0 0-6.4z",
  hidden: "m3.5 2.5-1.5 1.5 4 4C3.7 9.3 2.2 11 1.5 12c1.2 2.6 5 7 10.5 7 1.7 0 3.2-.4 4.5-1l4 4 1.5-1.5zM12 16.8c-3.8 0-6.7-2.8-8-4.8.700-1.1 1.9-2.4 3.5-3.4l1.7 1.7A3.2 3.2 0 0 0 13.6 15l1.2 1.2c-.9.4-1.8.600-2.8.600zM12 5c5.5 0 9.3 4.4 10.5 7-.5 1.1-1.5 2.5-2.9 3.8L18 14.2c.9-.7 1.5-1.5 2-2.2-1.3-2-4.2-4.8-8-4.8-.6 0-1.1.100-1.7.200L8.5 5.6A11 11 0 0 1 12 5z",
});

export const eraser = { name: "eraser", text: "Eraser", key: "e", hasRing: true, down: (painting, event) => new BrushDrag(painting, event, { name: "Eraser", erases: true }) };

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
