// A stroke of the brush, from the pen's press until it is up.

import { deflated } from "./sending.js";

export class BrushDrag {
  constructor(painting, event) {
    const { strokes } = painting;
    this.painting = painting;
    this.at = painting.place(event);
    this.dirty = null; // what of the picture has changed since the last frame
    strokes.begin({ ...painting.brush, ...strokes.seen });
    this.draw(this.at, this.at);
  }

  moved(event) {
    const events = event.getCoalescedEvents?.() ?? [];
    for (const each of events.length ? events : [event]) {
      const at = this.painting.place(each);
      this.draw(this.at, at);
      this.at = at;
    }
  }

  // Draw a part of the stroke; the picture has it in the next frame.
  draw(from, to) {
    const box = this.painting.strokes.extend(from, to);
    if (!box) return;
    const before = this.dirty ?? box;
    this.dirty = { left: Math.min(before.left, box.left), top: Math.min(before.top, box.top), right: Math.max(before.right, box.right), bottom: Math.max(before.bottom, box.bottom) };
    this.asked ||= requestAnimationFrame(() => {
      this.asked = 0;
      if (this.dirty) this.painting.viewer.drawPart(this.dirty);
      this.dirty = null;
    });
  }

  up() {
    const { strokes, sending } = this.painting, stroke = strokes.end();
    if (!stroke) return;
    const { camera, moved, patch, box, color, opacity, coverage, angle: maxAngle, backFaces, mirror } = stroke;
    const name = mirror ? "Brush, mirrored" : "Brush";
    const command = { kind: "stroke", name, camera, moved, patch, box, color, opacity, maxAngle, backFaces, mirror };
    stroke.number = sending.send(command, deflated(coverage));
    strokes.keep(stroke);
  }

  giveUp() {
    this.painting.strokes.current = null;
  }
}
