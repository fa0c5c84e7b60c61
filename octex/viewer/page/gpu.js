// What the GPU holds of a texture and its mesh, and how they are drawn.

import { ROW } from "./octree.js";
import { readShader } from "./data.js";

export const FILTERS = ["nearest", "linear", "quadratic"];
const KINDS = { srgb: 0, linear: 0, data: 1, direction: 2 };
const FILES = ["ways.glsl", "walk.glsl", "light.glsl", "screen.vert", "places.frag", "source.frag"];
for (const name of ["surface", "cubes"]) FILES.push(`${name}.vert`, `${name}.frag`);
const PARTS = "xyzw";
const MATERIALS = ["base_color", "metallic", "roughness", "occlusion", "emissive", "specular", "normal"];
const STAGES = {
  places: ["surface.vert", ["ways.glsl", "places.frag"]],
  source: ["surface.vert", ["source.frag"]],
  surface: ["screen.vert", ["ways.glsl", "walk.glsl", "light.glsl", "surface.frag"]],
  probe: ["screen.vert", ["ways.glsl", "walk.glsl", "surface.frag"]],
  cubes: ["cubes.vert", ["walk.glsl", "light.glsl", "cubes.frag"]],
};
const BACKGROUND = [0.925, 0.93, 0.94, 1];

export async function readShaders() {
  return Object.fromEntries(await Promise.all(FILES.map(async (name) => [name, await readShader(name)])));
}

export class Gpu {
  constructor(canvas, shaders, octree, mesh) {
    this.canvas = canvas;
    this.shaders = shaders;
    this.octree = octree;
    this.mesh = mesh;
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!this.gl) throw new Error("this browser has no WebGL2");
    this.build();
  }

  // The deepest level whose rows fit into this GPU's textures.
  get deepest() {
    const rows = this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE), { cells } = this.octree;
    let level = this.octree.header.depth;
    while (level > 0 && cells[level + 1] > rows * ROW) level--;
    return level;
  }

  // Make everything anew, as after a lost context.
  build() {
    const { gl, octree } = this;
    this.programs = new Map();
    this.buffers = [];
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const rows = (array, size) => Math.min(array.length / (size * ROW), most);
    this.nodes = this.texture(gl.RG32UI, rows(octree.words, 2));
    this.planes = octree.planes.map((plane, n) =>
      this.texture(octree.header.planes[n] ? gl.SRGB8_ALPHA8 : gl.RGBA8, rows(plane, 4)),
    );
    this.tables = this.texture(gl.RG32UI, rows(octree.entries, 2));
    const last = octree.tables.kept + octree.tables.split ? octree.planes[0].length / 4 : octree.cells[octree.depth + 1];
    const entries = [0, octree.entries.length / 2];
    if (octree.depth >= 0) this.upload({ nodes: [0, octree.nodes[octree.depth]], cells: [0, last], entries });
    if (this.mesh) this.takeMesh(this.mesh);
    if (this.motion) this.takeMotion(this.motion);
    this.source?.build(gl);
    this.cubes = null;
    this.pictures = {};
  }

  texture(format, rows) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, ROW, Math.max(rows, 1));
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return { texture, rows: Math.max(rows, 1) };
  }

  // Send the rows that hold some nodes and cells.
  upload({ nodes, cells, entries = [0, 0] }) {
    const { gl, octree } = this;
    const put = (made, array, size, [first, end], format, type) => {
      const begin = Math.floor(first / ROW), rows = Math.min(Math.ceil(end / ROW), made.rows) - begin;
      if (rows <= 0) return;
      gl.bindTexture(gl.TEXTURE_2D, made.texture);
      const part = array.subarray(size * ROW * begin, size * ROW * (begin + rows));
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, begin, ROW, rows, format, type, part);
    };
    put(this.nodes, octree.words, 2, nodes, gl.RG_INTEGER, gl.UNSIGNED_INT);
    put(this.tables, octree.entries, 2, entries, gl.RG_INTEGER, gl.UNSIGNED_INT);
    octree.planes.forEach((plane, n) => put(this.planes[n], plane, 4, cells, gl.RGBA, gl.UNSIGNED_BYTE));
  }

  takeMesh(mesh) {
    const { gl } = this;
    this.mesh = mesh;
    this.surface = gl.createVertexArray();
    gl.bindVertexArray(this.surface);
    const attribute = (place, array, components, type) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, components, type, type !== gl.FLOAT, 0, 0);
    };
    [mesh.rest, mesh.positions, mesh.normals].forEach((array, place) => attribute(place, array, 3, gl.FLOAT));
    if (mesh.uv) attribute(4, mesh.uv, 2, gl.FLOAT);
    if (mesh.colors) attribute(5, mesh.colors, 3, gl.UNSIGNED_BYTE);
    gl.vertexAttrib3f(5, 1, 1, 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.triangles, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  takeSource(source) {
    this.source = source;
    source.build(this.gl);
  }

  // Take what moves the mesh: a texel an entry of its vertices, and of each animation one a row of a bone.
  takeMotion(motion) {
    const { gl } = this;
    this.motion = motion;
    this.links = this.numbers(motion.links);
    this.frames = new Map();
    gl.bindVertexArray(this.surface);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, motion.linksOf(this.mesh.owners), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(3);
    gl.vertexAttribIPointer(3, 4, gl.UNSIGNED_INT, 0, 0);
    gl.bindVertexArray(null);
  }

  // A texture of numbers, four in a texel.
  numbers(values) {
    const { gl } = this, made = this.texture(gl.RGBA32F, Math.ceil(values.length / 4 / ROW));
    const padded = new Float32Array(4 * ROW * made.rows);
    padded.set(values);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, made.rows, gl.RGBA, gl.FLOAT, padded);
    return made.texture;
  }

  // Where the mesh is: at a time of an animation.
  setMotion(program, { animation, time }) {
    const { gl, motion } = this;
    if (!this.frames.has(animation)) this.frames.set(animation, this.numbers(motion.animations[animation].texels));
    const { before, after, share } = motion.at(animation, time);
    [this.links, this.frames.get(animation)].forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(program.at(["u_links", "u_frames"][unit]), unit);
    });
    gl.activeTexture(gl.TEXTURE0);
    gl.uniform2i(program.at("u_frame"), before, after);
    gl.uniform1f(program.at("u_share"), share);
    gl.uniform1i(program.at("u_firstTarget"), 3 * motion.header.bones);
    gl.uniform4f(program.at("u_root"), ...this.octree.header.origin, this.octree.header.size);
  }

  // A program that draws or probes, for what is shown.
  program(kind, look, planes) {
    const parts = [look.facing, Boolean(look.moved), this.showsSource(look), this.isLinearMixed(look)];
    const key = [kind, planes, look.shown, look.channel, ...parts].join();
    if (!this.programs.has(key)) this.programs.set(key, this.compiled(kind, look, planes));
    const program = this.programs.get(key);
    this.gl.useProgram(program.handle);
    return program;
  }

  compiled(kind, look, planes) {
    const { gl, shaders } = this, handle = gl.createProgram(), [vertex, fragment] = STAGES[kind];
    const head = `#version 300 es\n${this.defines(kind, look, planes)}\n`;
    const body = fragment.map((name) => shaders[name]).join("");
    const repeated = (line) => Array.from({ length: planes }, (_, n) => line.replaceAll("{N}", n)).join("\n");
    const all = body.replace(/^.*\{N\}.*$/gm, repeated);
    const check = (is, log) => {
      if (!gl.isContextLost() && !is) throw new Error(`${kind}: ${log}`);
    };
    const sources = [[gl.VERTEX_SHADER, head + shaders[vertex]], [gl.FRAGMENT_SHADER, head + all]];
    for (const [type, source] of sources) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(handle, shader);
      check(gl.getShaderParameter(shader, gl.COMPILE_STATUS), gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(handle);
    check(gl.getProgramParameter(handle, gl.LINK_STATUS), gl.getProgramInfoLog(handle));
    const places = {};
    return { handle, at: (name) => (places[name] ??= gl.getUniformLocation(handle, name)) };
  }

  // Where channels are, among the first planes, and what is shown, as the shaders name it.
  defines(kind, look, planes) {
    const lines = [`#define PLANES ${planes}`, `#define SHOWS_${look.shown.toUpperCase()}`];
    const { isMixed, split, kept, mesh, motion } = this.octree.header;
    const facing = look.facing && kind !== "cubes";
    const flags = { PROBE: kind === "probe", MIXED: isMixed, KEPT: isMixed && kept > 0 };
    Object.assign(flags, { LINEAR_MIXED: this.isLinearMixed(look) });
    Object.assign(flags, { MOVED: look.moved, FROM_REST: motion?.start === "rest", POSED: mesh?.posed || look.moved });
    Object.assign(flags, { SOURCE: kind === "source", BESIDE: kind === "surface" && this.showsSource(look) });
    Object.assign(flags, { FACING: facing, SPLIT: facing && split[0] > 0 });
    for (const [name, is] of Object.entries(flags)) if (is) lines.push(`#define ${name}`);
    const define = (name, text) => lines.push(`#define ${name} ${text}`);
    const part = ({ at: [, slot], components }) => PARTS.slice(slot, slot + Math.min(components, 3));
    const inRange = ({ range: [low, high] }, value) =>
      low === 0 && high === 1 ? value : `(${low.toExponential()} + ${(high - low).toExponential()} * ${value})`;
    for (const channel of this.octree.header.channels) {
      const { name, components, at } = channel;
      if (at[0] >= planes) continue;
      if (name === "alpha" && components === 1) define("ALPHA", `value${at[0]}.${part(channel)}`);
      else if (MATERIALS.includes(name)) define(name.toUpperCase(), inRange(channel, `g_sum${at[0]}.${part(channel)}`));
      if (name !== look.channel) continue;
      const color = (from) => (components === 2 ? `vec3(${from}.${part(channel)}, 0.0)` : `vec3(${from}.${part(channel)})`);
      define("CHANNEL", name === "alpha" ? "vec3(g_alpha)" : color(`g_sum${at[0]}`));
      define("CHANNEL_PLANE", `u_plane${at[0]}`);
      define("CHANNEL_STORED", color("stored"));
    }
    const [plane, slot] = this.octree.header.flags;
    if (plane < planes) lines.push(`#define FLAGS_PLANE u_plane${plane}`, `#define FLAGS_PART ${PARTS[slot]}`);
    return lines.join("\n");
  }

  // Whether the source is shown beside the octree.
  showsSource(look) {
    const isColor = ["lit", "unlit"].includes(look.shown) || (look.shown === "channel" && look.channel === "base_color");
    return Boolean(this.source && isColor && look.divider > 0);
  }

  isLinearMixed(look) {
    return this.octree.header.isMixed && look.filter === "linear";
  }

  channel(name) {
    return this.octree.header.channels.find((channel) => channel.name === name);
  }

  // How many planes are read to show something.
  planesFor(look) {
    const read = ["alpha"];
    if (look.shown === "lit") read.push(...MATERIALS);
    if (look.shown === "unlit") read.push("base_color", "emissive");
    if (["channel", "spread"].includes(look.shown)) read.push(look.channel);
    const known = read.map((name) => this.channel(name)).filter(Boolean).map((channel) => channel.at[0]);
    if (look.shown === "facing" || look.facing || this.octree.header.kept) known.push(this.octree.header.flags[0]);
    return Math.max(0, ...known) + 1;
  }

  setTree(program, look, planes, places = null) {
    const { gl } = this;
    const bind = (unit, texture, name) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(program.at(name), unit);
    };
    bind(0, this.nodes.texture, "u_nodes");
    this.planes.slice(0, planes).forEach((plane, n) => bind(n + 1, plane.texture, `u_plane${n}`));
    bind(planes + 1, this.tables.texture, "u_tables");
    const drawn = ["u_places", "u_ways", "u_source"];
    places?.forEach((texture, n) => bind(planes + 2 + n, texture, drawn[n]));
    gl.activeTexture(gl.TEXTURE0);
    const { kept, split } = this.octree.tables, nCells = this.octree.cells.at(-1);
    gl.uniform3ui(program.at("u_kept"), 0, kept, nCells);
    gl.uniform3ui(program.at("u_split"), kept, split, nCells + kept);
    gl.uniform1i(program.at("u_leafRoot"), this.octree.nodes.at(-1) === 0 ? 1 : 0);
    gl.uniform1i(program.at("u_depth"), Math.min(look.level, this.octree.depth, this.deepest));
    gl.uniform1i(program.at("u_filter"), FILTERS.indexOf(look.filter));
  }

  setCamera(program, camera, pixel = null, size = null) {
    this.gl.uniformMatrix4fv(program.at("u_projection"), false, camera.projection(pixel, size));
    this.gl.uniformMatrix4fv(program.at("u_view"), false, camera.view);
  }

  // Draw the picture in so many pixels.
  draw(look, camera, width, height) {
    const { gl, canvas } = this;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...BACKGROUND);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    if (look.cubes || !this.mesh) this.drawCubes(look, camera);
    else this.drawSurface(look, camera, width, height);
  }

  // Draw where the surface rests that each pixel sees; of one pixel, or of all.
  drawPlaces(look, camera, target, width, height, pixel = null) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, target.width, target.height);
    for (const number of [0, 1]) gl.clearBufferuiv(gl.COLOR, number, [0, 0, 0, 0]);
    gl.clearBufferfi(gl.DEPTH_STENCIL, 0, 1, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.ALWAYS, 1, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
    const program = this.program("places", look, 0);
    this.setCamera(program, camera, pixel, [width, height]);
    if (look.moved) this.setMotion(program, look.moved);
    gl.bindVertexArray(this.surface);
    gl.drawElements(gl.TRIANGLES, this.mesh.triangles.length, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
    gl.disable(gl.DEPTH_TEST);
    gl.stencilFunc(gl.EQUAL, 1, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.KEEP);
  }

  // Run a program for the pixels that see the surface.
  drawSeen() {
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
    this.gl.disable(this.gl.STENCIL_TEST);
  }

  drawSurface(look, camera, width, height) {
    const { gl } = this, planes = this.planesFor(look);
    const places = this.target("places", width, height, [gl.RGBA32UI, gl.RGBA32UI]), drawn = [...places.textures];
    const picture = this.target("picture", width, height, [gl.RGBA8], places);
    this.drawPlaces(look, camera, places, width, height);
    if (this.showsSource(look)) drawn.push(this.drawSource(look, camera, places));
    gl.bindFramebuffer(gl.FRAMEBUFFER, picture.buffer);
    gl.clearColor(...BACKGROUND);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const program = this.program("surface", look, planes);
    this.setTree(program, look, planes, drawn);
    gl.uniform1f(program.at("u_divider"), look.divider * width);
    gl.uniformMatrix4fv(program.at("u_view"), false, camera.view);
    gl.uniform1i(program.at("u_kind"), KINDS[this.channel(look.channel)?.space] ?? 0);
    gl.uniform1i(program.at("u_footprints"), look.footprints ? 1 : 0);
    const marked = look.marked ?? { index: [0, 0, 0], edge: 0 };
    gl.uniform3fv(program.at("u_marked"), marked.index.map((n) => n * marked.edge));
    gl.uniform1f(program.at("u_markedEdge"), marked.edge);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
    this.drawSeen();
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, picture.buffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // Draw what the model's own images have of what is seen; returns the texture.
  drawSource(look, camera, places) {
    const { gl } = this, { width, height } = places;
    const target = this.target("source", width, height, [gl.SRGB8_ALPHA8], places);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    const program = this.program("source", look, 0);
    this.setCamera(program, camera);
    if (look.moved) this.setMotion(program, look.moved);
    gl.bindVertexArray(this.surface);
    this.source.draw(gl, program);
    gl.bindVertexArray(null);
    gl.depthFunc(gl.LESS);
    gl.disable(gl.DEPTH_TEST);
    return target.textures[0];
  }

  // Cells of a level as cubes; returns how many.
  drawCubes(look, camera) {
    const { gl, octree } = this, { origin, size, channels } = octree.header;
    const level = Math.min(look.level, octree.depth);
    if (this.cubes?.level !== level || this.cubes.depth !== octree.depth) this.makeCubes(level);
    const wanted = look.shown === "channel" ? look.channel : "base_color";
    const channel = this.channel(wanted) ?? channels[0], planes = channel.at[0] + 1;
    const program = this.program("cubes", { shown: "channel", channel: channel.name }, planes);
    this.setTree(program, look, planes);
    this.setCamera(program, camera);
    gl.uniform1i(program.at("u_kind"), KINDS[channel.space]);
    gl.uniform1i(program.at("u_byLevel"), look.shown === "depth" ? 1 : 0);
    gl.uniform3fv(program.at("u_low"), origin);
    gl.uniform1f(program.at("u_edge"), size);
    gl.uniform3fv(program.at("u_camera"), camera.position.map((x, n) => (x - origin[n]) / size));
    gl.bindVertexArray(this.cubes.array);
    gl.drawArraysInstanced(gl.TRIANGLES, 0, 18, this.cubes.count);
    gl.bindVertexArray(null);
  }

  makeCubes(level) {
    const { gl, octree } = this, cells = octree.cubes(level);
    if (this.cubes) {
      gl.deleteBuffer(this.cubes.buffer);
      gl.deleteVertexArray(this.cubes.array);
    }
    const array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, cells, gl.STATIC_DRAW);
    for (const [place, components, offset] of [[0, 4, 0], [1, 1, 16]]) {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribIPointer(place, components, gl.UNSIGNED_INT, 20, offset);
      gl.vertexAttribDivisor(place, 1);
    }
    gl.bindVertexArray(null);
    this.cubes = { level, depth: octree.depth, array, buffer, count: cells.length / 5 };
  }

  // Rest positions, footprints and looked-up values of pixels: of one, or of a whole picture.
  probe(look, camera, { width, height, pixel = null, plane = 0, footprint = -1 }) {
    const { gl } = this, planes = this.planes.length, [w, h] = pixel ? [1, 1] : [width, height];
    const two = [gl.RGBA32UI, gl.RGBA32UI], places = this.target("probed places", w, h, two);
    const values = this.target("probed values", w, h, two, places);
    this.drawPlaces(look, camera, places, width, height, pixel);
    const read = (target, number) => {
      const bits = new Uint32Array(4 * w * h);
      gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + number);
      gl.readPixels(0, 0, w, h, gl.RGBA_INTEGER, gl.UNSIGNED_INT, bits);
      return new Float32Array(bits.buffer);
    };
    gl.bindFramebuffer(gl.FRAMEBUFFER, values.buffer);
    for (const number of [0, 1]) gl.clearBufferuiv(gl.COLOR, number, [0, 0, 0, 0]);
    const program = this.program("probe", look, planes);
    this.setTree(program, look, planes, places.textures);
    gl.uniform1f(program.at("u_width"), look.footprints ? footprint : 0);
    gl.uniform1i(program.at("u_plane"), plane);
    this.drawSeen();
    const found = { places: read(places, 0), values: read(values, 0), normals: read(values, 1) };
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return found;
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
