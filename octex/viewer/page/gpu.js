// Draws the parts of a page with WebGL2, and reads back what pixels show.
//
// An image is drawn in two passes: the G-buffer has the rest position of the surface at each pixel, then the octree is
// sampled there. Translucent surface takes a second pair of passes. `display` says what is drawn; see viewer.js.

import { walkUniforms } from "./walk.js";
import { ROW, fromBytePlanes } from "./octree.js";
import { FACINGS, LEVELS } from "./legend.js";
import { fromZigzag } from "./mesh.js";
import { Programs, TILE, planesFor, showsRelief, showsSource } from "./programs.js";

const CHANNEL_KINDS = { srgb: 0, linear: 0, data: 1, direction: 2 }; // as u_kind has them
const CLEAR = 0.5 / 255, OPAQUE = 1 - CLEAR; // alphas that 8 bits round to 0 and to 1
// Ranges of alpha, low to below high, of the surface that the G-buffer gets.
const OPAQUE_ONLY = [OPAQUE, 2], TRANSLUCENT_ONLY = [CLEAR, OPAQUE], VISIBLE = [CLEAR, 2], ANY_ALPHA = null;
const MAX_CUBES = 1 << 20;
const CUBE_COLORS = { depth: 1, facing: 2 }; // as u_by has them
const CELL_COLORS = { u_levels: LEVELS, u_facings: FACINGS };
const LIGHT_UNIT = 28, MOTION_UNIT = 30; // texture units; lower ones are the octree's and the image's
const BACKGROUND = [0.925, 0.93, 0.94, 1];

const areaOf = ([left, bottom, right, top]) => (right - left) * (top - bottom);

export class Gpu {
  constructor(canvas, shaders, studio, parts) {
    this.canvas = canvas;
    this.maxCubes = MAX_CUBES; // that are drawn
    this.background = BACKGROUND;
    this.studio = studio; // the header's entry of the studio light, and its stream
    this.parts = parts;
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!this.gl) throw new Error("this browser has no WebGL2");
    this.programs = new Programs(this.gl, shaders, parts);
    this.build();
  }

  // The deepest level of any part that fits into textures.
  get deepest() {
    return Math.max(...this.parts.map((part) => part.deepest));
  }

  // Create all GPU objects, at first and after a lost context.
  build() {
    this.programs.clear();
    this.targets = {};
    for (const part of this.parts) part.build(this.gl);
    this.light = this.studioLight();
  }

  // Create the texture of the studio light, see light.glsl.
  studioLight() {
    const { gl } = this, [{ numbers }, bytes] = this.studio, rows = Math.ceil(numbers / ROW), halves = new Uint16Array(ROW * rows);
    fromBytePlanes(bytes, numbers, 0).forEach((step, n) => (halves[n] = (n ? halves[n - 1] : 0) + fromZigzag(step)));
    const texture = this.parts[0].texture(gl.R16F, rows);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, rows, gl.RED, gl.HALF_FLOAT, halves);
    return texture;
  }

  setLight(program) {
    const [{ tables, reflectances }] = this.studio, [first, height, width] = tables.at(-1);
    this.bind(program, { u_studio: this.light }, LIGHT_UNIT);
    program.set({ u_tables: tables, u_reflectances: [first + height * width, reflectances] });
  }

  // Set the uniforms that pose a part at a time of an animation.
  setPose(program, part, { animation, time }) {
    const { motion, frames, header } = part;
    if (!frames.has(animation)) frames.set(animation, part.floatTexture(motion.animations[animation].texels));
    const { before, after, share } = motion.framesAt(animation, time);
    this.bind(program, { u_links: part.links, u_frames: frames.get(animation) }, MOTION_UNIT);
    const { bones, entries } = motion.header, u_root = [header.origin, header.size];
    program.set({ u_frame: [before, after], u_share: share, u_firstTarget: 3 * bones, u_turns: entries[1], u_root });
  }

  // Bind textures to a program's samplers, by name, to units from `first` on.
  bind(program, textures, first = 0, kind = this.gl.TEXTURE_2D) {
    const { gl } = this;
    Object.entries(textures).forEach(([name, texture], n) => {
      gl.activeTexture(gl.TEXTURE0 + first + n);
      gl.bindTexture(kind, texture);
      program.set({ [name]: first + n });
    });
    gl.activeTexture(gl.TEXTURE0);
  }

  // Bind an octree and other textures to a program, and set its uniforms.
  setOctree(program, part, display, textures = {}) {
    part.stores.forEach(({ name, kind, texture }, unit) => this.bind(program, { [name]: texture }, unit, kind));
    this.bind(program, textures, part.stores.length);
    program.set(walkUniforms(part.octree, Math.min(display.level, part.deepest)));
  }

  setCamera(program, camera, pixel = null, size = null) {
    program.set({ u_projection: camera.projection(pixel, size), u_view: camera.view });
  }

  // Draw the image in a size, or only a part of it: `scissor` is a box (left, bottom, width, height), `region` a box of the
  // root cell and of the image, see isInRegion of surface.frag. The rest of the image stays. While no mesh is loaded this
  // compiles the programs.
  draw(display, camera, width, height, scissor = null, region = null) {
    const { gl, canvas } = this;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.background);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (this.showsCubes(display)) this.drawCubes(display, camera);
    else this.drawSurface({ ...display, region, scissor }, camera, width, height);
  }

  // Draw the G-buffer of an image in a size, or of one pixel of it: the nearest surface whose alpha is in a range. The
  // translucent one is drawn over the depth of the opaque one, and must be drawn after it.
  drawGBuffer(display, camera, target, width, height, { pixel = null, alphas = ANY_ALPHA } = {}) {
    const { gl } = this, isTranslucent = alphas === TRANSLUCENT_ONLY;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, target.width, target.height);
    for (const number of [0, 1]) gl.clearBufferuiv(gl.COLOR, number, [0, 0, 0, 0]);
    if (isTranslucent) gl.clearBufferiv(gl.STENCIL, 0, [0]);
    else gl.clearBufferfi(gl.DEPTH_STENCIL, 0, 1, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
    const draw = (part, isLayered) => {
      gl.stencilFunc(gl.ALWAYS, this.parts.indexOf(part) + 1, 255);
      const layered = { ...display, mode: "layers" }, planes = isLayered ? planesFor(part, layered) : 0;
      const program = this.programs.use(isLayered ? "layers" : "gbuffer", part, layered, planes);
      if (isLayered) {
        this.setOctree(program, part, display);
        program.set({ u_footprints: display.footprints, u_alphas: alphas });
      }
      this.setCamera(program, camera, pixel, [width, height]);
      if (display.moment) this.setPose(program, part, display.moment);
      gl.bindVertexArray(part.surface);
      gl.drawElements(gl.TRIANGLES, part.mesh.triangles.length, gl.UNSIGNED_INT, 0);
    };
    const isLayered = (part) => alphas !== ANY_ALPHA && part.hasAlpha, parts = this.parts.filter((part) => part.mesh);
    if (!isTranslucent) for (const part of parts) if (!isLayered(part)) draw(part, false);
    for (const part of parts) if (isLayered(part)) draw(part, true);
    gl.bindVertexArray(null);
    gl.disable(gl.DEPTH_TEST);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.KEEP);
    gl.disable(gl.STENCIL_TEST);
  }

  // Call `draw` with a box (left, bottom, right, top) of a target bound and scissored.
  drawInBox({ buffer, width, height }, [left, bottom, right, top], draw) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, bottom, right - left, top - bottom);
    draw();
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // Run a program for the pixels of the G-buffer that show each part, in tiles: see tiles.vert. `use` prepares the program.
  drawVisible({ width, height }, use) {
    const { gl } = this, tiles = Math.ceil(width / TILE) * Math.ceil(height / TILE);
    gl.enable(gl.STENCIL_TEST);
    this.parts.forEach((part, number) => {
      const isReady = part.mesh ? part.octree.depth >= 0 : part.header.mesh;
      if (!isReady) return;
      gl.stencilFunc(gl.EQUAL, number + 1, 255);
      use(part, number);
      gl.drawArrays(gl.POINTS, 0, tiles);
    });
    gl.disable(gl.STENCIL_TEST);
  }

  drawSurface(display, camera, width, height) {
    const { gl } = this, { scissor, region } = display, isLayered = this.parts.some((part) => part.mesh && part.hasAlpha);
    const gbuffer = this.uintTarget("gbuffer", width, height);
    const image = this.target("image", width, height, [gl.RGBA8], gbuffer);
    if (scissor) {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(...scissor);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, image.buffer);
    gl.clearColor(...this.background);
    if (!region) gl.clear(gl.COLOR_BUFFER_BIT);
    this.drawLayer(display, camera, gbuffer, image, OPAQUE_ONLY, { hasGBuffer: (scissor || region) && !isLayered });
    let last = image;
    if (isLayered) {
      last = this.target("blended", width, height, [gl.RGBA8], gbuffer);
      this.copy(image, last);
      const textures = { u_background: image.textures[0] };
      this.drawLayer({ ...display, isTranslucent: true }, camera, gbuffer, last, TRANSLUCENT_ONLY, { textures });
    }
    gl.disable(gl.SCISSOR_TEST);
    this.present(last);
  }

  // Begin an image in another size: show the last one scaled to it.
  resize(display, camera, width, height) {
    const { gl, canvas, targets: { image: last } } = this, small = last && this.target("small", last.width, last.height, [gl.RGBA8]);
    if (last) this.copy(last, small);
    [canvas.width, canvas.height] = [width, height];
    const gbuffer = this.uintTarget("gbuffer", width, height), image = this.target("image", width, height, [gl.RGBA8], gbuffer);
    if (last) this.copy(small, image);
    this.drawGBuffer(display, camera, gbuffer, width, height, { alphas: OPAQUE_ONLY });
    this.present(image);
  }

  // Copy an image to the canvas. A browser shows the canvas only if it was cleared or drawn to; a blit alone is not enough.
  present(image) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.copy(image, { ...image, buffer: null });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  copy(from, to) {
    const { gl } = this, { width, height } = from;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, from.buffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, to.buffer);
    const isSameSize = to.width === width && to.height === height;
    gl.blitFramebuffer(0, 0, width, height, 0, 0, to.width, to.height, gl.COLOR_BUFFER_BIT, isSameSize ? gl.NEAREST : gl.LINEAR);
  }

  // Draw the nearest surface with an alpha in a range, over `u_background` if `textures` have it. With `hasGBuffer` the
  // G-buffer is drawn already. `display.composite` is an octree that is looked up instead of the parts'.
  drawLayer(display, camera, gbuffer, target, alphas, { textures: more = {}, hasGBuffer = false } = {}) {
    const { gl } = this, { width, height } = target, [u_positions, u_directions] = gbuffer.textures, textures = { u_positions, u_directions, ...more };
    if (!hasGBuffer) this.drawGBuffer(display, camera, gbuffer, width, height, { alphas });
    if (display.strokes) Object.assign(textures, display.strokes.textures);
    const compared = this.parts.find((part) => showsSource(part, display));
    if (compared) textures.u_source = this.drawSource(compared, display, camera, gbuffer);
    if (showsRelief(this.parts, display)) textures.u_heights = this.drawHeights(display, camera, gbuffer, textures);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    this.drawVisible(gbuffer, (part, number) => this.useSurface(display.composite ?? part, number, display, camera, textures, target));
  }

  // Draw the height of the surface at each pixel; returns the texture.
  drawHeights(display, camera, gbuffer, textures) {
    const { gl } = this, { scissor } = display, target = this.target("heights", gbuffer.width, gbuffer.height, [gl.R32UI], gbuffer);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    if (scissor) gl.scissor(scissor[0] - 1, scissor[1] - 1, scissor[2] + 2, scissor[3] + 2); // slopes need the neighbours too
    if (!display.region) gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    this.drawVisible(gbuffer, (part, number) => this.useSurface(part, number, { ...display, mode: "height" }, camera, textures, target));
    if (scissor) gl.scissor(...scissor);
    return target.textures[0];
  }

  // Prepare the program that draws the surface of a part.
  useSurface(part, number, display, camera, textures, { width, height }) {
    const planes = planesFor(part, display), program = this.programs.use("surface", part, display, planes);
    const { index, edge } = display.highlight?.part === number ? display.highlight : { index: [0, 0, 0], edge: 0 };
    const { relief, divider, footprints, region } = display, [low, high] = region ?? [[], []];
    this.setOctree(program, part, display, textures);
    this.setLight(program);
    display.strokes?.setUniforms(program, width, height, planes);
    program.set({
      ...CELL_COLORS, u_relief: relief, u_divider: divider * width, u_view: camera.view, u_footprints: footprints,
      u_kind: CHANNEL_KINDS[part.channel(display.channel)?.space] ?? 0, u_marked: index.map((n) => n * edge), u_markedEdge: edge,
      u_hasRegion: Boolean(region),
    });
    if (region) program.set({ u_regionLow: low.slice(0, 3), u_regionHigh: high.slice(0, 3), u_regionPart: [low.slice(3), high.slice(3)], u_size: [width, height] });
  }

  // Draw the colours of the model's own images; returns the texture.
  drawSource(part, display, camera, gbuffer) {
    const { gl } = this, { width, height } = gbuffer;
    const target = this.target("source", width, height, [gl.SRGB8_ALPHA8], gbuffer);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.EQUAL);
    const program = this.programs.use("source", part, display, 0);
    this.setCamera(program, camera);
    if (display.moment) this.setPose(program, part, display.moment);
    gl.bindVertexArray(part.surface);
    part.source.draw(gl, program);
    gl.bindVertexArray(null);
    gl.depthFunc(gl.LESS);
    gl.disable(gl.DEPTH_TEST);
    return target.textures[0];
  }

  // The deepest level, down to the chosen one, that has at most `maxCubes` cubes.
  cubesLevel(display) {
    const count = (level) => this.parts.reduce((sum, { octree }) => sum + octree.cubeCount(level), 0);
    let level = display.level;
    while (level > 0 && count(level) > this.maxCubes) level--;
    return level;
  }

  // Draw the cells of a level as cubes; for one pixel of an image in a size, draw the cells' numbers.
  drawCubes(display, camera, pixel = null, size = null) {
    const { gl } = this, level = this.cubesLevel(display);
    gl.enable(gl.DEPTH_TEST);
    for (const [number, part] of this.parts.entries()) {
      if (part.octree.depth < 0) continue;
      const { origin, size: edge, channels, flags } = part.header, cubes = part.cubesAt(level);
      const channel = part.channel(display.mode === "channel" ? display.channel : "base_color") ?? channels[0];
      const shown = { mode: "channel", channel: channel.name, isPicked: pixel !== null };
      const planes = 1 + Math.max(channel.at[0], display.mode === "facing" ? flags[0] : 0);
      const program = this.programs.use("cubes", part, shown, planes);
      this.setOctree(program, part, display);
      this.setCamera(program, camera, pixel, size);
      program.set({
        ...CELL_COLORS, u_part: number, u_kind: CHANNEL_KINDS[channel.space], u_by: CUBE_COLORS[display.mode] ?? 0, u_low: origin, u_edge: edge,
        u_camera: camera.position.map((x, n) => (x - origin[n]) / edge),
      });
      gl.bindVertexArray(cubes.array);
      gl.drawArraysInstanced(gl.TRIANGLES, 0, 18, cubes.count);
    }
    gl.disable(gl.DEPTH_TEST);
    gl.bindVertexArray(null);
  }

  showsCubes(display) {
    return display.cubes || !this.parts.some((part) => part.header.mesh);
  }

  // The depth along the view of the surface or cube at a pixel; null for the background.
  depthAt(display, camera, pixel, [width, height]) {
    if (this.showsCubes(display)) return this.probeCubes(display, camera, pixel, [width, height])?.depth ?? null;
    const target = this.uintTarget("probed depth", 1, 1);
    this.drawGBuffer({ ...display, writesDepth: true }, camera, target, width, height, { pixel, alphas: VISIBLE });
    return new Float32Array(this.readUints(target).buffer)[3] || null;
  }

  // The cell whose cube is at a pixel, with the part's number and the depth; null for the background.
  probeCubes(display, camera, pixel, size) {
    const { gl } = this, target = this.uintTarget("probed cubes", 1, 1);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, 1, 1);
    for (const number of [0, 1]) gl.clearBufferuiv(gl.COLOR, number, [0, 0, 0, 0]);
    gl.clearBufferfi(gl.DEPTH_STENCIL, 0, 1, 0);
    this.drawCubes(display, camera, pixel, size);
    const [[x, y, z, level], [cell, part, depthBits, isHit]] = [0, 1].map((number) => this.readUints(target, number));
    const [depth] = new Float32Array(Uint32Array.of(depthBits).buffer);
    return isHit ? { cell, level, index: [x, y, z], edge: 2 ** -level, part, depth } : null;
  }

  // Look up pixels: one of an image in a size, or the whole image. Returns four numbers a pixel: rest position and
  // footprint; the values of a plane (of −1: alpha, the number of fetches, and fourth 1 for a hit); the facing side and the
  // part's number.
  probe(display, camera, { width, height, pixel = null, plane = 0, footprint = -1 }) {
    const { gl } = this, [w, h] = pixel ? [1, 1] : [width, height];
    const gbuffer = this.uintTarget("probed gbuffer", w, h), values = this.uintTarget("probed values", w, h, gbuffer);
    this.drawGBuffer(display, camera, gbuffer, width, height, { pixel, alphas: pixel ? VISIBLE : ANY_ALPHA });
    gl.bindFramebuffer(gl.FRAMEBUFFER, values.buffer);
    for (const number of [0, 1]) gl.clearBufferuiv(gl.COLOR, number, [0, 0, 0, 0]);
    this.drawVisible(gbuffer, (part, number) => {
      const planes = part.header.planes.length, program = this.programs.use("probe", part, display, planes);
      this.setOctree(program, part, display, { u_positions: gbuffer.textures[0], u_directions: gbuffer.textures[1] });
      program.set({ u_width: display.footprints ? footprint : 0, u_plane: plane, u_part: number });
    });
    const read = (target, number) => new Float32Array(this.readUints(target, number).buffer);
    return { positions: read(gbuffer, 0), values: read(values, 0), normals: read(values, 1) };
  }

  // Read a box (left, bottom, right, top) of one of a target's integer textures: four numbers a pixel, the lowest row first.
  readUints(target, number = 0, box = [0, 0, target.width, target.height]) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.readBuffer(gl.COLOR_ATTACHMENT0 + number);
    return this.readPixels(box, gl.RGBA_INTEGER, gl.UNSIGNED_INT, new Uint32Array(4 * areaOf(box)));
  }

  // The same of a target with one 8-bit texture.
  readBytes(target, box = [0, 0, target.width, target.height]) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    return this.readPixels(box, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4 * areaOf(box)));
  }

  readPixels([left, bottom, right, top], format, type, values) {
    const { gl } = this;
    gl.readPixels(left, bottom, right - left, top - bottom, format, type, values);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return values;
  }

  // Wait until the GPU has drawn everything: reading a pixel blocks.
  finish() {
    const { gl } = this;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  // A target with two integer textures, as the G-buffer has.
  uintTarget(name, width, height, shared = null) {
    return this.target(name, width, height, [this.gl.RGBA32UI, this.gl.RGBA32UI], shared);
  }

  // Clear a target's first texture to 0.
  clear({ buffer }) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // A framebuffer with textures of these formats, created again when its size changes. It may share the depth and stencil
  // buffer of another target.
  target(name, width, height, formats, shared = null) {
    const { gl } = this, old = this.targets[name];
    if (old?.width === width && old.height === height && (!shared || old.depth === shared.depth)) return old;
    if (old) {
      old.textures.forEach((texture) => gl.deleteTexture(texture));
      if (!shared) gl.deleteRenderbuffer(old.depth);
      gl.deleteFramebuffer(old.buffer);
    }
    const buffer = gl.createFramebuffer(), depth = shared?.depth ?? gl.createRenderbuffer(), textures = [];
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    for (const [number, format] of formats.entries()) {
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + number, gl.TEXTURE_2D, texture, 0);
      textures.push(texture);
    }
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    if (!shared) gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH24_STENCIL8, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_STENCIL_ATTACHMENT, gl.RENDERBUFFER, depth);
    gl.drawBuffers(textures.map((_, number) => gl.COLOR_ATTACHMENT0 + number));
    return (this.targets[name] = { buffer, textures, depth, width, height });
  }
}
