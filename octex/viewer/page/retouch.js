// Tools that paint with the colours of the view: clone, smudge, blur and sharpen. Each makes an image of the view, one texel
// a pixel, which retouch.frag draws where the brush comes.

import { clippedBox, grownBox, movedBox } from "./boxes.js";
import { BrushDrag } from "./brush.js";
import { element, make } from "./elements.js";
import { Settings, section } from "./panel.js";
import { planesFor } from "./programs.js";

const TILE = 16; // pixels along the sides of tiles, in which colours of the view are drawn
const COPY = 0, BLUR = 1, SMUDGE = 2; // as u_action has them
const BLUR_REACH = 2.5; // standard deviations
const SHARPEN = -1; // share of the blur to add: below 0 it is taken away
const SMUDGE_DABS = 8; // within the fading edge of the brush: fewer dabs leave ribs
const SMUDGE_SHARE = 0.97; // the most that a dab carries along
const MIN_RADIUS = 1, MAX_RADIUS = 20; // pixels of the blur
const SAME_SURFACE = 0.02; // of the model's radius: farther in front, something hides the clone source

// The display of plain colours in a channel: of the page, or of a composite (see preview.js).
function colorDisplay({ viewer: { gpu, display, parts }, strokes }, composite, channel) {
  const facing = (composite ? [composite] : parts).some(({ header }) => header.split[0] > 0);
  const sentStrokes = composite ? null : Object.create(strokes, { current: { value: null } });
  const plain = { mode: "channel", channel, filter: "quadratic", footprints: true, level: gpu.deepest, divider: 0, highlight: null };
  return { ...display, ...plain, facing, strokes: sentStrokes, composite };
}

// Compile the programs, so that the first stroke does not wait for them.
export function compilePrograms(painting, composite = null, channel = "base_color") {
  const { gpu, parts: [part], display } = painting.viewer, plain = colorDisplay(painting, composite, channel);
  gpu.programs.use("surface", composite ?? part, plain, planesFor(composite ?? part, plain));
  gpu.programs.use("retouch", part, display, 0);
}

// The colours of the view without light, drawn on demand. The background has alpha 0.
export class ViewColors {
  // `drawn` is called with each box that is drawn. With a `composite`, its octree is looked up, in a channel.
  constructor({ viewer, strokes }, { drawn = () => {}, composite = null, channel = "base_color" } = {}) {
    const { gpu } = viewer;
    strokes.prepareView();
    this.size = strokes.size;
    this.viewer = viewer;
    this.drawn = drawn;
    this.gbuffer = strokes.gbuffer;
    this.target = gpu.target(`view colors${composite ? ` of ${channel} in a composite` : ""}`, ...this.size, [gpu.gl.RGBA8], this.gbuffer);
    this.columns = Math.ceil(this.size[0] / TILE);
    this.drawnTiles = new Set();
    this.display = colorDisplay({ viewer, strokes }, composite, channel);
  }

  // Draw the missing tiles of a box; neighbours in a row are drawn at once.
  require(box) {
    const [left, bottom, right, top] = clippedBox(box, this.size) ?? [0, 0, 0, 0], at = (pixel) => Math.floor(pixel / TILE), end = at(right - 1) + 1;
    for (let row = at(bottom); row <= at(top - 1); row++) {
      const isMissing = (column) => column < end && !this.drawnTiles.has(row * this.columns + column);
      for (let column = at(left); column < end; column++) {
        const first = column;
        for (; isMissing(column); column++) this.drawnTiles.add(row * this.columns + column);
        if (column > first) this.draw(clippedBox([first * TILE, row * TILE, column * TILE, (row + 1) * TILE], this.size));
      }
    }
  }

  draw(box) {
    const { viewer: { gpu, camera }, target } = this, { gl } = gpu;
    gpu.drawInBox(target, box, () => {
      gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
      gpu.drawLayer(this.display, camera, this.gbuffer, target, null, { hasGBuffer: true });
    });
    this.drawn(box);
  }
}

// An image that a stroke paints, made from colours of the view. `prepare` draws a box of it, before the brush covers that.
export class BrushImage {
  constructor(painting, composite = null) {
    this.gpu = painting.viewer.gpu;
    this.colors = new ViewColors(painting, { drawn: (box) => this.colorsDrawn(box), composite });
    this.target = this.newTarget(composite ? "preview" : "retouched");
    [this.texture] = this.target.textures;
    this.buffer = this.target.buffer;
  }

  colorsDrawn() {}

  newTarget(name) {
    return this.gpu.target(name, ...this.colors.size, [this.gpu.gl.RGBA8]);
  }

  // Run retouch.frag from one target to another, in a box.
  run(action, from, to, box, { step = [0, 0], sigma = 1, share = 1, disc = [0, 0, 1, 1], before = from, paint = null } = {}) {
    const { gpu, colors } = this, { gl } = gpu, { viewer } = colors, program = gpu.programs.use("retouch", viewer.parts[0], viewer.display, 0);
    const clipped = clippedBox(box, colors.size);
    if (!clipped) return;
    gpu.bind(program, { u_from: from.textures[0], u_before: before.textures[0], u_positions: colors.gbuffer.textures[0], u_paint: paint ?? from.textures[0] });
    program.set({ u_action: action, u_step: step, u_sigma: sigma, u_share: share, u_disc: disc });
    gpu.drawInBox(to, clipped, () => gl.drawArrays(gl.TRIANGLES, 0, 3));
  }
}

// The view, moved by whole pixels.
class ClonedImage extends BrushImage {
  constructor(painting, offset) {
    super(painting);
    this.offset = offset;
  }

  prepare(box) {
    this.colors.require(movedBox(box, this.offset.map((n) => -n)));
    this.run(COPY, this.colors.target, this.target, box, { step: this.offset });
  }
}

// The view, blurred by a share; or sharpened, if that is below 0.
class BlurredImage extends BrushImage {
  constructor(painting, sigma, share) {
    super(painting);
    this.sigma = sigma;
    this.share = share;
    this.rows = this.newTarget("blurred rows");
  }

  prepare(box) {
    const { sigma, share, rows, colors: { target } } = this, reach = Math.ceil(BLUR_REACH * sigma);
    this.colors.require(grownBox(box, reach, reach));
    this.run(BLUR, target, rows, grownBox(box, 0, reach), { step: [1, 0], sigma });
    this.run(BLUR, rows, this.target, box, { step: [0, 1], sigma, share, before: target });
  }
}

// The view, whose colours the brush drags along.
class SmudgedImage extends BrushImage {
  constructor(painting, share, hardness) {
    super(painting);
    this.share = share;
    this.hardness = hardness;
    this.place = null; // of the last dab
    this.copy = this.newTarget("smudged before");
  }

  // Begin with the colours of the view.
  colorsDrawn(box) {
    this.run(COPY, this.colors.target, this.target, box);
  }

  prepare(box, from, to) {
    const radius = to[2];
    this.place ??= from.slice(0, 2).map(Math.round);
    const start = this.place, distance = Math.hypot(to[0] - start[0], to[1] - start[1]);
    const dabs = Math.floor(distance / Math.max((radius * (1 - this.hardness)) / SMUDGE_DABS, 1));
    this.colors.require(box);
    for (let n = 1; n <= dabs; n++) {
      const next = start.map((x, axis) => Math.round(x + ((to[axis] - x) * n) / dabs));
      this.dab(next.map((x, axis) => x - this.place[axis]), next, radius);
      this.place = next;
    }
  }

  dab(step, [x, y], radius) {
    const reach = Math.ceil(radius) + 1, box = [x - reach, y - reach, x + reach, y + reach], length = Math.max(...step.map(Math.abs));
    const around = grownBox(box, length, length);
    this.colors.require(around);
    this.run(COPY, this.target, this.copy, around);
    this.run(SMUDGE, this.copy, this.target, box, { step, share: this.share, disc: [x, y, radius, this.hardness] });
  }
}

export class Retouch {
  constructor(painting) {
    this.painting = painting;
    this.point = null; // the clone source, on the model
    this.offset = null; // from the source to the brush in pixels of the screen, for the view `offsetView`
    this.radius = 4;
    this.effect = "blur";
    this.build();
  }

  build() {
    this.mark = make("div", { id: "clone-source", hidden: true });
    this.painting.stage.append(this.mark);
    this.settings = new Settings("blur-", () => this, (change) => this.set(change));
    element("history").before(section("retouch", "Clone and blur",
      make("p", { class: "hint" }, "Clone: Alt and click sets the source, then paint."),
      make("div", { class: "buttons" }, make("button", { type: "button", id: "clone-again", onclick: () => this.forgetSource() }, "Set another source")),
      ...this.settings.choice("effect", "The blur tool", [["blur", "blurs"], ["sharpen", "sharpens"]]),
      ...this.settings.slider("radius", "Radius", { min: MIN_RADIUS, max: MAX_RADIUS, step: 1 }, (pixels) => `${pixels} px`)));
    this.set({});
  }

  set(change) {
    Object.assign(this, change);
    this.settings.show();
  }

  drag(event, overrides) {
    return new BrushDrag(this.painting, event, { ...overrides, mirror: "", blend: "over", hidden: false });
  }

  blur(event) {
    const isBlur = this.effect === "blur", sigma = (this.radius / BLUR_REACH) * this.painting.viewer.pixelRatio;
    return this.drag(event, { name: isBlur ? "Blur" : "Sharpen", image: new BlurredImage(this.painting, sigma, isBlur ? 1 : SHARPEN) });
  }

  smudge(event) {
    const { opacity, hardness } = this.painting.brush, image = new SmudgedImage(this.painting, SMUDGE_SHARE * opacity, hardness);
    return this.drag(event, { name: "Smudge", image, opacity: 1 });
  }

  forgetSource() {
    this.set({ point: null, offset: null });
    this.mark.hidden = true;
    this.painting.selectTool("clone");
    this.painting.showMessage("Click to set the source.");
  }

  setSource(event) {
    const [x, y] = this.painting.place(event), point = this.painting.viewer.surfaceAt(x, y);
    if (!point) return this.painting.showMessage("Click on the model to set the source.");
    this.set({ point, offset: null });
    this.hover([x, y]);
    this.painting.showMessage("The source is set: now paint.");
  }

  // A key of the view and its size.
  get view() {
    const { viewKey, screenSize: { width, height } } = this.painting.viewer;
    return `${viewKey} ${width} ${height}`;
  }

  // The position of the source in the image, in CSS pixels; null if it is hidden.
  get sourcePosition() {
    const { viewer } = this.painting, { camera, canvas } = viewer;
    const position = camera.project(this.point, [canvas.clientWidth, canvas.clientHeight]), visible = position && viewer.surfaceAt(...position);
    return visible && Math.hypot(...visible.map((x, n) => x - this.point[n])) < SAME_SURFACE * camera.radius ? position : null;
  }

  clone(event) {
    const { painting } = this, [x, y] = painting.place(event), { pixelRatio } = painting.viewer;
    if (!this.point) return this.setSource(event);
    if (!this.offset || this.offsetView !== this.view) {
      const from = this.sourcePosition;
      if (!from) return painting.showMessage("The source is hidden: press Set another source, or Alt and click.");
      this.set({ offset: [Math.round((x - from[0]) * pixelRatio), Math.round((from[1] - y) * pixelRatio)], offsetView: this.view });
    }
    painting.showMessage("");
    return this.drag(event, { name: "Clone", image: new ClonedImage(painting, this.offset) });
  }

  // Mark the source of the colours for a pointer at a place, in CSS pixels; null if the pointer has left.
  hover(place) {
    if (!this.point) return;
    const isFixed = this.offset && this.offsetView === this.view, { pixelRatio } = this.painting.viewer;
    const from = isFixed ? place && [place[0] - this.offset[0] / pixelRatio, place[1] + this.offset[1] / pixelRatio] : this.sourcePosition;
    this.mark.hidden = !from;
    if (from) this.mark.style.transform = `translate(${from[0]}px, ${from[1]}px)`;
  }

  leave() {
    this.mark.hidden = true;
  }
}
