// Shaders, compiled for what is shown of a part: which channels there are and where, and what is drawn of them.

import { readShaders } from "./data.js";
import { lanesOf, planeLines, repeated, sumOf, walkLines } from "./field.js";

const FILES = ["directions.glsl", "walk.glsl", "colors.glsl", "light.glsl", "screen.vert", "gbuffer.frag", "source.frag", "tiles.vert"];
for (const name of ["surface", "cubes"]) FILES.push(`${name}.vert`, `${name}.frag`);
export const MATERIALS = ["base_color", "metallic", "roughness", "occlusion", "emissive", "specular", "normal", "height"];
export const TILE = 16; // pixels along the sides of tiles, see tiles.vert
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

export const readPrograms = () => readShaders(FILES);

export class Programs {
  constructor(gl, shaders, parts) {
    Object.assign(this, { gl, shaders, parts });
    this.clear();
  }

  clear() {
    this.known = new Map();
  }

  get size() {
    return this.known.size;
  }

  // A program that draws or probes, for what is shown of a part; it is in use then.
  use(kind, part, look, planes) {
    const defines = this.defines(kind, part, look, planes), key = `${kind}\n${defines}`;
    if (!this.known.has(key)) this.known.set(key, this.compiled(kind, defines, planes));
    const program = this.known.get(key);
    this.gl.useProgram(program.handle);
    return program;
  }

  compiled(kind, defines, planes) {
    const { gl, shaders } = this, handle = gl.createProgram(), [vertex, fragment] = STAGES[kind];
    const head = `#version 300 es\n#define TILE ${TILE}\n${defines}\n`;
    const all = repeated(fragment.map((name) => shaders[name]).join(""), planes);
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
  defines(kind, part, look, planes) {
    const { paint } = look;
    if (kind === "gbuffer" || kind === "source") look = { moved: look.moved, asksAway: look.asksAway, asksPart: look.asksPart, shown: kind };
    const { mesh, motion, channels } = part.header, isCubes = kind === "cubes";
    const lines = [`#define SHOWS_${kind === "probe" ? "PROBE" : look.shown.toUpperCase()}`];
    lines.push(...planeLines(part.header, planes), ...walkLines(isCubes ? { ...part.header, kept: 0 } : part.header, look.facing && !isCubes, look.filter));
    const flags = { PROBE: kind === "probe", PICKED: look.picked };
    Object.assign(flags, { MOVED: look.moved, FROM_REST: motion?.start === "rest", POSED: mesh?.posed || look.moved });
    Object.assign(flags, { TURNS: look.moved && motion?.turns });
    Object.assign(flags, { SOURCE: kind === "source", COMPARES: kind === "surface" && showsSource(part, look) });
    Object.assign(flags, { LAYERED: kind === "layers", AWAY: look.asksAway, PARTS: look.asksPart, BLENDS: kind === "surface" && look.isOver });
    Object.assign(flags, { RELIEF: kind === "surface" && showsRelief(this.parts, look) });
    Object.assign(flags, { KNOWN: look.beneath, PAINTS: paint && ["gbuffer", "layers", "surface"].includes(kind) });
    for (const [name, is] of Object.entries(flags)) if (is) lines.push(`#define ${name}`);
    const define = (name, text) => lines.push(`#define ${name} ${text}`);
    for (const channel of channels) {
      const { name, components, at } = channel;
      if (at[0] >= planes) continue;
      if (MATERIALS.includes(name) && (name !== "height" || components === 1)) define(name.toUpperCase(), sumOf(channel));
      if (name !== look.channel) continue;
      const color = (from) => (components === 2 ? `vec3(${from}.${lanesOf(channel)}, 0.0)` : `vec3(${from}.${lanesOf(channel)})`);
      define("CHANNEL", name === "alpha" ? "vec3(g_alpha)" : color(`g_sum${at[0]}`));
      define("CHANNEL_AT(at)", `PLANE${at[0]}(at)`);
      define("CHANNEL_STORED", color("stored"));
    }
    return lines.join("\n");
  }
}

// Whether the source is shown beside the octree.
export function showsSource(part, look) {
  const isColor = ["lit", "unlit"].includes(look.shown) || (look.shown === "channel" && look.channel === "base_color");
  return Boolean(part.source && isColor && look.divider > 0);
}

// How many planes of a part are read to show something.
export function planesFor(part, look) {
  const read = ["alpha"];
  if (look.shown === "lit") read.push(...MATERIALS);
  if (look.shown === "height") read.push("height");
  if (look.shown === "unlit") read.push("base_color", "emissive");
  if (["channel", "spread"].includes(look.shown)) read.push(look.channel);
  const known = read.map((name) => part.channel(name)).filter(Boolean).map((channel) => channel.at[0]);
  if (look.shown === "facing" || look.facing || part.header.kept) known.push(part.header.flags[0]);
  return Math.max(0, ...known) + 1;
}

// Whether heights bend the light.
export function showsRelief(parts, look) {
  return look.shown === "lit" && look.relief > 0 && parts.some((part) => part.channel("height")?.components === 1);
}
