// The mesh as it arrives. See pack.py.

import { planes } from "./octree.js";

export const signed = (number) => (number >>> 1) ^ -(number & 1);

export function summed(numbers) {
  const found = new Int32Array(numbers.length);
  for (let n = 0, sum = 0; n < numbers.length; n++) found[n] = sum += signed(numbers[n]);
  return found;
}

function interleaved(columns, Kind, scale) {
  const found = new Kind(columns.length * columns[0].length);
  columns.forEach((column, k) => column.forEach((x, n) => (found[columns.length * n + k] = x * scale)));
  return found;
}

// A unit vector from its place on an unfolded octahedron.
function unfolded(flat, n) {
  let x = flat[0][n] / 1023, y = flat[1][n] / 1023;
  const z = 1 - Math.abs(x) - Math.abs(y);
  if (z < 0) [x, y] = [(1 - Math.abs(y)) * (x < 0 ? -1 : 1), (1 - Math.abs(x)) * (y < 0 ? -1 : 1)];
  const length = Math.hypot(x, y, z) || 1;
  return [x / length, y / length, z / length];
}

// Positions at rest in the root cell and in the world, normals, all (n, 3); triangles; of a mesh that moves the
// surface's vertices, which own these, and if it is posed the normals at rest; of one with maps coordinates (n, 2), and colours (n, 3) in sRGB's codes; of
// one that is painted and hangs together in parts their numbers.
export function unpackedMesh(header, bytes, source) {
  const { vertices: count, low, edge } = header;
  let at = 0;
  const column = () => summed(planes(bytes, count, (at += 4 * count) - 4 * count));
  const columns = (n) => Array.from({ length: n }, column);
  const steps = columns(3), flat = columns(2), posed = header.posed ? columns(3) : steps;
  const owners = header.moves ? column() : null, flatRest = header.moves && header.posed ? columns(2) : null;
  const rest = new Float32Array(3 * count), positions = new Float32Array(3 * count), normals = new Float32Array(3 * count);
  const upright = flatRest && new Float32Array(3 * count);
  const uv = source ? interleaved(columns(2), Float32Array, 2 ** -source.bits) : null;
  const colors = source?.hasColors ? interleaved(columns(3), Uint8Array, 1) : null, parts = header.parts ? Uint32Array.from(column()) : null;
  const scale = 2 ** -header.bits;
  for (let n = 0; n < count; n++) {
    for (let axis = 0; axis < 3; axis++) {
      rest[3 * n + axis] = steps[axis][n] * scale;
      positions[3 * n + axis] = low[axis] + posed[axis][n] * scale * edge;
    }
    normals.set(unfolded(flat, n), 3 * n);
    upright?.set(unfolded(flatRest, n), 3 * n);
  }
  const back = planes(bytes, 3 * header.triangles, at), triangles = new Uint32Array(back.length);
  for (let n = 0, next = 0; n < back.length; n++) triangles[n] = back[n] === 0 ? next++ : next - back[n];
  return { rest, positions, normals, upright, triangles, owners, uv, colors, parts };
}
