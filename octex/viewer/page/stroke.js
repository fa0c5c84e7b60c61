// The current stroke, and strokes that the texture does not have yet: the surface shader blends both over the texture.

import { boxOfDiscs, clippedBox, unionOf } from "./boxes.js";
import { Dabs, LINE_SPACING } from "./dabs.js";
import { Mirror, product } from "./mirror.js";

export const DEFAULT_ANGLE = 85; // degrees from the view: surface that is tilted more is not painted
const FADE = 10; // degrees below that, over which paint fades

const cosine = (degrees) => Math.cos((degrees * Math.PI) / 180);
const toLight = (code) => (code <= 10.31475 ? code / 255 / 12.92 : ((code / 255 + 0.055) / 1.055) ** 2.4);
const LIGHTS = Float32Array.from({ length: 256 }, (_, code) => toLight(code));

const SENT_UNIT = 27; // texture unit of the sent strokes
const NO_PAINT = new Float32Array(4);

// Blend modes. With coverage a, paint p turns the value b into b·(1 − a·cover) + a·added. These are cover and added of p,
// and tables of both by p's code. See BLENDS in octex/painting/image.py.
const BLENDS = { over: (p) => [1, p], multiply: (p) => [1 - p, 0], screen: (p) => [p, p], add: (p) => [0, p] };
const TABLES = Object.fromEntries(Object.entries(BLENDS).map(([name, blend]) => [name, [0, 1].map((n) => LIGHTS.map((p) => blend(p)[n]))]));

// A stroke as the page shows it before the texture has it; see preview.js.
const previewed = (stroke) => ({ ...stroke, ...stroke?.preview });

export class Strokes {
  constructor(viewer) {
    this.viewer = viewer;
    this.current = null; // settings of the brush, `box` (what is drawn of it), and `dabs` if it has any
    this.sent = []; // strokes with their command, box and coverage, and colours of pixels if they paint an image
    this.planes = []; // that sent strokes paint: `composed` has two layers for each, what covers old values and what is added
    this.composedBox = null; // the part of these layers that is not 0
    this.size = [0, 0];
  }

  // Create all GPU objects, at first and after a lost context.
  build() {
    this.size = [0, 0];
    this.current = null;
    this.prepareView();
    this.compose();
  }

  // Prepare for strokes on the current view. Sent strokes of another view are then no longer shown.
  prepareView() {
    const { gpu, screenSize: { width, height }, camera, display, parts, viewKey } = this.viewer;
    const isSameSize = this.size[0] === width && this.size[1] === height;
    if (isSameSize && this.viewKey === viewKey) return;
    if (!isSameSize) this.allocate(width, height);
    this.viewKey = viewKey;
    this.isPosed = Boolean(display.moment ?? display.patch);
    this.sent = [];
    this.gbuffer = gpu.uintTarget("stroke gbuffer", width, height);
    gpu.drawGBuffer({ ...display, strokes: this, writesPart: true }, camera, this.gbuffer, width, height);
    const { origin, size } = parts[0].header, root = [size, 0, 0, 0, 0, size, 0, 0, 0, 0, size, 0, ...origin, 1];
    this.camera = product(camera.projection(), product(camera.view, root));
    this.eye = camera.position.map((x, n) => (x - origin[n]) / size);
  }

  // The fields of commands that describe the view.
  get viewFields() {
    const { screenSize: { width, height }, camera, display: { patch, moment } } = this.viewer, [{ K, pose }] = camera.file("", width, height).cameras;
    return { camera: { width, height, K, pose }, moved: patch ? patch.moment : moment, patch: patch?.spot };
  }

  // Create textures in the image's size.
  allocate(width, height) {
    const { gpu } = this.viewer, { gl } = gpu;
    this.size = [width, height];
    this.mirror = new Mirror(this.viewer);
    this.target = gpu.target("stroke", width, height, [gl.R8]);
    this.setLinearFilter(gl.TEXTURE_2D, this.target.textures[0]);
    this.allocateLayers([]);
    gpu.clear(this.target);
  }

  setLinearFilter(kind, texture) {
    const { gl } = this.viewer.gpu;
    gl.bindTexture(kind, texture);
    for (const name of ["MIN", "MAG"]) gl.texParameteri(kind, gl[`TEXTURE_${name}_FILTER`], gl.LINEAR);
    for (const name of ["S", "T"]) gl.texParameteri(kind, gl[`TEXTURE_WRAP_${name}`], gl.CLAMP_TO_EDGE);
  }

  // Create the layers of sent strokes, two for each plane.
  allocateLayers(planes) {
    const { gl } = this.viewer.gpu, [width, height] = planes.length ? this.size : [1, 1];
    gl.deleteTexture(this.composed ?? null);
    this.composed = gl.createTexture();
    this.setLinearFilter(gl.TEXTURE_2D_ARRAY, this.composed);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA16F, width, height, Math.max(2 * planes.length, 1));
    Object.assign(this, { planes, composedBox: null });
  }

  // The plane of the base colour, which images paint.
  get colorPlane() {
    return this.viewer.parts[0].channel("base_color").at[0];
  }

  // The blend of a stroke's plain colours and values: for each plane, cover and added of its four components.
  blendOf({ color, colors, values = {}, blend = "over", plainBlend = blend, strength = 1 }) {
    const blends = new Map(), part = this.viewer.parts[0], none = () => [new Float32Array(4), new Float32Array(4)];
    if (colors) blends.set(this.colorPlane, none());
    for (const [name, value] of Object.entries({ base_color: color, ...values })) {
      const channel = part.channel(name);
      if (!value || !channel) continue;
      const { at: [plane, slot], range: [low, high], space } = channel;
      if (!blends.has(plane)) blends.set(plane, none());
      const [cover, added] = blends.get(plane);
      value.forEach((component, k) => {
        const [covers, adds] = BLENDS[plainBlend](space === "data" ? component : LIGHTS[Math.round(component)]);
        cover[slot + k] = strength * covers;
        added[slot + k] = (strength * (adds - covers * low)) / (high - low);
      });
    }
    return blends;
  }

  // Begin a stroke on the current view.
  begin(brush) {
    this.prepareView();
    this.viewer.gpu.clear(this.target);
    this.mirror.prepare(brush, this.viewKey, this.camera, this.size);
    const { flow = 1, spacing = 0 } = brush;
    this.current = { ...brush, box: null, dabs: flow < 1 || spacing > LINE_SPACING ? new Dabs(this) : null, ...this.partsOf(brush) };
  }

  // Draw from one place of the brush to another: x, y, radius and strength, in CSS pixels. Returns the box that changes.
  extend(from, to) {
    const { viewer, current } = this, [, height] = this.size, { pixelRatio } = viewer;
    const ends = [from, to].map(([x, y, radius, strength = 1]) => [x * pixelRatio, height - y * pixelRatio, radius * pixelRatio, strength]);
    for (const image of [current.image, current.preview?.image]) image?.prepare?.(boxOfDiscs(ends), ...ends);
    const box = current.dabs ? current.dabs.draw(...ends, current) : this.drawLine(...ends);
    if (!box) return null;
    current.box = unionOf(current.box, box);
    const [left, bottom, right, top] = box;
    return [left / pixelRatio, (height - top) / pixelRatio, right / pixelRatio, (height - bottom) / pixelRatio];
  }

  // Draw a line in pixels from the lower left; returns its box.
  drawLine(from, to) {
    const { viewer, current, target } = this, { gpu } = viewer, { gl } = gpu, box = clippedBox(boxOfDiscs([from, to]), this.size);
    if (!box) return null;
    const program = gpu.programs.use("stroke", viewer.parts[0], viewer.display, 0);
    gl.enable(gl.BLEND);
    gl.blendEquation(gl.MAX);
    const [u_radii, u_strengths] = [2, 3].map((k) => [from[k], to[k]]);
    program.set({ u_line: [from.slice(0, 2), to.slice(0, 2)], u_radii, u_strengths, u_hardness: current.hardness });
    gpu.drawInBox(target, box, () => gl.drawArrays(gl.TRIANGLES, 0, 3));
    gl.disable(gl.BLEND);
    return box;
  }

  // Cover a box fully.
  coverBox(box) {
    const { gpu } = this.viewer;
    gpu.drawInBox(this.target, box, () => gpu.gl.clearBufferfv(gpu.gl.COLOR, 0, [1, 0, 0, 0]));
    this.current.box = box;
  }

  // End the stroke. Returns it with its box (rows from above), its coverage, and the colours of its image, if it has one;
  // the preview gets those of the previewed image. Returns null for a stroke that covers nothing.
  end() {
    const { gpu } = this.viewer, { current, size } = this;
    this.current = null;
    if (!current?.box) return null;
    const [left, bottom, right, top] = current.box, width = right - left, height = top - bottom, pixels = width * height;
    const read = (target) => target && gpu.readBytes(target, current.box), colorsFor = (bytes) => bytes && new Uint8Array(3 * pixels);
    const drawn = read(this.target), image = read(current.image), preview = read(current.preview?.image);
    const coverage = new Uint8Array(pixels), colors = colorsFor(image), previewColors = colorsFor(preview), isPreviewed = preview && new Uint8Array(pixels);
    for (let row = 0, n = 0; row < height; row++) {
      for (let at = 4 * width * (height - 1 - row), column = 0; column < width; column++, at += 4, n++) {
        coverage[n] = image ? Math.round((drawn[at] * image[at + 3]) / 255) : drawn[at];
        if (!coverage[n]) continue;
        for (let k = 0; image && k < 3; k++) colors[k * pixels + n] = image[at + k];
        for (let k = 0; preview && k < 3; k++) previewColors[k * pixels + n] = preview[at + k];
        if (preview) isPreviewed[n] = preview[at + 3];
      }
    }
    if (!coverage.some((code) => code > 0)) return null;
    const withImage = image && { color: undefined, values: undefined, colors, image: null };
    const withPreview = preview && { preview: { ...current.preview, image: null, colors: previewColors, isPreviewed } };
    const staysOnPart = current.part >= 0 && !this.mirror.isOf(current, this.viewKey);
    const parts = staysOnPart && this.readParts(this.gbuffer, current.box), row = (n) => height - 1 - Math.floor(n / width);
    const shown = parts ? coverage.map((code, n) => (parts[row(n) * width + (n % width)] === current.part ? code : 0)) : coverage;
    return { ...current, ...withImage, ...withPreview, shown, dabs: null, box: [left, size[1] - top, right, size[1] - bottom], coverage };
  }

  // The connected part that a stroke with `at` stays on, and that of its mirror image; −1: any part.
  partsOf({ at, begin: [x, y] = [] }) {
    if (!at) return { part: -1, mirroredPart: -1 };
    const { pixelRatio } = this.viewer, column = Math.floor(x * pixelRatio), row = Math.floor(this.size[1] - y * pixelRatio);
    const pixel = [column, row, column + 1, row + 1];
    const [part, mirroredPart] = [this.gbuffer, this.mirror.gbuffer].map((gbuffer) => (gbuffer ? this.readParts(gbuffer, pixel)[0] : -1));
    return { part, mirroredPart };
  }

  // Read the numbers of the parts at pixels of a box, the lowest row first; −1 for the background.
  readParts(gbuffer, box) {
    const directions = this.viewer.gpu.readUints(gbuffer, 1, box);
    return Int32Array.from({ length: directions.length / 4 }, (_, n) => directions[4 * n + 3] - 1);
  }

  // Show a stroke until the texture has it.
  addSent(stroke) {
    this.sent.push(stroke);
    this.compose();
  }

  // Remove the strokes whose commands the server has finished, up to a number.
  removeFinished(number) {
    const before = this.sent.length;
    this.sent = this.sent.filter((stroke) => stroke.command.number > number);
    if (this.sent.length !== before) this.compose();
  }

  // Blend all sent strokes into layers. Only the boxes of strokes, now and before, are uploaded.
  compose() {
    const { gl } = this.viewer.gpu, [, height] = this.size;
    if (!this.sent.length) return;
    const sent = this.sent.map(previewed), blends = sent.map((stroke) => this.blendOf(stroke)), planes = new Set(blends.flatMap((blend) => [...blend.keys()]));
    if ([...planes].some((plane) => !this.planes.includes(plane))) this.allocateLayers([...new Set([...this.planes, ...planes])]);
    const sentBox = sent.map(({ box: [left, top, right, bottom] }) => [left, height - bottom, right, height - top]).reduce(unionOf);
    const box = unionOf(this.composedBox, sentBox), [left, bottom, right, top] = box, width = right - left, rows = top - bottom;
    this.composedBox = sentBox;
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.composed);
    this.planes.forEach((plane, number) => {
      const sums = [0, 1].map(() => new Float32Array(4 * width * rows));
      sent.forEach((stroke, n) => {
        const isImage = stroke.colors && plane === this.colorPlane;
        if (blends[n].has(plane)) this.blendStroke(stroke, blends[n].get(plane), isImage, box, ...sums);
      });
      sums.forEach((sum, which) => gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, left, bottom, 2 * number + which, width, rows, 1, gl.RGBA, gl.FLOAT, sum));
    });
  }

  // Blend a stroke over the `cover` and `added` of a plane, in a box. An image paints the first three components in its own
  // colours, where these are known.
  blendStroke(stroke, [covers, adds], isImage, [first, low, end], cover, added) {
    const { box: [left, top, right, bottom], coverage, shown = coverage, colors, isPreviewed, opacity, blend = "over" } = stroke;
    const [, height] = this.size, width = end - first, [coverOf, addedOf] = TABLES[blend], area = coverage.length;
    const components = [0, 1, 2, 3].filter((k) => covers[k] || adds[k] || (isImage && k < 3));
    for (let row = top, n = 0; row < bottom; row++) {
      for (let at = 4 * (width * (height - 1 - row - low) + left - first), column = left; column < right; column++, at += 4, n++) {
        const share = (opacity * shown[n]) / 255;
        if (!share) continue;
        for (const k of components) {
          const code = isImage && k < 3 && (!isPreviewed || isPreviewed[n]) ? colors[k * area + n] : -1;
          const a = share * (code < 0 ? covers[k] : coverOf[code]), b = share * (code < 0 ? adds[k] : addedOf[code]);
          cover[at + k] += a * (1 - cover[at + k]);
          added[at + k] += b - a * added[at + k];
        }
      }
    }
  }

  // The textures that surface.frag reads.
  get textures() {
    const [u_strokesPositions, u_strokesDirections] = this.gbuffer.textures, [u_mirrorPositions] = (this.mirror.gbuffer ?? this.gbuffer).textures;
    const [u_stroke] = this.target.textures, u_colors = previewed(this.current).image?.texture ?? u_stroke;
    return { u_stroke, u_colors, u_strokesPositions, u_strokesDirections, u_mirrorPositions };
  }

  setUniforms(program, width, height, planes) {
    const { current, viewer, mirror, sent } = this, { gl } = viewer.gpu, isSameView = this.viewKey === viewer.viewKey;
    const stroke = previewed(current ?? sent.at(-1)), { opacity = 0, angle = DEFAULT_ANGLE, backFaces = false, hidden = false, blend = "over", image } = stroke;
    const blends = current && !current.image ? this.blendOf(previewed(current)) : new Map(), anyAngle = angle >= 90;
    viewer.gpu.bind(program, { u_strokes: this.composed }, SENT_UNIT, gl.TEXTURE_2D_ARRAY);
    const isMirrored = (each) => mirror.isOf(each, this.viewKey), [[covers, adds], [light, more]] = [0, 1].map(BLENDS[blend]);
    const areMirrored = sent.length > 0 && sent.every(isMirrored), currentIsMirrored = isSameView && current !== null && isMirrored(current);
    const canReproject = !viewer.display.moment && !this.isPosed && !viewer.parts[0].header.mesh?.posed;
    const ofPlanes = (which) => Array.from({ length: planes }, (_, n) => [...(blends.get(n)?.[which] ?? NO_PAINT)]);
    program.set({
      u_strokesAt: Array.from({ length: planes }, (_, n) => 2 * this.planes.indexOf(n)), u_cover: ofPlanes(0), u_added: ofPlanes(1),
      u_imagePlane: current && image ? this.colorPlane : -1, u_blend: [covers, light - covers, more - adds],
      u_opacity: isSameView && current ? opacity : 0, u_image: [width, height], u_hidden: hidden,
      u_angles: [anyAngle ? -1 : cosine(Math.max(angle - FADE, 0)), anyAngle ? -2 : cosine(angle), backFaces],
      u_strokesView: !sent.length ? 0 : isSameView ? 1 : canReproject ? 2 : 0, u_strokesCamera: this.camera, u_strokesEye: this.eye,
      u_mirrored: [areMirrored, currentIsMirrored ? opacity : 0], u_parts: [stroke.part ?? -1, stroke.mirroredPart ?? -1],
    });
    if (areMirrored || currentIsMirrored) program.set({ u_mirrorCamera: mirror.camera, u_mirrorEye: mirror.eye });
  }
}
