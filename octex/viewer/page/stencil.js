// A stencil: an image over the view. The brush paints through it, or the whole image is painted at once.

import { boxOfPixels } from "./boxes.js";
import { sendStroke } from "./brush.js";
import { wheelFactor } from "./controls.js";
import { element, make } from "./elements.js";
import { IMAGE_TYPES, readImage } from "./images.js";
import { Settings, button, section } from "./panel.js";

const FIT = 0.6; // share of the view that a new image takes
const MAX_OVERLAY = 1024; // pixels along a side of the overlay
const KEY_STEP = 1, SHIFT_STEP = 10; // pixels that an arrow key moves, without and with Shift
const KEY_TURN = Math.PI / 180, KEY_SCALE = 1.02;
const MIN_SCALE = 1e-3, MAX_SCALE = 1e3;

// The settings that replace the brush's, if the brush paints through a stencil.
export const stencilOverrides = ({ stencil }) => (stencil.bitmap && stencil.isThrough ? stencil.overrides("Stencil") : {});

export class Stencil {
  constructor(painting) {
    this.painting = painting;
    this.bitmap = null;
    this.isThrough = true;
    this.isMirrored = false;
    this.opacity = 0.6; // of the overlay
    this.colors = "own"; // or "dark", "light": the brush's colour where the image is so
    this.changes = 0; // of its placement and settings
    this.pointers = new Map();
    this.build();
  }

  build() {
    const { stage } = this.painting, corners = ["nw", "ne", "se", "sw"].map((name) => make("span", { class: name }));
    this.overlay = make("canvas", { "aria-hidden": "true" });
    this.frame = make("div", { id: "stencil", hidden: true }, this.overlay, ...corners);
    stage.append(this.frame);
    this.file = make("input", { type: "file", accept: IMAGE_TYPES, hidden: true, "aria-label": "Image", onchange: ({ target }) => target.files[0] && this.painting.external.take(target.files[0]) });
    const settings = (this.settings = new Settings("stencil-", () => this, (change) => this.set(change)));
    this.controls = make("div", { hidden: true },
      ...settings.slider("opacity", "Opacity on the screen", { min: 0.05, max: 1, step: 0.01 }),
      settings.check("isThrough", "the brush paints through it"),
      ...settings.choice("colors", "Paint", [["own", "its colours"], ["dark", "my colour where it is dark"], ["light", "my colour where it is light"]]),
      settings.check("isMirrored", "mirror it with the strokes"),
      make("div", { class: "buttons" }, button("stencil-stamp", "Stamp it", () => this.stamp()), button("stencil-remove", "Remove", () => this.remove())));
    element("history").before(section("stencil-section", "Stencil",
      make("p", { class: "hint" }, "An image over the model. Choose the tool Stencil to move it; drag a corner to turn and scale it."),
      make("div", { class: "buttons" }, button("stencil-choose", "Choose an image …", () => this.file.click())), this.file, this.controls));
    const on = (name, run) => this.frame.addEventListener(name, (event) => {
      event.preventDefault();
      event.stopPropagation();
      run(event);
    }, { passive: false });
    on("pointerdown", (event) => this.down(event));
    on("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) on(name, (event) => this.pointers.delete(event.pointerId));
    on("wheel", (event) => this.zoom(wheelFactor(event), this.positionOf(event)));
    new ResizeObserver(() => this.show()).observe(this.painting.viewer.canvas);
  }

  // Tell the user what to do when the tool is selected without an image.
  begin() {
    if (!this.bitmap) this.painting.showMessage("Choose an image, or drop one on the page.");
  }

  // Lay a file over the view, or show what is wrong with it.
  async read(file) {
    try {
      this.place((await readImage(file)).bitmap);
      this.painting.showMessage("");
    } catch (error) {
      this.painting.showMessage(error.message);
    } finally {
      this.file.value = "";
    }
  }

  // Place an image in the middle of the view.
  place(bitmap) {
    const { viewer: { canvas } } = this.painting, reduction = Math.min(1, MAX_OVERLAY / Math.max(bitmap.width, bitmap.height));
    this.bitmap?.close();
    this.bitmap = bitmap;
    this.overlay.width = Math.max(Math.round(bitmap.width * reduction), 1);
    this.overlay.height = Math.max(Math.round(bitmap.height * reduction), 1);
    const context = this.overlay.getContext("2d");
    context.imageSmoothingQuality = "high";
    context.drawImage(bitmap, 0, 0, this.overlay.width, this.overlay.height);
    const scale = FIT * Math.min(canvas.clientWidth / bitmap.width, canvas.clientHeight / bitmap.height);
    this.set({ x: 0, y: 0, angle: 0, scale });
    this.painting.selectTool("stencil");
  }

  remove() {
    this.bitmap?.close();
    this.bitmap = null;
    this.set({});
    if (this.painting.tool.name === "stencil") this.painting.selectTool("brush");
  }

  // Change the placement (x, y of its middle in CSS pixels from the view's middle, angle, scale), or other settings.
  set(change) {
    Object.assign(this, change);
    this.scale = Math.min(Math.max(this.scale, MIN_SCALE), MAX_SCALE);
    this.changes++;
    this.settings.show();
    this.frame.hidden = this.controls.hidden = !this.bitmap;
    this.show();
  }

  show() {
    if (!this.bitmap) return;
    const { frame, bitmap, scale, x, y, angle } = this, { canvas } = this.painting.viewer;
    const [width, height] = [bitmap.width * scale, bitmap.height * scale];
    frame.style.width = `${width}px`;
    frame.style.height = `${height}px`;
    frame.style.transform = `translate(${canvas.clientWidth / 2 + x - width / 2}px, ${canvas.clientHeight / 2 + y - height / 2}px) rotate(${angle}rad)`;
    this.overlay.style.opacity = this.opacity;
  }

  // The position of a pointer, in CSS pixels from the view's middle.
  positionOf({ clientX, clientY }) {
    const { left, top, width, height } = this.painting.viewer.canvas.getBoundingClientRect();
    return [clientX - left - width / 2, clientY - top - height / 2];
  }

  down(event) {
    document.activeElement?.blur();
    this.frame.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { position: this.positionOf(event), isCorner: event.target.tagName === "SPAN" });
  }

  // One pointer moves the image; at a corner it turns and scales it. Two pointers each hold a point of it.
  move(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    const from = pointer.position, to = this.positionOf(event), others = [...this.pointers.values()].filter((each) => each !== pointer);
    pointer.position = to;
    if (others.length) this.rotateAndScale(from, to, others[0].position);
    else if (pointer.isCorner) this.rotateAndScale(from, to, [this.x, this.y]);
    else this.set({ x: this.x + to[0] - from[0], y: this.y + to[1] - from[1] });
  }

  // Rotate and scale around a centre, so that `from` comes to `to`.
  rotateAndScale(from, to, [x, y]) {
    const [a, b] = [from[0] - x, from[1] - y], [c, d] = [to[0] - x, to[1] - y], square = a * a + b * b;
    if (square < 1) return;
    const [real, imaginary] = [(a * c + b * d) / square, (a * d - b * c) / square], [u, v] = [this.x - x, this.y - y];
    const change = { angle: this.angle + Math.atan2(imaginary, real), scale: this.scale * Math.hypot(real, imaginary) };
    this.set({ ...change, x: x + real * u - imaginary * v, y: y + imaginary * u + real * v });
  }

  zoom(factor, [x, y]) {
    this.set({ scale: this.scale * factor, x: x + factor * (this.x - x), y: y + factor * (this.y - y) });
  }

  // The keys of the tool, with their functions.
  keys(event) {
    if (!this.bitmap || event.target.matches?.("input, select, button, summary")) return {};
    const step = event.shiftKey ? SHIFT_STEP : KEY_STEP, move = (x, y) => () => this.set({ x: this.x + x * step, y: this.y + y * step });
    const turn = (by) => () => this.set({ angle: this.angle + by * step * KEY_TURN }), scale = (factor) => () => this.set({ scale: this.scale * factor });
    return {
      arrowleft: move(-1, 0), arrowright: move(1, 0), arrowup: move(0, -1), arrowdown: move(0, 1),
      "+": scale(KEY_SCALE), "=": scale(KEY_SCALE), "-": scale(1 / KEY_SCALE), ",": turn(-1), ".": turn(1), "<": turn(-1), ">": turn(1),
      enter: () => this.stamp(), delete: () => this.remove(), escape: () => this.painting.selectTool("brush"),
    };
  }

  // The settings that replace the brush's.
  overrides(name) {
    const { brush } = this.painting;
    return { name, image: this.image(), mirror: this.isMirrored ? brush.mirror : "" };
  }

  // The stencil drawn in the size of the view, as a target with its texture and the box of its pixels.
  image() {
    const { viewer, brush } = this.painting, { gpu, screenSize: { width, height, pixelRatio } } = viewer, { gl } = gpu;
    const target = gpu.target("stencil", width, height, [gl.RGBA8]), color = this.colors === "own" ? "" : String(brush.color);
    const state = `${this.changes} ${color} ${pixelRatio}`;
    if (target.state === state) return target;
    const context = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d", { willReadFrequently: true });
    context.imageSmoothingQuality = "high";
    context.setTransform(pixelRatio, 0, 0, -pixelRatio, width / 2, height / 2); // rows from below, as in textures
    context.translate(this.x, this.y);
    context.rotate(this.angle);
    context.scale(this.scale, this.scale);
    context.drawImage(this.bitmap, -this.bitmap.width / 2, -this.bitmap.height / 2);
    const { data } = context.getImageData(0, 0, width, height);
    if (color) fillWithColor(data, brush.color, this.colors === "dark");
    target.box = boxOfPixels(width, height, (n) => data[4 * n + 3]);
    target.texture = target.textures[0];
    gl.bindTexture(gl.TEXTURE_2D, target.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
    target.state = state;
    return target;
  }

  // Paint the whole image.
  stamp() {
    const { painting } = this, { strokes, brush, viewer } = painting, why = painting.blockReason;
    if (!this.bitmap || painting.pen) return;
    painting.showMessage(why);
    if (why) return;
    const overrides = this.overrides("Image");
    if (!overrides.image.box) return painting.showMessage("The image lies beside the view: move it over the model.");
    const stroke = { ...brush, ...overrides };
    strokes.begin({ ...stroke, offset: painting.mirrorOffset, ...strokes.viewFields, preview: painting.preview.styleOf(stroke) });
    strokes.coverBox(overrides.image.box);
    sendStroke(painting, strokes.end());
    viewer.invalidate();
  }
}

// Fill pixels with a colour; they are opaque where the image is dark, or light.
function fillWithColor(data, color, whereDark) {
  for (let at = 0; at < data.length; at += 4) {
    const luma = (0.2126 * data[at] + 0.7152 * data[at + 1] + 0.0722 * data[at + 2]) / 255;
    data[at + 3] *= whereDark ? 1 - luma : luma;
    for (let k = 0; k < 3; k++) data[at + k] = color[k];
  }
}
