// Plays the model's animations: which one, at what time.

import { element } from "./elements.js";

export class Player {
  // `changed` is called with where the mesh is to be drawn: an animation and a time, or null as it stands.
  constructor(header, changed) {
    this.animations = header.animations;
    this.number = -1;
    this.time = 0;
    this.since = null; // when it was last moved on, while it plays
    this.changed = changed;
    const names = [header.start === "rest" ? "as it is posed" : "as it rests", ...this.animations.map((each) => each.name)];
    element("animation").replaceChildren(...names.map((name, n) => new Option(name, n - 1)));
    element("player").hidden = false;
    element("animation").addEventListener("input", (event) => this.choose(Number(event.target.value)));
    element("play").addEventListener("click", () => this.play(this.since === null));
    element("time").addEventListener("input", (event) => {
      const time = Number(event.target.value);
      this.play(false);
      this.seek(time);
    });
    this.choose(-1);
  }

  choose(number) {
    this.number = number;
    const length = this.animations[number]?.length ?? 0;
    element("animation").value = number;
    element("time").max = length;
    element("time").disabled = number < 0;
    if (number < 0) this.play(false);
    this.seek(0);
  }

  // Play, the first animation if none is chosen, or stop.
  play(on) {
    if (on && this.number < 0) this.choose(0);
    this.since = on ? performance.now() : null;
    element("play").textContent = on ? "Pause" : "Play";
    this.seek(this.time);
  }

  stop() {
    if (this.since !== null) this.play(false);
  }

  seek(time) {
    this.time = time;
    element("time").value = time;
    element("time-text").textContent = this.number < 0 ? "" : `${time.toFixed(2)} s`;
    this.changed(this.number < 0 ? null : { animation: this.number, time });
  }

  // Move on to now; says whether anything plays.
  step(now) {
    if (this.since === null) return false;
    const { length } = this.animations[this.number], seconds = (now - this.since) / 1000;
    this.since = now;
    this.seek(length > 0 ? (this.time + Math.max(seconds, 0)) % length : 0);
    return true;
  }
}
