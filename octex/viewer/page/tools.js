// The tools of painting pages. Fields of a tool:
//   name, text, key  for code, for people, and on the keyboard (`shownKey` where the title shows another)
//   settings         the section of the panel that opens with the tool
//   hasRing          the pointer shows the brush's outline
//   turns            a press turns the view
//   isMomentary      after a press the tool before returns
//   isAnywhere       a press needs no paintable surface
//   down             handles a press on the model; may return a drag, with `move`, `up` and `cancel`
//   alt              handles a press with Alt
//   selected         is called when the tool is selected; returns true if the selection stays as it was
//   left             is called when another tool is selected
//   hovered          is called when the pointer moves
//   keys             returns the keys of the tool, with their functions

import { BrushDrag } from "./brush.js";
import { compilePrograms } from "./retouch.js";
import { stencilOverrides } from "./stencil.js";

const prepareRetouch = (painting) => void compilePrograms(painting);

export const TOOLS = [
  { name: "brush", text: "Brush", key: "b", hasRing: true, down: (painting, event) => new BrushDrag(painting, event, stencilOverrides(painting)) },
  { name: "eraser", text: "Eraser", key: "e", hasRing: true, down: (painting, event) => new BrushDrag(painting, event, { name: "Eraser", erases: true }) },
  { name: "pick", text: "Pick", key: "i", shownKey: "Alt", isAnywhere: true, isMomentary: true, down: pickPaint },
  {
    name: "stencil", text: "Stencil", key: "d", settings: "stencil-section", turns: true,
    selected: ({ stencil }) => stencil.begin(), keys: ({ stencil }, event) => stencil.keys(event),
  },
  {
    name: "clone", text: "Clone", key: "o", settings: "retouch", hasRing: true, selected: prepareRetouch, down: ({ retouch }, event) => retouch.clone(event),
    alt: ({ retouch }, event) => retouch.setSource(event), hovered: ({ retouch }, place) => retouch.hover(place), left: ({ retouch }) => retouch.leave(),
  },
  { name: "smudge", text: "Smudge", key: "u", hasRing: true, selected: prepareRetouch, down: ({ retouch }, event) => retouch.smudge(event) },
  { name: "blur", text: "Blur", key: "r", settings: "retouch", hasRing: true, selected: prepareRetouch, down: ({ retouch }, event) => retouch.blur(event) },
  { name: "fill", text: "Fill", key: "f", settings: "filling", isAnywhere: true, down: fill },
  { name: "flat", text: "Flat", key: "v", isAnywhere: true, selected: ({ flat }) => flat.close(), down: ({ flat }, event) => void flat.open(event) },
];

// Pick the values of all painted channels from the surface; the pick tool then returns to the tool before.
export function pickPaint(painting, event) {
  const [x, y] = painting.place(event), picked = painting.viewer.pick(x, y);
  if (picked) painting.material.takeValues(picked.channels);
  if (painting.tool.isMomentary) painting.selectTool(painting.lastTool.name);
}

function fill(painting, event) {
  const { opacity, blend, mirror, fills, tolerance } = painting.brush, [x, y] = painting.place(event);
  const at = fills === "all" ? undefined : painting.viewer.pick(x, y)?.rest, limits = fills.startsWith("color") ? { tolerance, connected: fills === "color" } : {};
  if (fills !== "all" && !at) return;
  const name = { part: "Fill a part", color: "Fill a colour", colors: "Fill a colour", all: "Fill all" }[fills];
  painting.commands.send({ kind: "fill", name, ...painting.material.paint, opacity, blend, mirror, offset: painting.mirrorOffset, at, ...limits });
  painting.palette.addRecent(painting.material.paint.color);
}

// Press the tool in the middle of the image, without a pointer.
export function pressMiddle(painting) {
  const { canvas } = painting.viewer, { left, top, width, height } = canvas.getBoundingClientRect();
  const press = new PointerEvent("pointerdown", { pointerId: -1, clientX: left + width / 2, clientY: top + height / 2 });
  painting.pointerDown(press);
  painting.pointerUp(press);
  canvas.focus(); // a press takes the focus away
}
