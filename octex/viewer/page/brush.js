// Draws a stroke from press to release, and sends it.

import { unionOf } from "./boxes.js";
import { deflate } from "./commands.js";
import { Path, pulled } from "./path.js";

// Send a stroke if there is one, and show it until the texture has it.
export function sendStroke({ strokes, commands, palette }, stroke, isShown = true) {
  if (!stroke) return;
  if (!stroke.erases && !stroke.colors) palette.addRecent(stroke.color);
  const { name, colors = new Uint8Array(), coverage, angle: maxAngle, mirror } = stroke;
  const { camera, moved, patch, box, color, values, opacity, blend, backFaces, hidden, at, offset, erases } = stroke;
  const fields = { camera, moved, patch, box, color, values, opacity, blend, maxAngle, backFaces, hidden, at, mirror, offset, erases };
  const command = { kind: "stroke", name: mirror ? `${name}, mirrored` : name, ...fields };
  stroke.command = commands.send(command, deflate(new Blob([colors, coverage])));
  if (isShown) strokes.addSent(stroke);
}

export class BrushDrag {
  // `overrides` replace settings of the brush: its name, and an image instead of the colour.
  constructor(painting, event, overrides = {}) {
    this.painting = painting;
    const { strokes, hit, mirrorOffset: offset } = painting, first = painting.place(event);
    const from = event.shiftKey ? painting.lineStart(first) : first;
    this.path = new Path(from);
    this.string = painting.brush.smoothing; // pixels
    this.tip = first; // the brush's place, which the pen pulls by the string
    this.dirty = null; // the box of the image that has changed since the last frame
    const brush = { name: "Brush", ...painting.brush, ...painting.material.paint, ...overrides };
    const at = brush.onePart ? hit?.rest : undefined;
    strokes.begin({ ...brush, ...strokes.viewFields, offset, at, begin: first, preview: painting.preview.styleOf(brush) });
    this.draw(from, from);
    if (from !== first) this.to(first);
  }

  // The brush's place if it differs from the pen's.
  get place() {
    return this.string ? this.tip : null;
  }

  move(event) {
    const events = event.getCoalescedEvents?.() ?? [];
    for (const each of events.length ? events : [event]) {
      const next = pulled(this.tip, this.painting.place(each), this.string);
      if (next !== this.tip) this.to(next);
    }
  }

  to(place) {
    this.tip = place;
    for (const line of this.path.to(place)) this.draw(...line);
  }

  // Draw a line of the stroke; the next frame shows it.
  draw(from, to) {
    const { strokes, hit, brushWidth } = this.painting, { mirror, current, viewKey } = strokes, box = strokes.extend(from, to);
    if (!box) return;
    const lastMirrored = this.mirroredBox;
    this.mirroredBox = hit && mirror.isOf(current, viewKey) ? mirror.boxAround(hit, brushWidth) : null;
    this.dirty = [box, lastMirrored, this.mirroredBox].reduce(unionOf, this.dirty);
    this.frameRequest ||= requestAnimationFrame(() => {
      this.frameRequest = 0;
      if (this.dirty) this.painting.viewer.drawBox(this.dirty);
      this.dirty = null;
    });
  }

  up() {
    this.painting.rememberEnd(this.tip);
    sendStroke(this.painting, this.painting.strokes.end());
  }

  cancel() {
    this.painting.strokes.current = null;
  }
}
