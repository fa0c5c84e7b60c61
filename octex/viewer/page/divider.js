// The divider between the model's images on its left and the octree on its right; moved by pointer and keys.

import { element } from "./elements.js";

const DIVIDER_STEP = 0.02;

export class Divider {
  // `changed` is called with the position in the image's width, 0 … 1; with null when the divider is off.
  constructor(changed) {
    this.changed = changed;
    this.position = 0.5;
    this.bar = element("divider");
    element("compare-label").hidden = false;
    element("compare").addEventListener("input", () => this.set(this.position));
    this.bar.addEventListener("pointerdown", (event) => {
      this.bar.setPointerCapture(event.pointerId);
      event.preventDefault();
      this.bar.focus();
    });
    this.bar.addEventListener("pointermove", (event) => {
      if (!this.bar.hasPointerCapture(event.pointerId)) return;
      const frame = this.bar.parentElement.getBoundingClientRect();
      this.set((event.clientX - frame.left) / frame.width);
    });
    this.bar.addEventListener("keydown", (event) => {
      const positions = { ArrowLeft: this.position - DIVIDER_STEP, ArrowRight: this.position + DIVIDER_STEP, Home: 0, End: 1 };
      if (!(event.key in positions)) return;
      event.preventDefault();
      this.set(positions[event.key]);
    });
  }

  set(position) {
    const isOn = element("compare").checked;
    this.position = Math.min(Math.max(position, 0), 1);
    this.bar.hidden = !isOn;
    this.bar.style.left = `${100 * this.position}%`;
    this.bar.ariaValueNow = Math.round(100 * this.position);
    this.changed(isOn ? this.position : null);
  }
}
