// Plays the model's animations.

import { element } from "./elements.js";

export class Player {
  // `changed` is called with the animation's number and time, or with null for the model without animation.
  constructor(header, changed) {
    this.animations = header.animations;
    this.number = -1;
    this.time = 0;
    this.steppedAt = null; // time of the last step; null while it does not play
    this.changed = changed;
    const names = [header.start === "rest" ? "pose of the file" : "rest pose", ...this.animations.map((each) => each.name)];
    element("animation").replaceChildren(...names.map((name, n) => new Option(name, n - 1)));
    element("player").hidden = false;
    element("animation").addEventListener("input", (event) => this.choose(Number(event.target.value)));
    element("play").addEventListener("click", () => this.play(this.steppedAt === null));
    element("time").addEventListener("input", (event) => {
      const time = Number(event.target.value);
      this.play(false);
      this.seek(time);
    });
    this.choose(-1);
  }

  choose(number) {
    this.number = number;
    element("animation").value = number;
    element("time").max = this.animations[number]?.length ?? 0;
    element("time").disabled = number < 0;
    if (number < 0) this.play(false);
    this.seek(0);
  }

  // Play or pause; without a chosen animation the first one is played.
  play(on) {
    if (on && this.number < 0) this.choose(0);
    this.steppedAt = on ? performance.now() : null;
    element("play").textContent = on ? "Pause" : "Play";
    this.seek(this.time);
  }

  stop() {
    if (this.steppedAt !== null) this.play(false);
  }

  seek(time) {
    this.time = time;
    element("time").value = time;
    element("time-text").textContent = this.number < 0 ? "" : `${time.toFixed(2)} s`;
    this.changed(this.number < 0 ? null : { animation: this.number, time });
  }

  // Advance to `now`; returns whether an animation plays.
  step(now) {
    if (this.steppedAt === null) return false;
    const { length } = this.animations[this.number], seconds = (now - this.steppedAt) / 1000;
    this.steppedAt = now;
    this.seek(length > 0 ? (this.time + Math.max(seconds, 0)) % length : 0);
    return true;
  }
}
