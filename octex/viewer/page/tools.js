// The tools that pages paint with. Each has a name, what it is called, a key, and `down`: what a press on the model
// does. That may return a drag: what `moved`, `up` and `giveUp` of the pointer do until it is up. `turns`: presses turn the
// view; `chosen` is called when it is chosen, and says whether that was all; `left` when another one is, `hovered` when the
// pointer is moved; `keys` returns what keys do meanwhile, `alt` is what a press with Alt does. `settings`: its section of
// the panel.

import { BrushDrag } from "./brush.js";
import { prepare } from "./retouch.js";
import { through } from "./stencil.js";

const retouched = (painting) => void prepare(painting);

export const TOOLS = [
  { name: "brush", text: "Brush", key: "b", hasRing: true, down: (painting, event) => new BrushDrag(painting, event, through(painting)) },
  { name: "eraser", text: "Eraser", key: "e", hasRing: true, down: (painting, event) => new BrushDrag(painting, event, { name: "Eraser", erases: true }) },
  { name: "pick", text: "Pick", key: "i", shownKey: "Alt", isAnywhere: true, down: pick },
  { name: "stencil", text: "Stencil", key: "d", settings: "stencil-section", turns: true, chosen: ({ stencil }) => stencil.begin(), keys: ({ stencil }, event) => stencil.keys(event) },
  { name: "clone", text: "Clone", key: "o", settings: "retouch", hasRing: true, chosen: retouched, down: ({ retouch }, event) => retouch.clone(event), alt: ({ retouch }, event) => retouch.aim(event), hovered: ({ retouch }, at) => retouch.hover(at), left: ({ retouch }) => retouch.leave() },
  { name: "smudge", text: "Smudge", key: "u", hasRing: true, chosen: retouched, down: ({ retouch }, event) => retouch.smudge(event) },
  { name: "blur", text: "Blur", key: "r", settings: "retouch", hasRing: true, chosen: retouched, down: ({ retouch }, event) => retouch.blur(event) },
  { name: "fill", text: "Fill", key: "f", settings: "filling", isAnywhere: true, down: fill },
  { name: "flat", text: "Flat", key: "v", isAnywhere: true, chosen: ({ flat }) => flat.close(), down: ({ flat }, event) => void flat.open(event) },
];

// Take what the surface has of all that is painted, and go on with the brush.
export function pick(painting, event) {
  const [x, y] = painting.place(event), found = painting.viewer.pick(x, y);
  if (found) painting.material.take(found.channels);
  if (painting.tool.name === "pick") painting.choose("brush");
}

function fill(painting, event) {
  const { opacity, blend, mirror, filled, tolerance } = painting.brush, [x, y] = painting.place(event);
  const at = filled === "all" ? undefined : painting.viewer.pick(x, y)?.rest, like = filled.startsWith("color") ? { tolerance, connected: filled === "color" } : {};
  if (filled !== "all" && !at) return;
  const name = { part: "Fill a part", color: "Fill a colour", colors: "Fill a colour", all: "Fill all" }[filled];
  painting.sending.send({ kind: "fill", name, ...painting.material.paint, opacity, blend, mirror, offset: painting.offset, at, ...like });
  painting.palette.use(painting.material.paint.color);
  painting.choose("brush");
}
