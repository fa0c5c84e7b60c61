// What the GPU holds of a texture and its mesh, and how they are drawn.

import { walkUniforms } from "./field.js";
import { ROW, planes } from "./octree.js";
import { FACINGS, LEVELS } from "./legend.js";
import { signed } from "./mesh.js";
import { Programs, TILE, planesFor, showsRelief, showsSource } from "./programs.js";

const KINDS = { srgb: 0, linear: 0, data: 1, direction: 2 };
const CLEAR = 0.5 / 255, OPAQUE = 1 - CLEAR; // alpha of what is not seen at all, and of what hides all behind it
// Which surface of each pixel is drawn, by its alpha: from the first number to below the second.
const OPAQUES = [OPAQUE, 2], TRANSLUCENTS = [CLEAR, OPAQUE], SEEN = [CLEAR, 2], NEAREST = null;
const MOST_CUBES = 1 << 20;
const CUBES_BY = { depth: 1, facing: 2 };
const LIGHT_UNIT = 28, MOTION_UNIT = 30; // of textures; those before are the octree's and the picture's
const BACKGROUND = [0.925, 0.93, 0.94, 1];

const areaOf = ([left, bottom, right, top]) => (right - left) * (top - bottom);

export class Gpu {
  constructor(canvas, shaders, studio, parts) {
    this.canvas = canvas;
    this.mostCubes = MOST_CUBES;
    this.background = BACKGROUND;
    this.studio = studio; // what the header says of its light, and the stream
    this.parts = parts;
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!this.gl) throw new Error("this browser has no WebGL2");
    this.programs = new Programs(this.gl, shaders, parts);
    this.build();
  }

  // The deepest level that is held of any part.
  get deepest() {
    return Math.max(...this.parts.map((part) => part.deepest));
  }

  // Make everything anew, as after a lost context.
  build() {
    this.programs.clear();
    this.pictures = {};
    for (const part of this.parts) part.build(this.gl);
    this.light = this.studioLight();
  }

  // A texture of the studio's numbers, see light.glsl.
  studioLight() {
    const { gl } = this, [{ numbers }, bytes] = this.studio, rows = Math.ceil(numbers / ROW), halves = new Uint16Array(ROW * rows);
    planes(bytes, numbers, 0).forEach((step, n) => (halves[n] = (n ? halves[n - 1] : 0) + signed(step)));
    const texture = this.parts[0].texture(gl.R16F, rows);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, rows, gl.RED, gl.HALF_FLOAT, halves);
    return texture;
  }

  setLight(program) {
    const { gl } = this, [{ tables, reflectances }] = this.studio, [first, height, width] = tables.at(-1);
    this.bind(program, { u_studio: this.light }, LIGHT_UNIT);
    gl.uniform3iv(program.at("u_tables[0]"), tables.flat());
    gl.uniform2i(program.at("u_reflectances"), first + height * width, reflectances);
  }

  setColors(program) {
    this.gl.uniform3fv(program.at("u_levels[0]"), LEVELS.flat());
    this.gl.uniform3fv(program.at("u_facings[0]"), FACINGS.flat());
  }

  // Where the mesh is: at a time of an animation.
  setMotion(program, part, { animation, time }) {
    const { gl } = this, { motion, frames, header } = part;
    if (!frames.has(animation)) frames.set(animation, part.numbers(motion.animations[animation].texels));
    const { before, after, share } = motion.at(animation, time);
    this.bind(program, { u_links: part.links, u_frames: frames.get(animation) }, MOTION_UNIT);
    gl.uniform2i(program.at("u_frame"), before, after);
    gl.uniform1f(program.at("u_share"), share);
    gl.uniform1i(program.at("u_firstTarget"), 3 * motion.header.bones);
    gl.uniform1ui(program.at("u_turns"), motion.header.entries[1]);
    gl.uniform4f(program.at("u_root"), ...header.origin, header.size);
  }

  // Give a program textures by their names, in units from one on.
  bind(program, textures, first = 0, kind = this.gl.TEXTURE_2D) {
    const { gl } = this;
    Object.entries(textures).forEach(([name, texture], n) => {
      gl.activeTexture(gl.TEXTURE0 + first + n);
      gl.bindTexture(kind, texture);
      gl.uniform1i(program.at(name), first + n);
    });
    gl.activeTexture(gl.TEXTURE0);
  }

  // Make an octree ready to be looked up, with other textures by their names.
  setTree(program, part, look, textures = {}) {
    const { gl } = this, { octree } = part;
    part.stores.forEach(({ name, kind, texture }, unit) => this.bind(program, { [name]: texture }, unit, kind));
    this.bind(program, textures, part.stores.length);
    for (const [name, value] of Object.entries(walkUniforms(octree, Math.min(look.level, part.deepest)))) {
      if (Array.isArray(value)) gl.uniform3ui(program.at(name), ...value);
      else gl.uniform1i(program.at(name), value);
    }
  }

  setCamera(program, camera, pixel = null, size = null) {
    this.gl.uniformMatrix4fv(program.at("u_projection"), false, camera.projection(pixel, size));
    this.gl.uniformMatrix4fv(program.at("u_view"), false, camera.view);
  }

  // Draw the picture in so many pixels, or only a part of it (left, bottom, width, height) where nothing else has changed,
  // or that is `near` what has: see surface.frag.
  // Before there is a mesh this makes its programs ready, while data comes.
  draw(look, camera, width, height, only = null, near = null) {
    const { gl, canvas } = this;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.background);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.makesCubes = false; // whether there are more cubes to come
    if (this.showsCubes(look)) this.drawCubes(look, camera);
    else this.drawSurface({ ...look, near, only }, camera, width, height);
  }

  // Draw where the surface rests that each pixel sees, of one pixel or of all: the nearest of some alpha. Translucent
  // surfaces are in front of the opaque ones, which are drawn before them.
  drawGBuffer(look, camera, target, width, height, { pixel = null, alphas = NEAREST } = {}) {
    const { gl } = this, isOver = alphas === TRANSLUCENTS;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, target.width, target.height);
    for (const number of [0, 1]) gl.clearBufferuiv(gl.COLOR, number, [0, 0, 0, 0]);
    if (isOver) gl.clearBufferiv(gl.STENCIL, 0, [0]);
    else gl.clearBufferfi(gl.DEPTH_STENCIL, 0, 1, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
    const draw = (part, isLayered) => {
      gl.stencilFunc(gl.ALWAYS, this.parts.indexOf(part) + 1, 255);
      const planes = isLayered ? planesFor(part, { ...look, shown: "layers" }) : 0;
      const program = this.programs.use(isLayered ? "layers" : "gbuffer", part, { ...look, shown: "layers" }, planes);
      if (isLayered) {
        this.setTree(program, part, look);
        gl.uniform1i(program.at("u_footprints"), look.footprints ? 1 : 0);
        gl.uniform2fv(program.at("u_alphas"), alphas);
      }
      this.setCamera(program, camera, pixel, [width, height]);
      if (look.moved) this.setMotion(program, part, look.moved);
      gl.bindVertexArray(part.surface);
      gl.drawElements(gl.TRIANGLES, part.mesh.triangles.length, gl.UNSIGNED_INT, 0);
    };
    const isLayered = (part) => alphas !== NEAREST && part.hasAlpha, parts = this.parts.filter((part) => part.mesh);
    if (!isOver) for (const part of parts) if (!isLayered(part)) draw(part, false);
    for (const part of parts) if (isLayered(part)) draw(part, true);
    gl.bindVertexArray(null);
    gl.disable(gl.DEPTH_TEST);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.KEEP);
    gl.disable(gl.STENCIL_TEST);
  }

  // Draw on a box (left, bottom, right, top) of a target.
  drawOn({ buffer, width, height }, [left, bottom, right, top], draw) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, bottom, right - left, top - bottom);
    draw();
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // For each part, run a program that `use` makes ready for the pixels that see it, in tiles: see tiles.vert.
  drawSeen({ width, height }, use) {
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

  drawSurface(look, camera, width, height) {
    const { gl } = this, { only } = look, isLayered = this.parts.some((part) => part.mesh && part.hasAlpha);
    const gbuffer = this.targetOfTwo("gbuffer", width, height);
    const picture = this.target("picture", width, height, [gl.RGBA8], gbuffer);
    if (only) {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(...only);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, picture.buffer);
    gl.clearColor(...this.background);
    if (!look.near) gl.clear(gl.COLOR_BUFFER_BIT);
    this.drawLayer(look, camera, gbuffer, picture, OPAQUES, {}, (only || look.near) && !isLayered);
    let last = picture;
    if (isLayered) {
      last = this.target("blended", width, height, [gl.RGBA8], gbuffer);
      this.copy(picture, last);
      const behind = { u_background: picture.textures[0] };
      this.drawLayer({ ...look, isOver: true }, camera, gbuffer, last, TRANSLUCENTS, behind);
    }
    gl.disable(gl.SCISSOR_TEST);
    this.present(last);
  }

  // Begin a picture of another size: it is what was drawn last, as large.
  resize(look, camera, width, height) {
    const { gl, canvas, pictures: { picture: last } } = this, small = last && this.target("small", last.width, last.height, [gl.RGBA8]);
    if (last) this.copy(last, small);
    [canvas.width, canvas.height] = [width, height];
    const gbuffer = this.targetOfTwo("gbuffer", width, height), picture = this.target("picture", width, height, [gl.RGBA8], gbuffer);
    if (last) this.copy(small, picture);
    this.drawGBuffer(look, camera, gbuffer, width, height, { alphas: OPAQUES });
    this.present(picture);
  }

  // Show a picture. Browsers take a canvas as drawn on once it was cleared.
  present(picture) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.copy(picture, { ...picture, buffer: null });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  copy(from, to) {
    const { gl } = this, { width, height } = from;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, from.buffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, to.buffer);
    const isLike = to.width === width && to.height === height;
    gl.blitFramebuffer(0, 0, width, height, 0, 0, to.width, to.height, gl.COLOR_BUFFER_BIT, isLike ? gl.NEAREST : gl.LINEAR);
  }

  // Draw the nearest surface of some alpha, over what is `behind` it; `isKnown`: the G-buffer is drawn already. The octree of
  // `look.beneath` is looked up instead of the part's own.
  drawLayer(look, camera, gbuffer, target, alphas, behind = {}, isKnown = false) {
    const { gl } = this, { width, height } = target, [u_positions, u_directions] = gbuffer.textures, drawn = { u_positions, u_directions, ...behind };
    if (!isKnown) this.drawGBuffer(look, camera, gbuffer, width, height, { alphas });
    if (look.paint) Object.assign(drawn, look.paint.textures);
    const beside = this.parts.find((part) => showsSource(part, look));
    if (beside) drawn.u_source = this.drawSource(beside, look, camera, gbuffer);
    if (showsRelief(this.parts, look)) drawn.u_heights = this.drawHeights(look, camera, gbuffer, drawn);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    this.drawSeen(gbuffer, (part, number) => this.useSurface(look.beneath ?? part, number, look, camera, drawn, target));
  }

  // Draw the heights of what is seen; returns the texture.
  drawHeights(look, camera, gbuffer, drawn) {
    const { gl } = this, target = this.target("heights", gbuffer.width, gbuffer.height, [gl.R32UI], gbuffer);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    const { only } = look; // relief is made of what is beside a pixel, too
    if (only) gl.scissor(only[0] - 1, only[1] - 1, only[2] + 2, only[3] + 2);
    if (!look.near) gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    this.drawSeen(gbuffer, (part, number) => this.useSurface(part, number, { ...look, shown: "height" }, camera, drawn, target));
    if (only) gl.scissor(...only);
    return target.textures[0];
  }

  // Make ready what draws the surface of a part.
  useSurface(part, number, look, camera, drawn, { width, height }) {
    const { gl } = this, planes = planesFor(part, look), program = this.programs.use("surface", part, look, planes);
    this.setTree(program, part, look, drawn);
    this.setLight(program);
    this.setColors(program);
    look.paint?.set(program, width, height, planes);
    gl.uniform1f(program.at("u_relief"), look.relief);
    gl.uniform1f(program.at("u_divider"), look.divider * width);
    gl.uniformMatrix4fv(program.at("u_view"), false, camera.view);
    gl.uniform1i(program.at("u_kind"), KINDS[part.channel(look.channel)?.space] ?? 0);
    gl.uniform1i(program.at("u_footprints"), look.footprints ? 1 : 0);
    gl.uniform1i(program.at("u_hasRegion"), look.near ? 1 : 0);
    if (look.near) {
      const [low, high] = look.near;
      gl.uniform3fv(program.at("u_regionLow"), low.slice(0, 3));
      gl.uniform3fv(program.at("u_regionHigh"), high.slice(0, 3));
      gl.uniform4f(program.at("u_regionPart"), ...low.slice(3), ...high.slice(3));
      gl.uniform2f(program.at("u_size"), width, height);
    }
    const marked = look.marked?.part === number ? look.marked : { index: [0, 0, 0], edge: 0 };
    gl.uniform3fv(program.at("u_marked"), marked.index.map((n) => n * marked.edge));
    gl.uniform1f(program.at("u_markedEdge"), marked.edge);
  }

  // Draw what the model's own images have of what is seen; returns the texture.
  drawSource(part, look, camera, gbuffer) {
    const { gl } = this, { width, height } = gbuffer;
    const target = this.target("source", width, height, [gl.SRGB8_ALPHA8], gbuffer);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.EQUAL);
    const program = this.programs.use("source", part, look, 0);
    this.setCamera(program, camera);
    if (look.moved) this.setMotion(program, part, look.moved);
    gl.bindVertexArray(part.surface);
    part.source.draw(gl, program);
    gl.bindVertexArray(null);
    gl.depthFunc(gl.LESS);
    gl.disable(gl.DEPTH_TEST);
    return target.textures[0];
  }

  // The deepest level, up to the one that is wanted, whose cubes are no more than are drawn.
  cubesLevel(look) {
    const count = (level) => this.parts.reduce((sum, { octree }) => sum + octree.countAt(level), 0);
    let level = look.level;
    while (level > 0 && count(level) > this.mostCubes) level--;
    return level;
  }

  // Cells of a level as cubes: colours, or which of them a pixel sees.
  drawCubes(look, camera, pixel = null, picture = null) {
    const { gl } = this, level = this.cubesLevel(look);
    gl.enable(gl.DEPTH_TEST);
    for (const [number, part] of this.parts.entries()) {
      if (part.octree.depth < 0) continue;
      const { origin, size, channels, flags } = part.header, cubes = part.cubesAt(level);
      this.makesCubes ||= !cubes.isComplete;
      const channel = part.channel(look.shown === "channel" ? look.channel : "base_color") ?? channels[0];
      const shown = { shown: "channel", channel: channel.name, picked: pixel };
      const planes = 1 + Math.max(channel.at[0], look.shown === "facing" ? flags[0] : 0);
      const program = this.programs.use("cubes", part, shown, planes);
      this.setTree(program, part, look);
      this.setCamera(program, camera, pixel, picture);
      gl.uniform1ui(program.at("u_part"), number);
      gl.uniform1i(program.at("u_kind"), KINDS[channel.space]);
      gl.uniform1i(program.at("u_by"), CUBES_BY[look.shown] ?? 0);
      this.setColors(program);
      gl.uniform3fv(program.at("u_low"), origin);
      gl.uniform1f(program.at("u_edge"), size);
      gl.uniform3fv(program.at("u_camera"), camera.position.map((x, n) => (x - origin[n]) / size));
      gl.bindVertexArray(cubes.array);
      gl.drawArraysInstanced(gl.TRIANGLES, 0, 18, cubes.count);
    }
    gl.disable(gl.DEPTH_TEST);
    gl.bindVertexArray(null);
  }

  showsCubes(look) {
    return look.cubes || !this.parts.some((part) => part.header.mesh);
  }

  // How far along the view the surface is that a pixel sees, or the cube; or null.
  awayAt(look, camera, pixel, [width, height]) {
    if (this.showsCubes(look)) return this.probeCubes(look, camera, pixel, [width, height])?.away ?? null;
    const target = this.targetOfTwo("probed away", 1, 1);
    this.drawGBuffer({ ...look, asksAway: true }, camera, target, width, height, { pixel, alphas: SEEN });
    return new Float32Array(this.words(target).buffer)[3] || null;
  }

  // The cube that a pixel sees: its cell's number, x, y, z and level, the part's, and how far away it is; or null.
  probeCubes(look, camera, pixel, size) {
    const { gl } = this, target = this.targetOfTwo("probed cubes", 1, 1);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, 1, 1);
    for (const number of [0, 1]) gl.clearBufferuiv(gl.COLOR, number, [0, 0, 0, 0]);
    gl.clearBufferfi(gl.DEPTH_STENCIL, 0, 1, 0);
    this.drawCubes(look, camera, pixel, size);
    const [[x, y, z, level], [cell, part, away, isSeen]] = [0, 1].map((number) => this.words(target, number));
    return isSeen ? { cell, level, index: [x, y, z], edge: 2 ** -level, part, away: new Float32Array(Uint32Array.of(away).buffer)[0] } : null;
  }

  // Rest positions, footprints and looked-up values of pixels, the sides that they see and, fourth, the parts'
  // numbers: of one that is seen, or of the nearest surface in a whole picture.
  probe(look, camera, { width, height, pixel = null, plane = 0, footprint = -1 }) {
    const { gl } = this, [w, h] = pixel ? [1, 1] : [width, height];
    const gbuffer = this.targetOfTwo("probed gbuffer", w, h), values = this.targetOfTwo("probed values", w, h, gbuffer);
    this.drawGBuffer(look, camera, gbuffer, width, height, { pixel, alphas: pixel ? SEEN : NEAREST });
    gl.bindFramebuffer(gl.FRAMEBUFFER, values.buffer);
    for (const number of [0, 1]) gl.clearBufferuiv(gl.COLOR, number, [0, 0, 0, 0]);
    this.drawSeen(gbuffer, (part, number) => {
      const planes = part.header.planes.length, program = this.programs.use("probe", part, look, planes);
      this.setTree(program, part, look, { u_positions: gbuffer.textures[0], u_directions: gbuffer.textures[1] });
      gl.uniform1f(program.at("u_width"), look.footprints ? footprint : 0);
      gl.uniform1i(program.at("u_plane"), plane);
      gl.uniform1f(program.at("u_part"), number);
    });
    const read = (target, number) => new Float32Array(this.words(target, number).buffer);
    return { positions: read(gbuffer, 0), values: read(values, 0), normals: read(values, 1) };
  }

  // What a box (left, bottom, right, top) of a target holds, the lowest row first, four numbers a pixel: whole numbers of one
  // of its textures, or the codes of its only one.
  words(target, number = 0, box = [0, 0, target.width, target.height]) {
    const { gl } = this, found = new Uint32Array(4 * areaOf(box));
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.readBuffer(gl.COLOR_ATTACHMENT0 + number);
    return this.read(box, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
  }

  codes(target, box = [0, 0, target.width, target.height]) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    return this.read(box, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4 * areaOf(box)));
  }

  read([left, bottom, right, top], format, type, found) {
    const { gl } = this;
    gl.readPixels(left, bottom, right - left, top - bottom, format, type, found);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return found;
  }

  // Wait until all is drawn.
  finish() {
    const { gl } = this;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  // Targets of the G-buffer, or of what a probe reads there.
  targetOfTwo(name, width, height, shared = null) {
    return this.target(name, width, height, [this.gl.RGBA32UI, this.gl.RGBA32UI], shared);
  }

  // Make a target's only texture 0.
  clear({ buffer }) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // Textures to draw to and to read; of each name the latest size is kept. Depth and what the surface covers may be
  // another target's.
  target(name, width, height, formats, shared = null) {
    const { gl } = this, known = this.pictures[name];
    if (known?.width === width && known.height === height && (!shared || known.depth === shared.depth)) return known;
    if (known) {
      known.textures.forEach((texture) => gl.deleteTexture(texture));
      if (!shared) gl.deleteRenderbuffer(known.depth);
      gl.deleteFramebuffer(known.buffer);
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
    return (this.pictures[name] = { buffer, textures, depth, width, height });
  }
}
