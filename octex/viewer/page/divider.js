// The divider between the source, on its left, and the octree: moved by mouse, touch and keys.

import { element } from "./elements.js";

const STRIDE = 0.02;

export class Divider {
  // `changed` is called with where it stands, as a part of the picture's width; null where it is off.
  constructor(changed) {
    this.changed = changed;
    this.place = 0.5;
    this.bar = element("divider");
    element("beside-label").hidden = false;
    element("beside").addEventListener("input", () => this.put(this.place));
    this.bar.addEventListener("pointerdown", (event) => {
      this.bar.setPointerCapture(event.pointerId);
      event.preventDefault();
      this.bar.focus();
    });
    this.bar.addEventListener("pointermove", (event) => {
      if (!this.bar.hasPointerCapture(event.pointerId)) return;
      const frame = this.bar.parentElement.getBoundingClientRect();
      this.put((event.clientX - frame.left) / frame.width);
    });
    this.bar.addEventListener("keydown", (event) => {
      const places = { ArrowLeft: this.place - STRIDE, ArrowRight: this.place + STRIDE, Home: 0, End: 1 };
      if (!(event.key in places)) return;
      event.preventDefault();
      this.put(places[event.key]);
    });
  }

  put(place) {
    const on = element("beside").checked;
    this.place = Math.min(Math.max(place, 0), 1);
    this.bar.hidden = !on;
    this.bar.style.left = `${100 * this.place}%`;
    this.bar.ariaValueNow = Math.round(100 * this.place);
    this.changed(on ? this.place : null);
  }
}
