// A stroke of the brush, from the pen's press until it is up.

import { Path } from "./path.js";
import { deflated } from "./sending.js";

export class BrushDrag {
  constructor(painting, event, more = {}) {
    const { strokes } = painting;
    this.painting = painting;
    const first = painting.place(event);
    this.path = new Path(first);
    this.dirty = null; // what of the picture has changed since the last frame
    const { below, offset } = painting, brush = { ...painting.brush, ...painting.paint, ...more };
    const at = brush.onePart ? below?.rest : undefined, look = painting.layers.look(brush);
    strokes.begin({ ...brush, ...strokes.seen, offset, at, begin: first, look });
    this.draw(first, first);
  }

  moved(event) {
    const events = event.getCoalescedEvents?.() ?? [];
    for (const each of events.length ? events : [event]) {
      for (const line of this.path.to(this.painting.place(each))) this.draw(...line);
    }
  }

  // Draw a part of the stroke; the picture has it in the next frame.
  draw(from, to) {
    const { strokes, below, width } = this.painting, { mirror, current, view } = strokes, box = strokes.extend(from, to);
    if (!box) return;
    const last = this.other;
    this.other = below && mirror.isOf(current, view) ? mirror.around(below, width) : null;
    for (const each of [box, last, this.other].filter(Boolean)) {
      const before = this.dirty ?? each;
      this.dirty = { left: Math.min(before.left, each.left), top: Math.min(before.top, each.top), right: Math.max(before.right, each.right), bottom: Math.max(before.bottom, each.bottom) };
    }
    this.asked ||= requestAnimationFrame(() => {
      this.asked = 0;
      if (this.dirty) this.painting.viewer.drawPart(this.dirty);
      this.dirty = null;
    });
  }

  up() {
    const { strokes, sending } = this.painting, stroke = strokes.end();
    if (!stroke) return;
    const { camera, moved, patch, box, color, values, opacity, blend, coverage, angle: maxAngle, backFaces, hidden, at, mirror, offset, erases } = stroke;
    const tool = erases ? "Eraser" : "Brush", name = mirror ? `${tool}, mirrored` : tool;
    const command = { kind: "stroke", name, camera, moved, patch, box, color, values, opacity, blend, maxAngle, backFaces, hidden, at, mirror, offset, erases };
    stroke.number = sending.send(command, deflated(coverage));
    strokes.keep(stroke);
  }

  giveUp() {
    this.painting.strokes.current = null;
  }
}
