// The brush's colour, recent colours, and ready brushes.

import { element, make } from "./elements.js";
import { fromHex, toHex } from "./material.js";

const MAX_RECENT = 9; // colours: one row
const DEFAULTS = { opacity: 1, flow: 1, spacing: 0.1, smoothing: 0, pressure: "size", blend: "over" };
// Ready brushes: what differs from the defaults. Size and colour stay.
const BRUSHES = {
  Soft: { hardness: 0, pressure: "opacity" },
  Hard: { hardness: 0.9 },
  Air: { hardness: 0, flow: 0.1, pressure: "opacity" },
  Ink: { hardness: 0.95, smoothing: 30 },
  Dots: { hardness: 0.9, spacing: 1.5 },
};

// Parse a colour of three or six hexadecimal digits; null for anything else.
function parsedColor(text) {
  const [, digits] = /^#?([0-9a-f]{3}|[0-9a-f]{6})$/i.exec(text.trim()) ?? [];
  return digits ? fromHex(`#${digits.length === 3 ? digits.replace(/./g, "$&$&") : digits}`) : null;
}

export class Palette {
  constructor(painting) {
    this.painting = painting;
    this.elements = [
      make("div", { class: "colors" },
        make("input", { type: "color", id: "color", "aria-label": "Colour", oninput: ({ target }) => painting.set({ color: fromHex(target.value) }) }),
        make("button", { type: "button", id: "second-color", title: "Swap the two colours (X)", onclick: () => painting.swapColors() }),
        make("input", { type: "text", id: "color-text", maxlength: 7, spellcheck: "false", autocomplete: "off", "aria-label": "Colour as hexadecimal digits", onchange: ({ target }) => this.setText(target.value) })),
      make("div", { id: "recent", role: "group", "aria-label": "Recent colours" }),
      make("div", { id: "brushes", role: "group", "aria-label": "Brushes" }, ...Object.entries(BRUSHES).map(([name, settings]) => this.brushButton(name, { ...DEFAULTS, ...settings }))),
    ];
  }

  brushButton(name, settings) {
    const dab = make("i", { class: settings.spacing > 1 ? "dots" : "", style: `--hardness: ${100 * settings.hardness}%; --flow: ${Math.max(settings.flow, 0.5)}` });
    return make("button", { type: "button", title: `${name} brush`, onclick: () => this.useBrush(settings) }, dab, name);
  }

  useBrush(settings) {
    const { painting } = this;
    painting.set(settings);
    if (!painting.tool.hasRing) painting.selectTool("brush");
  }

  setText(text) {
    const color = parsedColor(text);
    this.painting.showMessage(color ? "" : "A colour is three or six hexadecimal digits, like #c83c28.");
    this.painting.set(color ? { color } : {});
  }

  // Add a painted colour to the recent ones.
  addRecent(color) {
    const { recent } = this.painting.brush, isOther = (each) => toHex(each) !== toHex(color);
    if (color) this.painting.set({ recent: [color, ...recent.filter(isOther)].slice(0, MAX_RECENT) });
  }

  show() {
    const { painting } = this, { color, recent } = painting.brush, list = element("recent");
    element("color").value = element("color-text").value = toHex(color);
    element("second-color").style.background = toHex(painting.secondColor);
    recent.forEach((each, n) => {
      const button = list.children[n] ?? list.appendChild(make("button", { type: "button", onclick: () => painting.set({ color: painting.brush.recent[n] }) }));
      button.title = toHex(each);
      button.style.background = toHex(each);
    });
    while (list.children.length > recent.length) list.lastChild.remove();
  }
}
