// The tools that pages paint with. Each has a name, what it is called, a key, and `down`: what a press on the model
// does. That may return a drag: what `moved`, `up` and `giveUp` of the pointer do until it is up. `turns`: presses turn the
// view; `chosen` is called when it is chosen, `left` when another one is, `hovered` when the pointer is moved; `keys`
// returns what keys do meanwhile, `alt` is what a press with Alt does.

import { BrushDrag } from "./brush.js";
import { through } from "./stencil.js";

export const TOOLS = [
  { name: "brush", text: "Brush", key: "b", hasRing: true, down: (painting, event) => new BrushDrag(painting, event, through(painting)) },
  { name: "pick", text: "Pick", key: "i", shownKey: "Alt", isAnywhere: true, down: pick },
  { name: "stencil", text: "Stencil", key: "d", turns: true, chosen: ({ stencil }) => stencil.begin(), keys: ({ stencil }, event) => stencil.keys(event) },
  { name: "clone", text: "Clone", key: "o", hasRing: true, down: ({ retouch }, event) => retouch.clone(event), alt: ({ retouch }, event) => retouch.aim(event), hovered: ({ retouch }, at) => retouch.hover(at), left: ({ retouch }) => retouch.leave() },
  { name: "smudge", text: "Smudge", key: "u", hasRing: true, down: ({ retouch }, event) => retouch.smudge(event) },
  { name: "blur", text: "Blur", key: "r", hasRing: true, down: ({ retouch }, event) => retouch.blur(event) },
  { name: "fill", text: "Fill", key: "f", isAnywhere: true, down: fill },
];

// Take the colour of the surface, and go on with the brush.
export function pick(painting, event) {
  const [x, y] = painting.place(event), found = painting.viewer.pick(x, y)?.channels.find(({ name }) => name === painting.strokes.channel);
  if (found) painting.set({ color: found.values.map((light) => 255 * Math.min(Math.max(light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055, 0), 1)) });
  if (painting.tool.name === "pick") painting.choose("brush");
}

function fill(painting, event) {
  const { color, opacity, mirror, filled } = painting.brush, [x, y] = painting.place(event);
  const isPart = filled === "part", at = isPart ? painting.viewer.pick(x, y)?.rest : undefined;
  if (isPart && !at) return;
  painting.sending.send({ kind: "fill", name: isPart ? "Fill a part" : "Fill all", color, opacity, mirror, at });
  painting.choose("brush");
}
