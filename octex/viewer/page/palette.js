// The brush's colour, the colours that were used last, and brushes that are ready made.

import { element, make } from "./elements.js";
import { fromHex, toHex } from "./material.js";

const MOST_USED = 9; // colours, which are one row
// What each brush sets; size and colour stay.
const PLAIN = { opacity: 1, flow: 1, spacing: 0.1, smoothing: 0, pressure: "size", blend: "over" };
const BRUSHES = {
  Soft: { hardness: 0, pressure: "opacity" },
  Hard: { hardness: 0.9 },
  Air: { hardness: 0, flow: 0.1, pressure: "opacity" },
  Ink: { hardness: 0.95, smoothing: 30 },
  Dots: { hardness: 0.9, spacing: 1.5 },
};

// The codes of a colour that is written as three or six digits; null for anything else.
function colorOf(text) {
  const [, digits] = /^#?([0-9a-f]{3}|[0-9a-f]{6})$/i.exec(text.trim()) ?? [];
  return digits ? fromHex(`#${digits.length === 3 ? digits.replace(/./g, "$&$&") : digits}`) : null;
}

export class Palette {
  constructor(painting) {
    this.painting = painting;
    const swap = { type: "button", id: "other", title: "Change to the other colour (X)", onclick: () => painting.swap() };
    this.parts = [
      make("div", { class: "colors" },
        make("input", { type: "color", id: "color", "aria-label": "Colour", oninput: ({ target }) => painting.set({ color: fromHex(target.value) }) }),
        make("button", swap),
        make("input", { type: "text", id: "color-text", maxlength: 7, spellcheck: "false", autocomplete: "off", "aria-label": "Colour as hexadecimal digits", onchange: ({ target }) => this.read(target.value) })),
      make("div", { id: "used", role: "group", "aria-label": "Colours used last" }),
      make("div", { id: "brushes", role: "group", "aria-label": "Brushes" }, ...Object.entries(BRUSHES).map(([name, own]) => this.brush(name, { ...PLAIN, ...own }))),
    ];
  }

  brush(name, settings) {
    const dab = make("i", { class: settings.spacing > 1 ? "dots" : "", style: `--hardness: ${100 * settings.hardness}%; --flow: ${Math.max(settings.flow, 0.5)}` });
    return make("button", { type: "button", title: `${name} brush`, onclick: () => this.take(settings) }, dab, name);
  }

  take(settings) {
    const { painting } = this;
    painting.set(settings);
    if (!painting.tool.hasRing) painting.choose("brush");
  }

  read(text) {
    const color = colorOf(text);
    this.painting.say(color ? "" : "A colour is three or six hexadecimal digits, like #c83c28.");
    this.painting.set(color ? { color } : {});
  }

  // A colour is painted.
  use(color) {
    const { used } = this.painting.brush, isOther = (each) => toHex(each) !== toHex(color);
    if (color) this.painting.set({ used: [color, ...used.filter(isOther)].slice(0, MOST_USED) });
  }

  show() {
    const { painting } = this, { color, used } = painting.brush, list = element("used");
    element("color").value = element("color-text").value = toHex(color);
    element("other").style.background = toHex(painting.other);
    used.forEach((each, n) => {
      const button = list.children[n] ?? list.appendChild(make("button", { type: "button", onclick: () => painting.set({ color: painting.brush.used[n] }) }));
      button.title = toHex(each);
      button.style.background = toHex(each);
    });
    while (list.children.length > used.length) list.lastChild.remove();
  }
}
