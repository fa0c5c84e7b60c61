// How shaders read an octree: what stands in walk.glsl for the planes and channels of a part, and its uniforms.

const LANES = "xyzw";

// How shaders read a plane, with a place in braces.
function readPlane({ planes }, number) {
  const isSrgb = planes[number], layer = planes.slice(0, number).filter((is) => is === isSrgb).length;
  return `texelFetch(${isSrgb ? "u_srgb" : "u_linear"}, ivec3(at, ${layer}), 0)`;
}

// The components of a channel, at most three, in a vector of its plane.
export const lanesOf = ({ at: [, slot], components }) => LANES.slice(slot, slot + Math.min(components, 3));

// A channel among the sums that are looked up, in its own range.
export function sumOf(channel) {
  const { at: [plane], range: [low, high] } = channel, value = `g_sum${plane}.${lanesOf(channel)}`;
  return low === 0 && high === 1 ? value : `(${low.toExponential()} + ${(high - low).toExponential()} * ${value})`;
}

// Lines that define how the first planes, and the flags and alpha if they are among these, are read.
export function planeLines({ channels, flags: [plane, slot], planes: all }, planes) {
  const lines = [`#define PLANES ${planes}`];
  for (let n = 0; n < planes; n++) lines.push(`#define PLANE${n}(at) ${readPlane({ planes: all }, n)}`);
  for (const [name, from] of [["FLAGS_AT(at)", `PLANE${plane}(at)`], ["FLAGS", `value${plane}`]]) {
    if (plane < planes) lines.push(`#define ${name} uint(${from}.${LANES[slot]} * 255.0 + 0.5)`);
  }
  const alpha = channels.find(({ name, components }) => name === "alpha" && components === 1);
  if (alpha && alpha.at[0] < planes) lines.push(`#define ALPHA value${alpha.at[0]}.${lanesOf(alpha)}`);
  return lines;
}

// Lines that define which walk an octree needs; with `facing` cells show the side that is looked at.
export function walkLines({ isMixed, split, kept }, facing, filter) {
  const flags = { MIXED: isMixed, KEPT: isMixed && kept > 0, FACING: facing, SPLIT: facing && split[0] > 0 };
  Object.assign(flags, { NEAREST: filter === "nearest", LINEAR: filter === "linear" });
  return Object.keys(flags).filter((name) => flags[name]).map((name) => `#define ${name}`);
}

// A shader's text, in which lines with N in braces stand for each plane.
export function repeated(text, planes) {
  return text.replace(/^.*\{N\}.*$/gm, (line) => Array.from({ length: planes }, (_, n) => line.replaceAll("{N}", n)).join("\n"));
}

// The uniforms of an octree's walk.
export function walkUniforms({ cells, nodes, depth, entries, tables: { kept, split } }, level) {
  const nCells = cells.at(-1);
  return {
    u_kept: [0, kept, nCells],
    u_keptLevel: kept ? cells.findLastIndex((first) => first <= entries[0]) : depth,
    u_split: [kept, split, nCells + kept],
    u_leafRoot: nodes.at(-1) === 0 ? 1 : 0,
    u_depth: Math.min(level, depth),
  };
}
