// The tools that pages paint with. Each has a name, what it is called, a key, and `down`: what a press on the model
// does. That may return a drag: what `moved`, `up` and `giveUp` of the pointer do until it is up.

import { BrushDrag } from "./brush.js";

export const TOOLS = [
  { name: "brush", text: "Brush", key: "b", hasRing: true, down: (painting, event) => new BrushDrag(painting, event) },
  { name: "pick", text: "Pick", key: "i", shownKey: "Alt", isAnywhere: true, down: pick },
  { name: "fill", text: "Fill", key: "f", isAnywhere: true, down: fill },
];

// Take what the surface has of all that is painted, and go on with the brush.
export function pick(painting, event) {
  const [x, y] = painting.place(event), found = painting.viewer.pick(x, y);
  if (found) painting.material.take(found.channels);
  if (painting.tool.name === "pick") painting.choose("brush");
}

function fill(painting, event) {
  const { opacity, blend, mirror, filled } = painting.brush, [x, y] = painting.place(event);
  const isPart = filled === "part", at = isPart ? painting.viewer.pick(x, y)?.rest : undefined;
  if (isPart && !at) return;
  painting.sending.send({ kind: "fill", name: isPart ? "Fill a part" : "Fill all", ...painting.paint, opacity, blend, mirror, at });
  painting.choose("brush");
}
