// Compiles programs for a part's channels and the display mode, and keeps them.

import { readShaders } from "./data.js";
import { swizzleOf, planeDefines, withEachPlane, channelSum, walkDefines } from "./walk.js";

const FILES = ["directions.glsl", "walk.glsl", "colors.glsl", "light.glsl", "screen.vert", "gbuffer.frag", "source.frag", "tiles.vert"];
for (const name of ["surface", "cubes"]) FILES.push(`${name}.vert`, `${name}.frag`);
export const MATERIALS = ["base_color", "metallic", "roughness", "occlusion", "emissive", "specular", "normal", "height"];
export const TILE = 16; // pixels along the sides of tiles, see tiles.vert
// The vertex shader and the parts of the fragment shader of each kind of program.
const STAGES = {
  gbuffer: ["surface.vert", ["directions.glsl", "gbuffer.frag"]],
  layers: ["surface.vert", ["directions.glsl", "walk.glsl", "gbuffer.frag"]],
  source: ["surface.vert", ["source.frag"]],
  surface: ["tiles.vert", ["directions.glsl", "walk.glsl", "colors.glsl", "light.glsl", "surface.frag"]],
  probe: ["tiles.vert", ["directions.glsl", "walk.glsl", "surface.frag"]],
  cubes: ["cubes.vert", ["walk.glsl", "colors.glsl", "cubes.frag"]],
  stroke: ["screen.vert", ["stroke.frag"]],
  retouch: ["screen.vert", ["directions.glsl", "colors.glsl", "retouch.frag"]],
  dabs: ["screen.vert", ["dabs.frag"]],
  outline: ["screen.vert", ["directions.glsl", "outline.frag"]],
};

// The functions gl.uniform…v that set uniforms, by GLSL types; samplers are numbers of texture units.
const SETTERS = {
  FLOAT: "1f", FLOAT_VEC2: "2f", FLOAT_VEC3: "3f", FLOAT_VEC4: "4f", INT_VEC2: "2i", INT_VEC3: "3i", UNSIGNED_INT: "1ui", UNSIGNED_INT_VEC3: "3ui",
};

const LOOKUPS = ["layers", "surface", "probe", "cubes"]; // programs that look the octree up; others are the same in all display modes

export const readViewerShaders = () => readShaders(FILES);

export class Programs {
  constructor(gl, shaders, parts) {
    Object.assign(this, { gl, shaders, parts });
    this.clear();
  }

  clear() {
    this.compiled = new Map();
  }

  get size() {
    return this.compiled.size;
  }

  // Use the program of a kind for a part, compiled if it is new.
  use(kind, part, display, planes) {
    const defines = this.defines(kind, part, display, planes), key = `${kind}\n${defines}`;
    if (!this.compiled.has(key)) this.compiled.set(key, this.compile(kind, defines, planes));
    const program = this.compiled.get(key);
    this.gl.useProgram(program.handle);
    return program;
  }

  compile(kind, defines, planes) {
    const { gl, shaders } = this, handle = gl.createProgram(), [vertex, fragment] = STAGES[kind];
    const head = `#version 300 es\n#define TILE ${TILE}\n${defines}\n`;
    const all = withEachPlane(fragment.map((name) => shaders[name]).join(""), planes);
    const check = (isGood, log) => {
      if (!gl.isContextLost() && !isGood) throw new Error(`${kind}: ${log}`);
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
    const setters = this.setters(handle);
    return { handle, set: (values) => Object.entries(values).forEach(([name, value]) => setters[name]?.(value)) };
  }

  // Functions that set the uniforms of a program, by name: each takes a number or a boolean, a matrix, or any nested numbers.
  setters(handle) {
    const { gl } = this, kinds = Object.fromEntries(Object.entries(SETTERS).map(([type, kind]) => [gl[type], kind])), setters = {};
    for (let n = 0; n < gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS); n++) {
      const { name, type } = gl.getActiveUniform(handle, n), at = gl.getUniformLocation(handle, name), set = `uniform${kinds[type] ?? "1i"}v`;
      const isMatrix = type === gl.FLOAT_MAT4;
      setters[name.replace("[0]", "")] = (value) => (isMatrix ? gl.uniformMatrix4fv(at, false, value) : gl[set](at, [value].flat(Infinity)));
    }
    return setters;
  }

  // Define the display mode, and how to read the channels in the first planes.
  defines(kind, part, display, planes) {
    const { strokes, moment, writesDepth, writesPart } = display;
    const looksUp = LOOKUPS.includes(kind);
    if (!looksUp) display = { moment, writesDepth, writesPart, mode: kind };
    const { mesh, motion, channels } = part.header, isCubes = kind === "cubes";
    const lines = [`#define SHOWS_${kind === "probe" ? "PROBE" : display.mode.toUpperCase()}`];
    const header = isCubes ? { ...part.header, kept: 0 } : part.header;
    if (looksUp) lines.push(...planeDefines(header, planes), ...walkDefines(header, display.facing && !isCubes, display.filter));
    const flags = {
      PROBE: kind === "probe", PICKED: display.isPicked, SOURCE: kind === "source", LAYERED: kind === "layers",
      MOVED: moment, FROM_REST: motion?.start === "rest", POSED: mesh?.posed || moment, TURNS: moment && motion?.turns,
      AWAY: writesDepth, PARTS: writesPart, KNOWN: display.composite,
      COMPARES: kind === "surface" && showsSource(part, display), BLENDS: kind === "surface" && display.isTranslucent,
      RELIEF: kind === "surface" && showsRelief(this.parts, display),
      PAINTS: strokes && ["gbuffer", "layers", "surface"].includes(kind),
    };
    for (const [name, is] of Object.entries(flags)) if (is) lines.push(`#define ${name}`);
    const define = (name, text) => lines.push(`#define ${name} ${text}`);
    for (const channel of channels) {
      const { name, components, at } = channel;
      if (at[0] >= planes) continue;
      if (MATERIALS.includes(name) && (name !== "height" || components === 1)) define(name.toUpperCase(), channelSum(channel));
      if (name !== display.channel) continue;
      const color = (from) => (components === 2 ? `vec3(${from}.${swizzleOf(channel)}, 0.0)` : `vec3(${from}.${swizzleOf(channel)})`);
      define("CHANNEL", name === "alpha" ? "vec3(g_alpha)" : color(`g_sum${at[0]}`));
      define("CHANNEL_AT(at)", `PLANE${at[0]}(at)`);
      define("CHANNEL_STORED", color("stored"));
    }
    return lines.join("\n");
  }
}

// Whether the model's images are shown beside the octree.
export function showsSource(part, display) {
  const isColor = ["lit", "unlit"].includes(display.mode) || (display.mode === "channel" && display.channel === "base_color");
  return Boolean(part.source && isColor && display.divider > 0);
}

// The number of planes that a display mode reads.
export function planesFor(part, display) {
  const read = ["alpha"];
  if (display.mode === "lit") read.push(...MATERIALS);
  if (display.mode === "height") read.push("height");
  if (display.mode === "unlit") read.push("base_color", "emissive");
  if (["channel", "spread"].includes(display.mode)) read.push(display.channel);
  const planes = read.map((name) => part.channel(name)).filter(Boolean).map((channel) => channel.at[0]);
  if (display.mode === "facing" || display.facing || part.header.kept) planes.push(part.header.flags[0]);
  return Math.max(0, ...planes) + 1;
}

// Whether heights change the shading.
export function showsRelief(parts, display) {
  return display.mode === "lit" && display.relief > 0 && parts.some((part) => part.channel("height")?.components === 1);
}
