// The code and uniforms that walk.glsl needs for a texture: where channels are stored, and which lookups it uses.

const LANES = "xyzw";

// GLSL that reads a texel of a plane at `at`.
function planeFetch(planes, number) {
  const isSrgb = planes[number], layer = planes.slice(0, number).filter((is) => is === isSrgb).length;
  return `texelFetch(${isSrgb ? "u_srgb" : "u_linear"}, ivec3(at, ${layer}), 0)`;
}

// The swizzle of a channel's components in its plane, at most three.
export const swizzleOf = ({ at: [, slot], components }) => LANES.slice(slot, slot + Math.min(components, 3));

// GLSL of a looked-up channel, in its own range.
export function channelSum(channel) {
  const { at: [plane], range: [low, high] } = channel, value = `g_sum${plane}.${swizzleOf(channel)}`;
  return low === 0 && high === 1 ? value : `(${low.toExponential()} + ${(high - low).toExponential()} * ${value})`;
}

// Define how the first planes are read, and flags and alpha if these planes have them.
export function planeDefines({ channels, flags: [plane, slot], planes }, count) {
  const lines = [`#define PLANES ${count}`];
  for (let n = 0; n < count; n++) lines.push(`#define PLANE${n}(at) ${planeFetch(planes, n)}`);
  for (const [name, from] of [["FLAGS_AT(at)", `PLANE${plane}(at)`], ["FLAGS", `value${plane}`]]) {
    if (plane < count) lines.push(`#define ${name} uint(${from}.${LANES[slot]} * 255.0 + 0.5)`);
  }
  const alpha = channels.find(({ name, components }) => name === "alpha" && components === 1);
  if (alpha && alpha.at[0] < count) lines.push(`#define ALPHA value${alpha.at[0]}.${swizzleOf(alpha)}`);
  return lines;
}

// Define which lookups an octree needs. With `facing`, split cells show the value of the side that the camera sees.
export function walkDefines({ isMixed, split, kept }, facing, filter) {
  const flags = { MIXED: isMixed, KEPT: isMixed && kept > 0, FACING: facing, SPLIT: facing && split[0] > 0 };
  Object.assign(flags, { NEAREST: filter === "nearest", LINEAR: filter === "linear" });
  return Object.keys(flags).filter((name) => flags[name]).map((name) => `#define ${name}`);
}

// Repeat the shader lines with {N} for each plane.
export function withEachPlane(text, planes) {
  return text.replace(/^.*\{N\}.*$/gm, (line) => Array.from({ length: planes }, (_, n) => line.replaceAll("{N}", n)).join("\n"));
}

// The uniforms of an octree that is looked up down to a level.
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
