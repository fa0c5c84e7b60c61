// A stroke of the brush, from the pen's press until it is up.

import { Path } from "./path.js";
import { deflated } from "./sending.js";

// The camera of the view as it is now, as commands have it.
export function cameraOf({ film: { width, height }, camera }) {
  const [{ K, pose }] = camera.file("", width, height).cameras;
  return { width, height, K, pose };
}

// Send a stroke, if there is one; show it until it is painted.
export function send({ strokes, sending }, stroke, isShown = true) {
  if (!stroke) return;
  const { name, colors = new Uint8Array(), coverage, angle: maxAngle, ...own } = stroke;
  const { camera, box, color, values, opacity, blend, backFaces, hidden, at, mirror, offset } = own;
  const called = mirror ? `${name}, mirrored` : name;
  const command = { kind: "stroke", name: called, camera, box, color, values, opacity, blend, maxAngle, backFaces, hidden, at, mirror, offset };
  stroke.number = sending.send(command, deflated(new Blob([colors, coverage])));
  if (isShown) strokes.keep(stroke);
}

export class BrushDrag {
  // `own` replaces what the brush is set to: its name, and a picture instead of its colour.
  constructor(painting, event, own = {}) {
    this.painting = painting;
    const { brush, paint, below, offset } = painting, at = painting.place(event);
    this.path = new Path(at);
    this.dirty = null; // what of the picture has changed since the last frame
    const point = brush.onePart ? below?.rest : undefined, camera = cameraOf(painting.viewer);
    painting.strokes.begin({ name: "Brush", ...brush, ...paint, offset, at: point, begin: at, ...own, camera });
    this.draw(at, at);
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
    const last = this.other, isMirrored = mirror.key && mirror.keyOf(current, view) === mirror.key;
    this.other = isMirrored && below ? mirror.around(below, width) : null;
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
    send(this.painting, this.painting.strokes.end());
  }

  giveUp() {
    this.painting.strokes.current = null;
  }
}
