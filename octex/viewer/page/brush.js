// A stroke of the brush, from the pen's press until it is up.

import { deflated } from "./sending.js";

// The camera of the view as it is now, as commands have it.
export function cameraOf({ film: { width, height }, camera }) {
  const [{ K, pose }] = camera.file("", width, height).cameras;
  return { width, height, K, pose };
}

// Send a stroke, if there is one; show it until it is painted.
export function send({ strokes, sending }, stroke, isShown = true) {
  if (!stroke) return;
  const { name, camera, box, color, colors = new Uint8Array(), opacity, coverage, angle: maxAngle, backFaces, mirror } = stroke;
  const command = { kind: "stroke", name: mirror ? `${name}, mirrored` : name, camera, box, color, opacity, maxAngle, backFaces, mirror };
  stroke.number = sending.send(command, deflated(new Blob([colors, coverage])));
  if (isShown) strokes.keep(stroke);
}

export class BrushDrag {
  // `own` replaces what the brush is set to: its name, and a picture instead of its colour.
  constructor(painting, event, own = {}) {
    this.painting = painting;
    this.at = painting.place(event);
    this.dirty = null; // what of the picture has changed since the last frame
    painting.strokes.begin({ name: "Brush", ...painting.brush, ...own, camera: cameraOf(painting.viewer) });
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
    send(this.painting, this.painting.strokes.end());
  }

  giveUp() {
    this.painting.strokes.current = null;
  }
}
