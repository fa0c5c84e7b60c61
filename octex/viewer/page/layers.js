// The list of layers, and the settings of the active one. The server has their paint; see octex/painting/layers.py.

import { element, make } from "./elements.js";
import { BLENDS, check, choice, icon, iconButton, percent, section, slider } from "./panel.js";

export class Layers {
  constructor(painting) {
    this.painting = painting;
    this.stack = []; // from the lowest to the highest
    this.active = null; // the number of the layer to paint; null: the texture itself
    this.mask = false; // paint the active layer's mask
    this.expected = null; // the command whose new layer becomes active
  }

  build() {
    const set = (name, text) => (value) => this.send("set", text, { [name]: value });
    const opacity = slider("layer-opacity", "Opacity", { min: 0, max: 1, step: 0.01 }, (value) => (element("layer-opacity-text").textContent = percent(value)));
    opacity[1].addEventListener("change", ({ target }) => set("opacity", "Opacity of a layer")(Number(target.value)));
    const rename = ({ target }) => (target.value.trim() ? set("title", "Rename a layer")(target.value.trim()) : this.show());
    return section("layers", "Layers",
      make("div", { class: "bar" },
        iconButton("layer-add", "more", "Add a layer above", () => this.sendNew("add", "Add a layer")),
        iconButton("layer-up", "up", "Move the layer up", () => this.move(1)),
        iconButton("layer-down", "down", "Move the layer down", () => this.move(-1)),
        iconButton("layer-copy", "copy", "Duplicate the layer", () => this.sendNew("copy", "Copy a layer")),
        iconButton("layer-merge", "merge", "Merge down", () => this.sendNew("merge", "Merge layers")),
        iconButton("layer-delete", "remove", "Delete the layer", () => this.send("delete", "Delete a layer"))),
      make("ul", { id: "stack" }),
      make("div", { id: "layer" },
        make("label", { for: "layer-title" }, "Name"),
        make("input", { type: "text", id: "layer-title", maxlength: 40, onchange: rename }),
        ...opacity,
        ...choice("layer-blend", "Blend mode", BLENDS, set("blend", "Blend mode of a layer")),
        check("layer-mask", "layer mask", set("hasMask", "Mask of a layer")),
        check("layer-masked", "paint the mask: the brush shows, the eraser hides", (mask) => this.select(this.active, mask))));
  }

  // The active layer; undefined for the texture itself.
  get layer() {
    return this.stack.find(({ number }) => number === this.active);
  }

  // The fields of commands that paint.
  get target() {
    return this.active === null ? {} : { layer: this.active, mask: this.mask };
  }

  // The reason why nothing can be painted, or "".
  get blockReason() {
    return this.layer?.isVisible === false ? "This layer is hidden: show it to paint on it." : "";
  }

  select(number, mask = false) {
    this.active = number;
    this.mask = mask && Boolean(this.layer?.hasMask);
    this.painting.preview.load();
    this.show();
  }

  send(action, name, fields = {}) {
    return this.painting.commands.send({ kind: "layer", name, action, ...(this.active === null ? {} : { layer: this.active }), ...fields });
  }

  // Send an action that makes a layer, which becomes active.
  sendNew(action, name) {
    this.expected = this.send(action, name);
  }

  move(by) {
    this.send("move", "Move a layer", { place: this.stack.indexOf(this.layer) + by });
  }

  // Show the server's layers. `finished` is the number of this page's last finished command.
  setStack(stack, finished) {
    const known = new Set(this.stack.map(({ number }) => number)), added = stack.find(({ number }) => !known.has(number));
    this.stack = stack;
    if (added && this.expected) {
      this.active = added.number;
      this.mask = false;
    }
    if (this.expected?.number <= finished) this.expected = null;
    if (!this.layer) this.active = null;
    this.mask &&= Boolean(this.layer?.hasMask);
    if (stack.length && !this.hasOpened) this.hasOpened = element("layers").open = true;
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

  // The row of a layer, or of the texture itself.
  row(layer) {
    const number = layer?.number ?? null, isVisible = layer?.isVisible ?? true, title = layer?.title ?? "Texture", action = isVisible ? "Hide" : "Show";
    const toggle = () => this.painting.commands.send({ kind: "layer", name: `${action} a layer`, action: "set", layer: number, isVisible: !isVisible });
    const eyeAttributes = { type: "button", class: "eye", title: action, "aria-label": `${action} ${title}`, disabled: !layer, onclick: toggle };
    const eye = make("button", eyeAttributes, icon(isVisible ? "visible" : "hidden"));
    const blending = layer ? [layer.blend === "over" ? "" : layer.blend, layer.opacity < 1 ? percent(layer.opacity) : ""].filter(Boolean).join(", ") : "";
    const nameAttributes = { type: "button", class: "name", "aria-current": number === this.active ? "true" : false, onclick: () => this.select(number) };
    const name = make("button", nameAttributes, title, make("small", {}, blending));
    return make("li", { class: isVisible ? "" : "unseen" }, eye, name);
  }
}
