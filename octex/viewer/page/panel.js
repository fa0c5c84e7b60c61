// Icons, and controls with labels.

import { make } from "./elements.js";

// Paths of icons, 24 × 24.
const ICONS = {
  brush: "M20.7 3.3a2 2 0 0 0-2.8 0l-9 9 2.8 2.8 9-9a2 2 0 0 0 0-2.8zM7.5 13.7c-2 0-3.3 1.5-3.3 3.3 0 1.4-.8 2.2-2 2.5.9 1 2.3 1.6 3.8 1.6 2.6 0 4.7-1.8 4.7-4.2 0-1.8-1.4-3.2-3.2-3.2z",
  pick: "M20.5 3.5a2.6 2.6 0 0 0-3.7 0l-2.6 2.6-1.1-1.1-1.6 1.6 1.2 1.2L5 15.4 4 20l4.6-1 7.6-7.7 1.2 1.2 1.6-1.6-1.1-1.1 2.6-2.6a2.6 2.6 0 0 0 0-3.7zM7.7 17.3l-1.5.4.4-1.5 6.9-7 1.2 1.2z",
  fill: "M11 2.6 9.6 4l2 2-7 7a1.5 1.5 0 0 0 0 2.1l5.3 5.3c.6.6 1.5.6 2.1 0l8.1-8.1zm-4.6 11 6.7-6.6 4.6 4.6-2 2zM20.5 15s-2 2.4-2 3.8a2 2 0 0 0 4 0c0-1.4-2-3.8-2-3.8z",
  stencil: "M3 5h18v14H3zm2.2 2.2v7.3l3.6-4.2 3.7 4.4 2.3-2.5 4 4.4V7.2zm10.3 1.3a1.8 1.8 0 1 1 0 3.6 1.8 1.8 0 0 1 0-3.6z",
  clone: "M12 2a4 4 0 0 0-2.6 7c.5.5.8 1 .8 1.6V13H5.5A2.5 2.5 0 0 0 3 15.5V18h18v-2.5a2.5 2.5 0 0 0-2.5-2.5h-4.7v-2.4c0-.6.3-1.1.8-1.6A4 4 0 0 0 12 2zM3 19.7h18V22H3z",
  smudge: "M9 2.5c1 0 1.8.8 1.8 1.8v6l7.2 1.5c1.3.3 2.2 1.5 2 2.9l-.8 4.8c-.2 1.5-1.5 2.5-3 2.5h-5.4c-.9 0-1.7-.4-2.3-1L3.5 15.5l1-1.1c.5-.5 1.2-.7 1.9-.5l.8.2V4.3C7.2 3.3 8 2.5 9 2.5z",
  blur: "M12 2.5S5.5 10 5.5 15a6.5 6.5 0 0 0 13 0c0-5-6.5-12.5-6.5-12.5zm0 16.7A4.2 4.2 0 0 1 7.8 15h2.1c0 1.2.9 2.1 2.1 2.1z",
  undo: "M8 5 2.5 10.5 8 16v-4h5.5a3.8 3.8 0 0 1 0 7.5H9V22h4.5a6.2 6.2 0 0 0 0-12.5H8z",
  redo: "m16 5 5.5 5.5L16 16v-4h-5.5a3.8 3.8 0 0 0 0 7.5H15V22h-4.5a6.2 6.2 0 0 1 0-12.5H16z",
  save: "M4 3h12l5 5v13H3V4a1 1 0 0 1 1-1zm3 2v5h8V5zm5 8a3 3 0 1 0 0 6 3 3 0 0 0 0-6z",
  flat: "M9 3 3 5.2V21l6-2.2 6 2.2 6-2.2V3l-6 2.2zm.2 2.2 5.6 2v11.4l-5.6-2z",
  back: "M5.6 4 4 5.6 10.4 12 4 18.4 5.6 20l6.4-6.4 6.4 6.4 1.6-1.6-6.4-6.4L20 5.6 18.4 4 12 10.4z",
  less: "M4 10.8h16v2.4H4z",
  more: "M10.8 4h2.4v6.8H20v2.4h-6.8V20h-2.4v-6.8H4v-2.4h6.8z",
  eraser: "M15.6 3.2a2 2 0 0 0-2.8 0L3.2 12.8a2 2 0 0 0 0 2.8L7.6 20H21v-2.2h-7.2l7-7a2 2 0 0 0 0-2.8zM8.5 17.8l-3.7-3.6 4-4 4.5 4.5-3.1 3.1z",
  up: "m12 5 7 7-1.7 1.7-4.1-4.1V19h-2.4V9.6l-4.1 4.1L5 12z",
  down: "m12 19-7-7 1.7-1.7 4.1 4.1V5h2.4v9.4l4.1-4.1L19 12z",
  copy: "M8 3h12v14H8zm2.2 2.2v9.6h7.6V5.2zM4 7h2.2v11.8H16V21H4z",
  merge: "M4 4h16v2.2H4zm0 13.8h16V20H4zM10.8 7.5h2.4v4.6l2-2L16.9 11.8 12 16.6 7.1 11.8l1.7-1.7 2 2z",
  remove: "M9 3h6l1 2h4v2.2H4V5h4zM5.5 8.6h13L17.6 21H6.4zm4 2.2v8h1.6v-8zm3.4 0v8h1.6v-8z",
  visible: "M12 5C6.5 5 2.7 9.4 1.5 12c1.2 2.6 5 7 10.5 7s9.3-4.4 10.5-7C21.3 9.4 17.5 5 12 5zm0 2.2c3.8 0 6.7 2.8 8 4.8-1.3 2-4.2 4.8-8 4.8S5.3 14 4 12c1.3-2 4.2-4.8 8-4.8zm0 1.6a3.2 3.2 0 1 0 0 6.4 3.2 3.2 0 0 0 0-6.4z",
  hidden: "m3.5 2.5-1.5 1.5 4 4C3.7 9.3 2.2 11 1.5 12c1.2 2.6 5 7 10.5 7 1.7 0 3.2-.4 4.5-1l4 4 1.5-1.5zM12 16.8c-3.8 0-6.7-2.8-8-4.8.700-1.1 1.9-2.4 3.5-3.4l1.7 1.7A3.2 3.2 0 0 0 13.6 15l1.2 1.2c-.9.4-1.8.600-2.8.600zM12 5c5.5 0 9.3 4.4 10.5 7-.5 1.1-1.5 2.5-2.9 3.8L18 14.2c.9-.7 1.5-1.5 2-2.2-1.3-2-4.2-4.8-8-4.8-.6 0-1.1.100-1.7.200L8.5 5.6A11 11 0 0 1 12 5z",
  fold: "m12 16.5-8.5-8.5 1.7-1.7 6.8 6.8 6.8-6.8 1.7 1.7z",
  theme: "M12 2a10 10 0 1 0 0 20 10 10 0 0 0 0-20zm0 2.4v15.2a7.6 7.6 0 0 1 0-15.2z",
};

// Blend modes of paint and layers, with their names.
export const BLENDS = [["over", "normal"], ["multiply", "multiply"], ["screen", "screen"], ["add", "add"]];

export const icon = (name) => make("svg", { viewBox: "0 0 24 24", "aria-hidden": "true" }, make("path", { d: ICONS[name] }));

// A button with an icon; the title is also its name for screen readers.
export const iconButton = (id, name, title, onclick) => make("button", { type: "button", id, title, "aria-label": title, onclick }, icon(name));

export const button = (id, text, onclick) => make("button", { type: "button", id, onclick }, text);

// A slider, after a label that shows its value.
export const slider = (id, text, attributes, set) => [
  make("label", { for: id }, text, make("output", { id: `${id}-text`, for: id })),
  make("input", { type: "range", id, ...attributes, oninput: ({ target }) => set(Number(target.value)) }),
];

export const check = (id, text, set) => make("label", { class: "check" }, make("input", { type: "checkbox", id, oninput: ({ target }) => set(target.checked) }), text);

// A list to choose from, after its label; `options` are pairs of value and text.
export const choice = (id, text, options, set) => [
  make("label", { for: id }, text),
  make("select", { id, oninput: ({ target }) => set(target.value) }, ...options.map(([value, name]) => new Option(name, value))),
];

export const percent = (share) => `${Math.round(100 * share)} %`;

// A part of the panel that opens and closes.
export const section = (id, text, ...children) => make("details", { id }, make("summary", {}, text), ...children);

// Controls of an object's settings. `read` returns the object; `change` is called with the settings that a control changes.
export class Settings {
  constructor(prefix, read, change) {
    Object.assign(this, { prefix, read, change, updates: [] });
  }

  set(name) {
    return (value) => this.change({ [name]: value });
  }

  // `textOf` returns the text of a value; the slider is disabled unless `isUsed` of all settings.
  slider(name, text, attributes, textOf = percent, isUsed = () => true) {
    const made = slider(this.prefix + name, text, attributes, this.set(name)), [label, input] = made;
    this.updates.push((settings) => {
      input.value = settings[name];
      label.lastChild.textContent = textOf(settings[name]);
      input.disabled = !isUsed(settings);
    });
    return made;
  }

  check(name, text) {
    const made = check(this.prefix + name, text, this.set(name));
    this.updates.push((settings) => (made.firstChild.checked = settings[name]));
    return made;
  }

  choice(name, text, options, change = this.set(name)) {
    const made = choice(this.prefix + name, text, options, change);
    this.updates.push((settings) => (made[1].value = settings[name]));
    return made;
  }

  // Show the current settings.
  show() {
    for (const update of this.updates) update(this.read());
  }
}
