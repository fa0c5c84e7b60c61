// The stroke that is drawn, and those that the server has not painted yet: what the picture shows of them.

import { CLOSE, Dabs, clipped, joined, reached } from "./dabs.js";
import { Mirror, product } from "./mirror.js";

export const MOST_ANGLE = 85; // degrees beyond which nothing is painted, unless it is set otherwise
const FADE = 10; // and over which paint fades

const cosine = (degrees) => Math.cos((degrees * Math.PI) / 180);
const toLight = (code) => (code <= 10.31475 ? code / 255 / 12.92 : ((code / 255 + 0.055) / 1.055) ** 2.4);
const LIGHTS = Float32Array.from({ length: 256 }, (_, code) => toLight(code));

const UNIT = 27; // of textures: the strokes that are sent
const PLAIN = new Float32Array(4);

// How paint p meets what is there, b: with a coverage a it makes b·(1 − a·cover) + a·added of each component. Here are
// cover and added for each blend mode, and tables of both by p's code. See BLENDS in octex/painting/picture.py.
const BLENDS = { over: (p) => [1, p], multiply: (p) => [1 - p, 0], screen: (p) => [p, p], add: (p) => [0, p] };
const TABLES = Object.fromEntries(Object.entries(BLENDS).map(([name, blend]) => [name, [0, 1].map((n) => LIGHTS.map((p) => blend(p)[n]))]));

// A stroke as it looks until it is painted; see beneath.js.
const seen = (stroke) => ({ ...stroke, ...stroke?.look });

export class Strokes {
  constructor(viewer) {
    this.viewer = viewer;
    this.current = null; // color and values of channels or a picture, opacity, hardness, blend, box
    this.sent = []; // what is not painted yet: number, box, coverage, opacity, blend, color and values, or planes of colors
    this.planes = []; // that they paint; of each the texture `composed` has how they cover what is there, and what they add
    this.composedBox = null; // the part of it that is not 0: left, bottom, right, top
    this.size = [0, 0];
  }

  // Make all anew, as after a lost context.
  build() {
    this.size = [0, 0];
    this.fit();
    this.compose();
  }

  // Be ready for strokes on the view as it is now. Those that were sent from another one are then no longer shown.
  fit() {
    const { gpu, film, camera, look, parts } = this.viewer, { width, height } = film, view = this.viewer.viewed;
    const isLarge = this.size[0] === width && this.size[1] === height;
    if (isLarge && this.view === view) return;
    if (!isLarge) this.allocate(width, height);
    this.view = view;
    this.isMoved = Boolean(look.moved ?? look.patch);
    this.sent = [];
    this.gbuffer = gpu.targetOfTwo("stroke gbuffer", width, height);
    gpu.drawGBuffer({ ...look, paint: this, asksPart: true }, camera, this.gbuffer, width, height);
    const { origin, size } = parts[0].header, root = [size, 0, 0, 0, 0, size, 0, 0, 0, 0, size, 0, ...origin, 1];
    this.camera = product(camera.projection(), product(camera.view, root));
    this.eye = camera.position.map((x, n) => (x - origin[n]) / size);
  }

  // What the picture is of, as strokes carry it.
  get seen() {
    const { film: { width, height }, camera, look: { patch, moved } } = this.viewer, [{ K, pose }] = camera.file("", width, height).cameras;
    return { camera: { width, height, K, pose }, moved: patch ? patch.moved : moved, patch: patch?.spot };
  }

  // Make the textures as large as the picture is.
  allocate(width, height) {
    const { gpu } = this.viewer, { gl } = gpu;
    this.size = [width, height];
    this.mirror = new Mirror(this.viewer);
    this.target = gpu.target("stroke", width, height, [gl.R8]);
    this.smooth(gl.TEXTURE_2D, this.target.textures[0]);
    this.layer([]);
    gpu.clear(this.target);
  }

  // Read a texture between its texels.
  smooth(kind, texture) {
    const { gl } = this.viewer.gpu;
    gl.bindTexture(kind, texture);
    for (const name of ["MIN", "MAG"]) gl.texParameteri(kind, gl[`TEXTURE_${name}_FILTER`], gl.LINEAR);
    for (const name of ["S", "T"]) gl.texParameteri(kind, gl[`TEXTURE_WRAP_${name}`], gl.CLAMP_TO_EDGE);
  }

  // Have layers for planes, two each.
  layer(planes) {
    const { gl } = this.viewer.gpu, [width, height] = planes.length ? this.size : [1, 1];
    gl.deleteTexture(this.composed ?? null);
    this.composed = gl.createTexture();
    this.smooth(gl.TEXTURE_2D_ARRAY, this.composed);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA16F, width, height, Math.max(2 * planes.length, 1));
    Object.assign(this, { planes, composedBox: null });
  }

  // How a stroke's paint meets the components of planes: of each four numbers of how it covers, and four that it adds.
  paintOf({ color, colors, values = {}, blend = "over", plain = blend, strength = 1 }) {
    const found = new Map(), part = this.viewer.parts[0];
    if (colors) found.set(part.channel("base_color").at[0], [new Float32Array(4), new Float32Array(4)]);
    for (const [name, value] of Object.entries({ base_color: color, ...values })) {
      const channel = part.channel(name);
      if (!value || !channel) continue;
      const { at: [plane, slot], range: [low, high], space } = channel;
      if (!found.has(plane)) found.set(plane, [new Float32Array(4), new Float32Array(4)]);
      value.forEach((given, k) => {
        const [covers, adds] = BLENDS[plain](space === "data" ? given : LIGHTS[Math.round(given)]);
        found.get(plane)[0][slot + k] = strength * covers;
        found.get(plane)[1][slot + k] = (strength * (adds - covers * low)) / (high - low);
      });
    }
    return found;
  }

  // Begin a stroke, drawn on the view as it is now.
  begin(brush) {
    this.fit();
    this.viewer.gpu.clear(this.target);
    this.mirror.fit(brush, this.view, this.camera, this.size);
    const { flow = 1, spacing = 0 } = brush;
    this.current = { ...brush, box: null, dabs: flow < 1 || spacing > CLOSE ? new Dabs(this) : null, ...this.partsOf(brush) };
  }

  // Draw from one place of the pen to another, with radii and strengths, in CSS pixels; returns what of the picture has
  // changed.
  extend(from, to) {
    const { viewer, current } = this, [, height] = this.size, { times } = viewer.film;
    const ends = [from, to].map(([x, y, radius, strength = 1]) => [x * times, height - y * times, radius * times, strength]);
    for (const picture of [current.picture, current.look?.picture]) picture?.ready?.(reached(ends), ...ends);
    const box = current.dabs ? current.dabs.draw(...ends, current) : this.line(...ends);
    if (!box) return null;
    current.box = joined(current.box, box);
    const [left, bottom, right, top] = box;
    return [left / times, (height - top) / times, right / times, (height - bottom) / times];
  }

  // Draw a line from one place to another, in pixels from the lower left; returns its box.
  line(from, to) {
    const { viewer, current, target } = this, { gpu } = viewer, { gl } = gpu, box = clipped(reached([from, to]), this.size);
    if (!box) return null;
    const program = gpu.programs.use("stroke", viewer.parts[0], viewer.look, 0);
    gl.enable(gl.BLEND);
    gl.blendEquation(gl.MAX);
    gl.uniform4f(program.at("u_line"), from[0], from[1], to[0], to[1]);
    gl.uniform2f(program.at("u_radii"), from[2], to[2]);
    gl.uniform2f(program.at("u_strengths"), from[3], to[3]);
    gl.uniform1f(program.at("u_hardness"), current.hardness);
    gpu.drawOn(target, box, () => gl.drawArrays(gl.TRIANGLES, 0, 3));
    gl.disable(gl.BLEND);
    return box;
  }

  // Cover all of a box (left, bottom, right, top).
  cover(box) {
    const { gpu } = this.viewer;
    gpu.drawOn(this.target, box, () => gpu.gl.clearBufferfv(gpu.gl.COLOR, 0, [1, 0, 0, 0]));
    this.current.box = box;
  }

  // End the stroke; returns its box in pixels from the upper left, the coverage in it, of a picture the planes of its
  // colors, and in its look those of the picture that it leads to; or null for none.
  end() {
    const { gpu } = this.viewer, { current, size } = this;
    this.current = null;
    if (!current?.box) return null;
    const [left, bottom, right, top] = current.box, width = right - left, height = top - bottom;
    const [drawn, picture, led] = [this.target, current.picture, current.look?.picture].map((each) => each && gpu.codes(each, current.box)), pixels = width * height;
    const coverage = new Uint8Array(pixels), [colors, leads] = [picture, led].map((each) => each && new Uint8Array(3 * pixels)), known = led && new Uint8Array(pixels);
    for (let row = 0, n = 0; row < height; row++) {
      for (let at = 4 * width * (height - 1 - row), column = 0; column < width; column++, at += 4, n++) {
        coverage[n] = picture ? Math.round((drawn[at] * picture[at + 3]) / 255) : drawn[at];
        if (!coverage[n]) continue;
        for (let k = 0; picture && k < 3; k++) colors[k * pixels + n] = picture[at + k];
        for (let k = 0; led && k < 3; k++) leads[k * pixels + n] = led[at + k];
        if (led) known[n] = led[at + 3];
      }
    }
    if (!coverage.some((each) => each > 0)) return null;
    const own = picture && { color: undefined, values: undefined, colors, picture: null };
    const look = led ? { ...current.look, picture: null, colors: leads, known } : current.look;
    const isOnPart = current.part >= 0 && !this.mirror.isOf(current, this.view);
    const parts = isOnPart && this.partsIn(this.gbuffer, current.box), row = (n) => height - 1 - Math.floor(n / width);
    const shown = parts ? coverage.map((each, n) => (parts[row(n) * width + (n % width)] === current.part ? each : 0)) : coverage;
    return { ...current, ...own, look, shown, dabs: null, box: [left, size[1] - top, right, size[1] - bottom], coverage };
  }

  // The part that a stroke stays on, if it stays on what is at its beginning, and that of its other half; −1: any part.
  partsOf({ at, begin: [x, y] = [] }) {
    if (!at) return { part: -1, otherPart: -1 };
    const { times } = this.viewer.film, column = Math.floor(x * times), row = Math.floor(this.size[1] - y * times);
    const [part, otherPart] = [this.gbuffer, this.mirror.gbuffer].map((gbuffer) => (gbuffer ? this.partsIn(gbuffer, [column, row, column + 1, row + 1])[0] : -1));
    return { part, otherPart };
  }

  // The numbers of the parts that pixels of a box see, the lowest row first; −1 for none.
  partsIn(gbuffer, box) {
    const read = this.viewer.gpu.words(gbuffer, 1, box);
    return Int32Array.from({ length: read.length / 4 }, (_, n) => read[4 * n + 3] - 1);
  }

  // Show a stroke until it is painted.
  keep(stroke) {
    this.sent.push(stroke);
    this.compose();
  }

  // Strokes up to a number are painted.
  painted(number) {
    const before = this.sent.length;
    this.sent = this.sent.filter((stroke) => stroke.number > number);
    if (this.sent.length !== before) this.compose();
  }

  // Lay strokes that are not painted yet over each other, as they will be painted: how they cover what is there, and
  // what they add. Only the part of the picture is made where they are, or were.
  compose() {
    const { gl } = this.viewer.gpu, [, height] = this.size;
    if (!this.sent.length) return;
    const sent = this.sent.map(seen), paints = sent.map((stroke) => this.paintOf(stroke)), planes = new Set(paints.flatMap((paint) => [...paint.keys()]));
    if ([...planes].some((plane) => !this.planes.includes(plane))) this.layer([...new Set([...this.planes, ...planes])]);
    const own = sent.map(({ box: [left, top, right, bottom] }) => [left, height - bottom, right, height - top]).reduce(joined);
    const box = joined(this.composedBox, own), [left, bottom, right, top] = box, wide = right - left, high = top - bottom;
    this.composedBox = own;
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.composed);
    this.planes.forEach((plane, number) => {
      const sums = [0, 1].map(() => new Float32Array(4 * wide * high));
      sent.forEach((stroke, n) => {
        const isPicture = stroke.colors && plane === this.viewer.parts[0].channel("base_color").at[0];
        if (paints[n].has(plane)) this.lay(stroke, paints[n].get(plane), isPicture, box, ...sums);
      });
      sums.forEach((sum, which) => gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, left, bottom, 2 * number + which, wide, high, 1, gl.RGBA, gl.FLOAT, sum));
    });
  }

  // Lay a stroke's paint of a plane over what is there. A picture has its own red, green and blue where it is known, the
  // plane's first.
  lay({ box: [left, top, right, bottom], coverage, shown = coverage, colors, known, opacity, blend = "over" }, [covers, adds], isPicture, [first, low, end], cover, added) {
    const [, height] = this.size, wide = end - first, [coverOf, addedOf] = TABLES[blend], area = coverage.length;
    const lanes = [0, 1, 2, 3].filter((k) => covers[k] || adds[k] || (isPicture && k < 3));
    for (let row = top, n = 0; row < bottom; row++) {
      for (let at = 4 * (wide * (height - 1 - row - low) + left - first), column = left; column < right; column++, at += 4, n++) {
        const share = (opacity * shown[n]) / 255;
        if (!share) continue;
        for (const k of lanes) {
          const code = isPicture && k < 3 && (!known || known[n]) ? colors[k * area + n] : -1;
          const own = share * (code < 0 ? covers[k] : coverOf[code]), more = share * (code < 0 ? adds[k] : addedOf[code]);
          cover[at + k] += own * (1 - cover[at + k]);
          added[at + k] += more - own * added[at + k];
        }
      }
    }
  }

  // What the picture is drawn with.
  get textures() {
    const [u_strokesPositions, u_strokesDirections] = this.gbuffer.textures, [u_mirrorPositions] = (this.mirror.gbuffer ?? this.gbuffer).textures;
    const [u_stroke] = this.target.textures, u_colors = seen(this.current).picture?.texture ?? u_stroke;
    return { u_stroke, u_colors, u_strokesPositions, u_strokesDirections, u_mirrorPositions };
  }

  set(program, width, height, planes) {
    const { current, viewer } = this, { gl } = viewer.gpu, isHere = this.view === viewer.viewed;
    const shown = seen(current ?? this.sent.at(-1)), { opacity = 0, angle = MOST_ANGLE, backFaces = false, hidden = false, blend = "over", picture } = shown;
    const isWhole = angle >= 90, paint = current && !current.picture ? this.paintOf(seen(current)) : new Map(), layers = this.planes;
    viewer.gpu.bind(program, { u_strokes: this.composed }, UNIT, gl.TEXTURE_2D_ARRAY);
    gl.uniform1iv(program.at("u_strokesAt[0]"), Array.from({ length: planes }, (_, n) => 2 * layers.indexOf(n)));
    ["u_cover", "u_added"].forEach((name, which) => {
      const all = Array.from({ length: planes }, (_, n) => [...(paint.get(n)?.[which] ?? PLAIN)]);
      gl.uniform4fv(program.at(`${name}[0]`), all.flat());
    });
    gl.uniform1i(program.at("u_picturePlane"), current && picture ? viewer.parts[0].channel("base_color").at[0] : -1);
    const [[covers, adds], [light, more]] = [0, 1].map(BLENDS[blend]);
    gl.uniform3f(program.at("u_blend"), covers, light - covers, more - adds);
    gl.uniform1f(program.at("u_opacity"), isHere && current ? opacity : 0);
    gl.uniform2f(program.at("u_picture"), width, height);
    gl.uniform3f(program.at("u_angles"), isWhole ? -1 : cosine(Math.max(angle - FADE, 0)), isWhole ? -2 : cosine(angle), backFaces ? 1 : 0);
    const canTurn = !viewer.look.moved && !this.isMoved && !viewer.parts[0].header.mesh?.posed;
    gl.uniform1i(program.at("u_strokesView"), !this.sent.length ? 0 : isHere ? 1 : canTurn ? 2 : 0);
    gl.uniformMatrix4fv(program.at("u_strokesCamera"), false, this.camera);
    gl.uniform3fv(program.at("u_strokesEye"), this.eye);
    gl.uniform1i(program.at("u_hidden"), hidden ? 1 : 0);
    const { mirror } = this, isMirrored = (stroke) => mirror.isOf(stroke, this.view);
    const whole = this.sent.length > 0 && this.sent.every(isMirrored), own = isHere && current !== null && isMirrored(current);
    gl.uniform2f(program.at("u_mirrored"), whole ? 1 : 0, own ? opacity : 0);
    gl.uniform2i(program.at("u_parts"), shown.part ?? -1, shown.otherPart ?? -1);
    if (!whole && !own) return;
    gl.uniformMatrix4fv(program.at("u_mirrorCamera"), false, mirror.camera);
    gl.uniform3fv(program.at("u_mirrorEye"), mirror.eye);
  }
}
