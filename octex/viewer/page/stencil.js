// A stencil: an image laid over the view, that the brush paints through, or that is put down as it lies.

import { send } from "./brush.js";
import { wheelTimes } from "./controls.js";
import { boxOf } from "./dabs.js";
import { element, make } from "./elements.js";
import { KINDS, readImage } from "./images.js";
import { Settings, section } from "./panel.js";

const SHARE = 0.6; // of the picture, that a new image takes
const MOST_SHOWN = 1024; // pixels along a side of the overlay
const STEP = 1, LEAP = 10; // pixels, by a key and with Shift
const TURN = Math.PI / 180, LARGER = 1.02; // by a key
const LEAST_SCALE = 1e-3, MOST_SCALE = 1e3;

// The brush as it paints: through the stencil, if there is one.
export const through = ({ stencil }) => (stencil.bitmap && stencil.isThrough ? stencil.stroke("Stencil") : {});

export class Stencil {
  constructor(painting) {
    this.painting = painting;
    this.bitmap = null;
    this.isThrough = true;
    this.isMirrored = false;
    this.opacity = 0.6; // of the overlay
    this.colors = "own";
    this.changes = 0; // of what the stencil paints
    this.pointers = new Map();
    this.build();
  }

  build() {
    const { stage } = this.painting, corners = ["nw", "ne", "se", "sw"].map((name) => make("span", { class: name }));
    this.shown = make("canvas", { "aria-hidden": "true" });
    this.frame = make("div", { id: "stencil", hidden: true }, this.shown, ...corners);
    stage.append(this.frame);
    this.file = make("input", { type: "file", accept: KINDS, hidden: true, "aria-label": "Picture", onchange: ({ target }) => target.files[0] && this.painting.external.take(target.files[0]) });
    const act = (id, text, run) => make("button", { type: "button", id, onclick: run }, text);
    const settings = (this.settings = new Settings("stencil-", () => this, (change) => this.set(change)));
    this.controls = make("div", { hidden: true },
      ...settings.slider("opacity", "Opacity on the screen", { min: 0.05, max: 1, step: 0.01 }),
      settings.check("isThrough", "the brush paints through it"),
      ...settings.choice("colors", "Paint", [["own", "its colours"], ["dark", "my colour where it is dark"], ["light", "my colour where it is light"]]),
      settings.check("isMirrored", "mirror it with the strokes"),
      make("div", { class: "buttons" }, act("stencil-put", "Paint it", () => this.putDown()), act("stencil-remove", "Remove", () => this.remove())));
    element("history").before(section("stencil-section", "Stencil",
      make("p", { class: "hint" }, "A picture over the model. Choose the tool Stencil to move it; drag a corner to turn and scale it."),
      make("div", { class: "buttons" }, act("stencil-choose", "Choose a picture …", () => this.file.click())), this.file, this.controls));
    const on = (name, run) => this.frame.addEventListener(name, (event) => {
      event.preventDefault();
      event.stopPropagation();
      run(event);
    }, { passive: false });
    on("pointerdown", (event) => this.down(event));
    on("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) on(name, (event) => this.pointers.delete(event.pointerId));
    on("wheel", (event) => this.zoom(wheelTimes(event), this.at(event)));
    new ResizeObserver(() => this.show()).observe(this.painting.viewer.canvas);
  }

  // The tool is chosen: show its controls.
  begin() {
    if (!this.bitmap) this.painting.say("Choose a picture, or drop one on the page.");
  }

  // Lay a file over the view; says what is wrong with it.
  async read(file) {
    try {
      this.lay((await readImage(file)).bitmap);
      this.painting.say("");
    } catch (error) {
      this.painting.say(error.message);
    } finally {
      this.file.value = "";
    }
  }

  lay(bitmap) {
    const { viewer: { canvas } } = this.painting, times = Math.min(1, MOST_SHOWN / Math.max(bitmap.width, bitmap.height));
    this.bitmap?.close();
    this.bitmap = bitmap;
    this.shown.width = Math.max(Math.round(bitmap.width * times), 1);
    this.shown.height = Math.max(Math.round(bitmap.height * times), 1);
    const context = this.shown.getContext("2d");
    context.imageSmoothingQuality = "high";
    context.drawImage(bitmap, 0, 0, this.shown.width, this.shown.height);
    const scale = SHARE * Math.min(canvas.clientWidth / bitmap.width, canvas.clientHeight / bitmap.height);
    this.set({ x: 0, y: 0, angle: 0, scale });
    this.painting.choose("stencil");
  }

  remove() {
    this.bitmap?.close();
    this.bitmap = null;
    this.set({});
    if (this.painting.tool.name === "stencil") this.painting.choose("brush");
  }

  // Its middle x, y in CSS pixels from the picture's middle, its angle, its scale, and how it paints.
  set(change) {
    Object.assign(this, change);
    this.scale = Math.min(Math.max(this.scale, LEAST_SCALE), MOST_SCALE);
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
    this.shown.style.opacity = this.opacity;
  }

  // A place of the picture from its middle.
  at({ clientX, clientY }) {
    const { left, top, width, height } = this.painting.viewer.canvas.getBoundingClientRect();
    return [clientX - left - width / 2, clientY - top - height / 2];
  }

  down(event) {
    document.activeElement?.blur();
    this.frame.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { at: this.at(event), isCorner: event.target.tagName === "SPAN" });
  }

  // One pointer moves it, or turns and scales it around its middle; two hold a place of it each.
  moved(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    const from = pointer.at, to = this.at(event), others = [...this.pointers.values()].filter((each) => each !== pointer);
    pointer.at = to;
    if (others.length) this.turn(from, to, others[0].at);
    else if (pointer.isCorner) this.turn(from, to, [this.x, this.y]);
    else this.set({ x: this.x + to[0] - from[0], y: this.y + to[1] - from[1] });
  }

  // Turn and scale around a place, so that one place comes to another.
  turn(from, to, [x, y]) {
    const [a, b] = [from[0] - x, from[1] - y], [c, d] = [to[0] - x, to[1] - y], square = a * a + b * b;
    if (square < 1) return;
    const [real, imaginary] = [(a * c + b * d) / square, (a * d - b * c) / square], [u, v] = [this.x - x, this.y - y];
    const change = { angle: this.angle + Math.atan2(imaginary, real), scale: this.scale * Math.hypot(real, imaginary) };
    this.set({ ...change, x: x + real * u - imaginary * v, y: y + imaginary * u + real * v });
  }

  zoom(times, [x, y]) {
    this.set({ scale: this.scale * times, x: x + times * (this.x - x), y: y + times * (this.y - y) });
  }

  // What keys do while the tool is chosen.
  keys(event) {
    if (!this.bitmap || event.target.matches?.("input, select, button, summary")) return {};
    const step = event.shiftKey ? LEAP : STEP, move = (x, y) => () => this.set({ x: this.x + x * step, y: this.y + y * step });
    const turn = (by) => () => this.set({ angle: this.angle + by * step * TURN }), scale = (times) => () => this.set({ scale: this.scale * times });
    return {
      arrowleft: move(-1, 0), arrowright: move(1, 0), arrowup: move(0, -1), arrowdown: move(0, 1),
      "+": scale(LARGER), "=": scale(LARGER), "-": scale(1 / LARGER), ",": turn(-1), ".": turn(1), "<": turn(-1), ">": turn(1),
      enter: () => this.putDown(), delete: () => this.remove(), escape: () => this.painting.choose("brush"),
    };
  }

  // What a stroke with it paints.
  stroke(name) {
    const { brush } = this.painting;
    return { name, picture: this.picture(), mirror: this.isMirrored ? brush.mirror : "" };
  }

  // It as it lies, with a pixel for each of the view.
  picture() {
    const { viewer, brush } = this.painting, { gpu, film: { width, height, times } } = viewer, { gl } = gpu;
    const target = gpu.target("stencil", width, height, [gl.RGBA8]), color = this.colors === "own" ? "" : String(brush.color);
    const state = `${this.changes} ${color} ${times}`;
    if (target.state === state) return target;
    const context = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d", { willReadFrequently: true });
    context.imageSmoothingQuality = "high";
    context.setTransform(times, 0, 0, -times, width / 2, height / 2); // rows from below, as the GPU has them
    context.translate(this.x, this.y);
    context.rotate(this.angle);
    context.scale(this.scale, this.scale);
    context.drawImage(this.bitmap, -this.bitmap.width / 2, -this.bitmap.height / 2);
    const { data } = context.getImageData(0, 0, width, height);
    if (color) colored(data, brush.color, this.colors === "dark");
    target.box = boxOf(width, height, (n) => data[4 * n + 3]);
    target.texture = target.textures[0];
    gl.bindTexture(gl.TEXTURE_2D, target.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
    target.state = state;
    return target;
  }

  // Paint all of it as it lies.
  putDown() {
    const { painting } = this, { strokes, brush, viewer } = painting, why = painting.hindrance;
    if (!this.bitmap || painting.pen) return;
    painting.say(why);
    if (why) return;
    const own = this.stroke("Picture");
    if (!own.picture.box) return painting.say("The picture lies beside the view: move it over the model.");
    strokes.begin({ ...brush, offset: painting.offset, ...own, ...strokes.seen, look: painting.beneath.look({ ...brush, ...own }) });
    strokes.cover(own.picture.box);
    send(painting, strokes.end());
    viewer.move();
  }
}

// Give pixels one colour; where they are light, or dark, they get transparent.
function colored(data, color, isDark) {
  for (let at = 0; at < data.length; at += 4) {
    const luma = (0.2126 * data[at] + 0.7152 * data[at + 1] + 0.0722 * data[at + 2]) / 255;
    data[at + 3] *= isDark ? 1 - luma : luma;
    for (let k = 0; k < 3; k++) data[at + k] = color[k];
  }
}
