// A stroke of the brush, from the pen's press until it is up.

import { joined } from "./dabs.js";
import { pulled } from "./hand.js";
import { Path } from "./path.js";
import { deflated } from "./sending.js";

// Send a stroke, if there is one; show it until it is painted.
export function send({ strokes, sending, palette }, stroke, isShown = true) {
  if (!stroke) return;
  if (!stroke.erases && !stroke.colors) palette.use(stroke.color);
  const { name, colors = new Uint8Array(), coverage, angle: maxAngle, ...own } = stroke;
  const { camera, moved, patch, box, color, values, opacity, blend, backFaces, hidden, at, mirror, offset, erases } = own;
  const called = mirror ? `${name}, mirrored` : name;
  const command = { kind: "stroke", name: called, camera, moved, patch, box, color, values, opacity, blend, maxAngle, backFaces, hidden, at, mirror, offset, erases };
  stroke.number = sending.send(command, deflated(new Blob([colors, coverage])));
  if (isShown) strokes.keep(stroke);
}

export class BrushDrag {
  // `own` replaces what the brush is set to: its name, and a picture instead of its colour.
  constructor(painting, event, own = {}) {
    this.painting = painting;
    const { strokes, below, offset } = painting, first = painting.place(event);
    const from = event.shiftKey ? painting.lineTo(first) : first;
    this.path = new Path(from);
    this.string = painting.brush.smoothing; // how long it is
    this.tip = first; // where the brush is
    this.dirty = null; // what of the picture has changed since the last frame
    const brush = { name: "Brush", ...painting.brush, ...painting.material.paint, ...own };
    const at = brush.onePart ? below?.rest : undefined, look = painting.beneath.look(brush);
    strokes.begin({ ...brush, ...strokes.seen, offset, at, begin: first, look });
    this.draw(from, from);
    if (from !== first) this.to(first);
  }

  // Where the brush is, if not under the pen.
  get at() {
    return this.string ? this.tip : null;
  }

  moved(event) {
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

  // Draw a part of the stroke; the picture has it in the next frame.
  draw(from, to) {
    const { strokes, below, width } = this.painting, { mirror, current, view } = strokes, box = strokes.extend(from, to);
    if (!box) return;
    const last = this.other;
    this.other = below && mirror.isOf(current, view) ? mirror.around(below, width) : null;
    this.dirty = [box, last, this.other].reduce(joined, this.dirty);
    this.asked ||= requestAnimationFrame(() => {
      this.asked = 0;
      if (this.dirty) this.painting.viewer.drawPart(this.dirty);
      this.dirty = null;
    });
  }

  up() {
    this.painting.ended(this.tip);
    send(this.painting, this.painting.strokes.end());
  }

  giveUp() {
    this.painting.strokes.current = null;
  }
}
