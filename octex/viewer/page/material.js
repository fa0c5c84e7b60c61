// What is painted: one or several of the texture's channels, each with a value of its own. See material.py.

import { element, make } from "./elements.js";
import { MATERIALS } from "./programs.js";
import { section } from "./panel.js";

const BASE = "base_color";
// Channels that can be added: what they are called, what they do, and what they are painted with at first.
const KNOWN = {
  metallic: ["Metal", "0: no metal, 1: metal", 1],
  roughness: ["Roughness", "0: like a mirror, 1: matte", 0.3],
  emissive: ["Glow", "light of its own", [255, 200, 120]],
  height: ["Height", "0.5: as the model is, 0: deeper, 1: higher", 1],
  occlusion: ["Occlusion", "1: open, 0: hidden from light, like hollows", 0.5],
  specular: ["Reflection", "what surface without metal reflects", [56, 56, 56]],
};

export const toHex = (color) => `#${color.map((code) => Math.round(code).toString(16).padStart(2, "0")).join("")}`;
export const fromHex = (text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16));
const toCode = (light) => 255 * Math.min(Math.max(light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055, 0), 1);
const isColor = ({ space, components }) => components === 3 && (space === "srgb" || space === "linear");
const nameOf = (name) => (name === BASE ? "Colour" : (KNOWN[name]?.[0] ?? name[0].toUpperCase() + name.slice(1).replaceAll("_", " ")));

export class Material {
  constructor(painting) {
    const { header } = painting.viewer.parts[0];
    this.painting = painting;
    this.channels = header.channels.filter((each) => each.name !== "alpha" && (isColor(each) || (each.space === "data" && each.components === 1)));
    for (const each of this.channels) this.values[each.name] ??= KNOWN[each.name]?.[2] ?? (isColor(each) ? [128, 128, 128] : 1);
    const missing = Object.keys(KNOWN).filter((name) => !header.channels.some((each) => each.name === name));
    const add = make("select", { id: "add-channel", "aria-label": "Add a channel", oninput: ({ target }) => this.add(target.value) },
      new Option("Add…", ""), ...missing.map((name) => new Option(`${nameOf(name)} (${KNOWN[name][1]})`, name)));
    this.section = section("material", "Material", ...this.channels.map((each) => this.row(each)), ...(missing.length ? [add] : []));
    this.section.append(element("relief-label"), element("relief"));
    this.section.open = this.ticked.some((name) => name !== BASE);
  }

  row(channel) {
    const { name } = channel, about = KNOWN[name]?.[1] ?? "", control = { id: `value-${name}`, "aria-label": nameOf(name), title: about };
    const set = (value) => this.set(name, value);
    const tick = make("input", { type: "checkbox", id: `paints-${name}`, oninput: ({ target }) => this.tick(name, target.checked) });
    const value = name === BASE ? make("span", { ...control, class: "swatch" })
      : isColor(channel) ? make("input", { type: "color", ...control, oninput: ({ target }) => set(fromHex(target.value)) })
      : make("input", { type: "range", min: 0, max: 1, step: 0.01, ...control, oninput: ({ target }) => set(Number(target.value)) });
    return make("div", { class: "row" }, make("label", { class: "check", title: about }, tick, nameOf(name)), value, make("output", { id: `value-${name}-text`, for: control.id }));
  }

  get ticked() {
    return this.painting.brush.ticked.filter((name) => this.channels.some((each) => each.name === name));
  }

  get values() {
    return this.painting.brush.values;
  }

  // What strokes and fills are painted with.
  get paint() {
    const { ticked } = this, others = ticked.filter((name) => name !== BASE), { color } = this.painting.brush;
    const values = Object.fromEntries(others.map((name) => [name, [this.values[name]].flat()]));
    return { color: ticked.includes(BASE) ? color : undefined, values: others.length ? values : undefined };
  }

  tick(name, is) {
    const { brush } = this.painting;
    brush.ticked = brush.ticked.filter((each) => each !== name).concat(is ? [name] : []);
    this.painting.set({});
    if (!this.isSeen) this.lookAt();
  }

  set(name, value) {
    this.values[name] = value;
    this.painting.set({});
    if (!this.ticked.includes(name)) this.tick(name, true);
  }

  // Take what a place of the surface has of all that is ticked.
  take(channels) {
    for (const { name, range: [low, high], values } of channels) {
      const channel = this.ticked.includes(name) && this.channels.find((each) => each.name === name);
      if (!channel) continue;
      const found = values.map((value) => low + (high - low) * value);
      if (name === BASE) this.painting.set({ color: found.map(toCode) });
      else this.values[name] = isColor(channel) ? found.map(toCode) : found[0];
    }
    this.painting.set({});
  }

  add(channel) {
    const { sending, brush } = this.painting;
    brush.ticked.push(channel);
    sending.send({ kind: "channel", name: `Add ${nameOf(channel).toLowerCase()}`, channel });
  }

  isShown(name) {
    const { shown, channel } = this.painting.viewer.look;
    return shown === "channel" ? name === channel : shown === "lit" ? MATERIALS.includes(name) : shown === "unlit" && [BASE, "emissive"].includes(name);
  }

  // Whether some of what is painted is seen.
  get isSeen() {
    return this.ticked.some((name) => this.isShown(name));
  }

  // Show what is painted: in the light, or the channel that is not seen there.
  lookAt() {
    const { ticked } = this, shown = element("shown");
    if (!ticked.length) return;
    shown.value = ticked.some((name) => MATERIALS.includes(name)) ? "lit" : `channel ${ticked[0]}`;
    shown.dispatchEvent(new Event("input"));
  }

  // Why nothing can be painted on what is shown; or nothing.
  get hindrance() {
    const { shown, channel, cubes } = this.painting.viewer.look;
    if (!this.ticked.length) return "Tick under Material what to paint.";
    if (this.isSeen && !cubes) return "";
    const isOffered = shown === "channel" && !cubes && this.channels.some((each) => each.name === channel);
    return isOffered ? `Tick ${nameOf(channel)} under Material to paint it.` : "Show the colours of the surface to paint.";
  }

  show() {
    for (const { name } of this.channels) {
      const at = element(`value-${name}`), value = name === BASE ? this.painting.brush.color : this.values[name];
      element(`paints-${name}`).checked = this.ticked.includes(name);
      if (name === BASE) at.style.background = toHex(value);
      else at.value = Array.isArray(value) ? toHex(value) : value;
      element(`value-${name}-text`).textContent = Array.isArray(value) ? "" : value.toFixed(2);
    }
  }
}
