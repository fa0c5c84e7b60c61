// Tools that paint with colours that the view sees: clone, smudge, blur and sharpen. What they paint are pictures of the
// view, a texel a pixel, made by retouch.frag where the brush comes.

import { BrushDrag } from "./brush.js";
import { clipped } from "./dabs.js";
import { element, make } from "./elements.js";
import { Settings, section } from "./panel.js";
import { planesFor } from "./programs.js";

const TILE = 16; // pixels along the sides of squares that are drawn or not yet; neighbours in a row are drawn at once
const COPY = 0, BLUR = 1, SMUDGE = 2; // as retouch.frag names them; beneath.js has one more
const REACH = 2.5; // of a blur, in standard deviations
const SHARPER = -1; // how much is added of what a blur would take away
const DABS = 8; // of a smudge, within the brush's fading edge: fewer leave ribs
const CARRIED = 0.97; // what part of a colour a dab takes along, at most
const LEAST_WIDTH = 1, MOST_WIDTH = 20;
const SAME = 0.02; // how far from the source, in the model's radius, is what hides it

const grown = ([left, bottom, right, top], x, y) => [left - x, bottom - y, right + x, top + y];
const moved = ([left, bottom, right, top], [x, y]) => [left + x, bottom + y, right + x, top + y];

// What is looked up of it: all of its colours, or an octree that is `beneath`.
function lookOf({ viewer: { gpu, look, parts }, strokes }, beneath, channel) {
  const facing = (beneath ? [beneath] : parts).some(({ header }) => header.split[0] > 0);
  const paint = beneath ? null : Object.create(strokes, { current: { value: null } });
  const shown = { shown: "channel", channel, filter: "quadratic", footprints: true, level: gpu.deepest };
  return { ...look, ...shown, facing, paint, beneath, divider: 0, marked: null };
}

// Compile what draws it, so that a first stroke does not wait for that.
export function prepare(painting, beneath = null, channel = "base_color") {
  const { gpu, parts: [part], look } = painting.viewer, seen = lookOf(painting, beneath, channel);
  gpu.programs.use("surface", beneath ?? part, seen, planesFor(beneath ?? part, seen));
  gpu.programs.use("retouch", part, look, 0);
}

// The colours of the surface without light, as the view sees them; drawn where they are needed. Alpha 0: none.
export class Seen {
  // `drawn` is called with each box that gets drawn; `beneath` is an octree that is looked up instead, in a channel.
  constructor({ viewer, strokes }, drawn = () => {}, beneath = null, channel = "base_color") {
    const { gpu } = viewer;
    strokes.fit();
    this.size = strokes.size;
    this.viewer = viewer;
    this.drawn = drawn;
    this.gbuffer = strokes.gbuffer;
    this.target = gpu.target(`seen${beneath ? ` ${channel} beneath` : ""}`, ...this.size, [gpu.gl.RGBA8], this.gbuffer);
    this.across = Math.ceil(this.size[0] / TILE);
    this.known = new Set();
    this.look = lookOf({ viewer, strokes }, beneath, channel);
  }

  // Draw what there is of a box (left, bottom, right, top).
  need(box) {
    const [left, bottom, right, top] = clipped(box, this.size) ?? [0, 0, 0, 0], at = (pixel) => Math.floor(pixel / TILE), end = at(right - 1) + 1;
    for (let row = at(bottom); row <= at(top - 1); row++) {
      const isNew = (column) => column < end && !this.known.has(row * this.across + column);
      for (let column = at(left); column < end; column++) {
        const first = column;
        for (; isNew(column); column++) this.known.add(row * this.across + column);
        if (column > first) this.draw(clipped([first * TILE, row * TILE, column * TILE, (row + 1) * TILE], this.size));
      }
    }
  }

  draw(box) {
    const { viewer: { gpu, camera }, target } = this, { gl } = gpu;
    gpu.drawOn(target, box, () => {
      gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
      gpu.drawLayer(this.look, camera, this.gbuffer, target, null, {}, true);
    });
    this.drawn(box);
  }
}

// A picture that is made of what is seen: `ready` makes it within a box, before the brush covers that.
export class Made {
  constructor(painting, beneath = null) {
    this.gpu = painting.viewer.gpu;
    this.seen = new Seen(painting, (box) => this.drawn(box), beneath);
    this.made = this.target(beneath ? "led to" : "retouched");
    [this.texture] = this.made.textures;
    this.buffer = this.made.buffer;
  }

  drawn() {}

  target(name) {
    return this.gpu.target(name, ...this.seen.size, [this.gpu.gl.RGBA8]);
  }

  // Run retouch.frag from one target to another, within a box.
  run(action, from, to, box, { step = [0, 0], sigma = 1, share = 1, disc = [0, 0, 1, 1], before = from, paint = null } = {}) {
    const { gpu, seen } = this, { gl } = gpu, { viewer } = seen, program = gpu.programs.use("retouch", viewer.parts[0], viewer.look, 0);
    const part = clipped(box, seen.size);
    if (!part) return;
    gpu.bind(program, { u_from: from.textures[0], u_before: before.textures[0], u_positions: seen.gbuffer.textures[0], u_paint: paint ?? from.textures[0] });
    gl.uniform1i(program.at("u_action"), action);
    gl.uniform2i(program.at("u_step"), ...step);
    gl.uniform1f(program.at("u_sigma"), sigma);
    gl.uniform1f(program.at("u_share"), share);
    gl.uniform4f(program.at("u_disc"), ...disc);
    gpu.drawOn(to, part, () => gl.drawArrays(gl.TRIANGLES, 0, 3));
  }
}

// What is seen, moved by whole pixels.
class Copied extends Made {
  constructor(painting, step) {
    super(painting);
    this.step = step;
  }

  ready(box) {
    this.seen.need(moved(box, this.step.map((n) => -n)));
    this.run(COPY, this.seen.target, this.made, box, { step: this.step });
  }
}

// What is seen, blurred; or sharpened by a share below 0.
class Blurred extends Made {
  constructor(painting, sigma, share) {
    super(painting);
    this.sigma = sigma;
    this.share = share;
    this.rows = this.target("blurred rows");
  }

  ready(box) {
    const { sigma, share, rows, seen: { target } } = this, reach = Math.ceil(REACH * sigma);
    this.seen.need(grown(box, reach, reach));
    this.run(BLUR, target, rows, grown(box, 0, reach), { step: [1, 0], sigma });
    this.run(BLUR, rows, this.made, box, { step: [0, 1], sigma, share, before: target });
  }
}

// What is seen, dragged along by the brush.
class Smudged extends Made {
  constructor(painting, share, hardness) {
    super(painting);
    this.share = share;
    this.hardness = hardness;
    this.at = null;
    this.copy = this.target("smudged before");
  }

  // Begin with what is seen.
  drawn(box) {
    this.run(COPY, this.seen.target, this.made, box);
  }

  ready(box, from, to) {
    const radius = to[2];
    this.at ??= from.slice(0, 2).map(Math.round);
    const far = Math.hypot(to[0] - this.at[0], to[1] - this.at[1]), step = Math.max((radius * (1 - this.hardness)) / DABS, 1), dabs = Math.floor(far / step);
    this.seen.need(box);
    const start = this.at;
    for (let n = 1; n <= dabs; n++) {
      const next = start.map((x, axis) => Math.round(x + ((to[axis] - x) * n) / dabs));
      this.dab(next.map((x, axis) => x - this.at[axis]), next, radius);
      this.at = next;
    }
  }

  dab(step, [x, y], radius) {
    const reach = Math.ceil(radius) + 1, box = [x - reach, y - reach, x + reach, y + reach], far = Math.max(...step.map(Math.abs));
    this.seen.need(grown(box, far, far));
    this.run(COPY, this.made, this.copy, grown(box, far, far));
    this.run(SMUDGE, this.copy, this.made, box, { step, share: this.share, disc: [x, y, radius, this.hardness] });
  }
}

export class Retouch {
  constructor(painting) {
    this.painting = painting;
    this.point = null; // of the model, that clones come from
    this.step = null; // from there to where they go, in pixels of the film, and the view in which it is so
    this.width = 4;
    this.way = "softer";
    this.build();
  }

  build() {
    this.mark = make("div", { id: "source", hidden: true });
    this.painting.stage.append(this.mark);
    this.settings = new Settings("blur-", () => this, (change) => this.set(change));
    element("history").before(section("retouch", "Clone and blur",
      make("p", { class: "hint" }, "Clone: Alt and click where colours come from, then paint."),
      make("div", { class: "buttons" }, make("button", { type: "button", id: "clone-again", onclick: () => this.forget() }, "Choose another place")),
      ...this.settings.choice("way", "The blur tool", [["softer", "blurs"], ["sharper", "sharpens"]]),
      ...this.settings.slider("width", "Radius", { min: LEAST_WIDTH, max: MOST_WIDTH, step: 1 }, (pixels) => `${pixels} px`)));
    this.set({});
  }

  set(change) {
    Object.assign(this, change);
    this.settings.show();
  }

  drag(event, own) {
    return new BrushDrag(this.painting, event, { ...own, mirror: "", blend: "over", hidden: false });
  }

  blur(event) {
    const isSofter = this.way === "softer", picture = new Blurred(this.painting, (this.width / REACH) * this.painting.viewer.film.times, isSofter ? 1 : SHARPER);
    return this.drag(event, { name: isSofter ? "Blur" : "Sharpen", picture });
  }

  smudge(event) {
    const { opacity, hardness } = this.painting.brush, picture = new Smudged(this.painting, CARRIED * opacity, hardness);
    return this.drag(event, { name: "Smudge", picture, opacity: 1 });
  }

  forget() {
    this.set({ point: null, step: null });
    this.mark.hidden = true;
    this.painting.choose("clone");
    this.painting.say("Click where colours come from.");
  }

  // Take colours from this place of the model.
  aim(event) {
    const [x, y] = this.painting.place(event);
    this.set({ point: this.painting.viewer.seen(x, y), step: null });
    this.hover([x, y]);
    this.painting.say("");
  }

  // The view, as long as nothing in it moves.
  get view() {
    const { viewed, film: { width, height } } = this.painting.viewer;
    return `${viewed} ${width} ${height}`;
  }

  // Where the source is seen, in CSS pixels; null if it is not.
  get source() {
    const { camera, canvas } = this.painting.viewer, size = [canvas.clientWidth, canvas.clientHeight], at = camera.placeOf(this.point, size);
    const seen = at && this.painting.viewer.seen(...at);
    return seen && Math.hypot(...seen.map((x, n) => x - this.point[n])) < SAME * camera.radius ? at : null;
  }

  clone(event) {
    const { painting } = this, [x, y] = painting.place(event), { times } = painting.viewer.film;
    if (!this.point) {
      this.aim(event);
      return painting.say("Now paint where these colours go.");
    }
    if (!this.step || this.seenFrom !== this.view) {
      const from = this.source;
      if (!from) return painting.say("The place that colours come from is hidden: Alt and click on another one.");
      this.set({ step: [Math.round((x - from[0]) * times), Math.round((from[1] - y) * times)], seenFrom: this.view });
    }
    painting.say("");
    return this.drag(event, { name: "Clone", picture: new Copied(painting, this.step) });
  }

  // Show where colours come from while the pointer is at a place, in CSS pixels, or nowhere.
  hover(at) {
    if (!this.point) return;
    const isHeld = this.step && this.seenFrom === this.view, { times } = this.painting.viewer.film;
    const from = isHeld ? at && [at[0] - this.step[0] / times, at[1] + this.step[1] / times] : this.source;
    this.mark.hidden = !from;
    if (from) this.mark.style.transform = `translate(${from[0]}px, ${from[1]}px)`;
  }

  leave() {
    this.mark.hidden = true;
  }
}
