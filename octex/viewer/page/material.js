// The channels that strokes and fills paint, each with its value. See octex/session/material.py.

import { element, make } from "./elements.js";
import { MATERIALS } from "./programs.js";
import { section } from "./panel.js";

const BASE = "base_color";
// Channels that can be added: name, explanation, and the value that is painted at first.
const KNOWN = {
  metallic: ["Metal", "0: no metal, 1: metal", 1],
  roughness: ["Roughness", "0: like a mirror, 1: matte", 0.3],
  emissive: ["Glow", "light that the surface emits", [255, 200, 120]],
  height: ["Height", "0.5: as the model is, 0: deeper, 1: higher", 1],
  occlusion: ["Occlusion", "1: open, 0: hidden from light, like hollows", 0.5],
  specular: ["Reflection", "colour of the reflection where there is no metal", [56, 56, 56]],
};

export const toHex = (color) => `#${color.map((code) => Math.round(code).toString(16).padStart(2, "0")).join("")}`;
export const fromHex = (text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16));
const toCode = (light) => 255 * Math.min(Math.max(light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055, 0), 1);
const isColor = ({ space, components }) => components === 3 && (space === "srgb" || space === "linear");
const textOf = (name) => (name === BASE ? "Colour" : (KNOWN[name]?.[0] ?? name[0].toUpperCase() + name.slice(1).replaceAll("_", " ")));

export class Material {
  constructor(painting) {
    const { header } = painting.viewer.parts[0];
    this.painting = painting;
    this.channels = header.channels.filter((channel) => channel.name !== "alpha" && (isColor(channel) || (channel.space === "data" && channel.components === 1)));
    for (const channel of this.channels) this.values[channel.name] ??= KNOWN[channel.name]?.[2] ?? (isColor(channel) ? [128, 128, 128] : 1);
    const missing = Object.keys(KNOWN).filter((name) => !header.channels.some((channel) => channel.name === name));
    const add = make("select", { id: "add-channel", "aria-label": "Add a channel", oninput: ({ target }) => this.add(target.value) },
      new Option("Add…", ""), ...missing.map((name) => new Option(`${textOf(name)} (${KNOWN[name][1]})`, name)));
    this.section = section("material", "Material", ...this.channels.map((channel) => this.row(channel)), ...(missing.length ? [add] : []));
    this.section.append(element("relief-label"), element("relief"));
    this.section.open = this.painted.some((name) => name !== BASE);
  }

  row(channel) {
    const { name } = channel, title = KNOWN[name]?.[1] ?? "", attributes = { id: `value-${name}`, "aria-label": textOf(name), title };
    const set = (value) => this.set(name, value);
    const tick = make("input", { type: "checkbox", id: `paints-${name}`, oninput: ({ target }) => this.tick(name, target.checked) });
    const value = name === BASE ? make("span", { ...attributes, class: "swatch" })
      : isColor(channel) ? make("input", { type: "color", ...attributes, oninput: ({ target }) => set(fromHex(target.value)) })
      : make("input", { type: "range", min: 0, max: 1, step: 0.01, ...attributes, oninput: ({ target }) => set(Number(target.value)) });
    return make("div", { class: "row" }, make("label", { class: "check", title }, tick, textOf(name)), value, make("output", { id: `value-${name}-text`, for: attributes.id }));
  }

  // The names of the ticked channels that the texture has.
  get painted() {
    return this.painting.brush.channels.filter((name) => this.channels.some((channel) => channel.name === name));
  }

  get values() {
    return this.painting.brush.values;
  }

  // The fields of strokes and fills: `color` of the base colour, `values` of other channels.
  get paint() {
    const { painted } = this, others = painted.filter((name) => name !== BASE), { color } = this.painting.brush;
    const values = Object.fromEntries(others.map((name) => [name, [this.values[name]].flat()]));
    return { color: painted.includes(BASE) ? color : undefined, values: others.length ? values : undefined };
  }

  tick(name, isTicked) {
    const { brush } = this.painting;
    brush.channels = brush.channels.filter((each) => each !== name).concat(isTicked ? [name] : []);
    this.painting.set({});
    if (!this.isVisible) this.showPainted();
  }

  set(name, value) {
    this.values[name] = value;
    this.painting.set({});
    if (!this.painted.includes(name)) this.tick(name, true);
  }

  // Take the values of ticked channels from a place of the surface; see pick.js.
  takeValues(picked) {
    for (const { name, range: [low, high], values } of picked) {
      const channel = this.painted.includes(name) && this.channels.find((each) => each.name === name);
      if (!channel) continue;
      const scaled = values.map((value) => low + (high - low) * value);
      if (name === BASE) this.painting.set({ color: scaled.map(toCode) });
      else this.values[name] = isColor(channel) ? scaled.map(toCode) : scaled[0];
    }
    this.painting.set({});
  }

  add(channel) {
    const { commands, brush } = this.painting;
    brush.channels.push(channel);
    commands.send({ kind: "channel", name: `Add ${textOf(channel).toLowerCase()}`, channel });
  }

  // Whether the display mode shows a channel.
  isShown(name) {
    const { mode, channel } = this.painting.viewer.display;
    return mode === "channel" ? name === channel : mode === "lit" ? MATERIALS.includes(name) : mode === "unlit" && [BASE, "emissive"].includes(name);
  }

  // Whether the display mode shows some of the paint.
  get isVisible() {
    return this.painted.some((name) => this.isShown(name));
  }

  // Choose a display mode that shows the paint: studio light, or a channel that light does not show.
  showPainted() {
    const { painted } = this, mode = element("mode");
    if (!painted.length) return;
    mode.value = painted.some((name) => MATERIALS.includes(name)) ? "lit" : `channel ${painted[0]}`;
    mode.dispatchEvent(new Event("input"));
  }

  // The reason why nothing can be painted, or "".
  get blockReason() {
    const { mode, channel, cubes } = this.painting.viewer.display;
    if (!this.painted.length) return "Tick under Material what to paint.";
    if (this.isVisible && !cubes) return "";
    const isOffered = mode === "channel" && !cubes && this.channels.some((each) => each.name === channel);
    return isOffered ? `Tick ${textOf(channel)} under Material to paint it.` : "Show the colours of the surface to paint.";
  }

  show() {
    for (const { name } of this.channels) {
      const control = element(`value-${name}`), value = name === BASE ? this.painting.brush.color : this.values[name];
      element(`paints-${name}`).checked = this.painted.includes(name);
      if (name === BASE) control.style.background = toHex(value);
      else control.value = Array.isArray(value) ? toHex(value) : value;
      element(`value-${name}-text`).textContent = Array.isArray(value) ? "" : value.toFixed(2);
    }
  }
}
