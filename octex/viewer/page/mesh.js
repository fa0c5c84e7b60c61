// The mesh as it arrives. See pack.py.

import { planes } from "./octree.js";

export const signed = (number) => (number >>> 1) ^ -(number & 1);

function interleaved(columns, Kind, scale) {
  const found = new Kind(columns.length * columns[0].length);
  columns.forEach((column, k) => column.forEach((x, n) => (found[columns.length * n + k] = x * scale)));
  return found;
}

// A unit vector from its place on an unfolded octahedron.
export function unfolded(x, y) {
  const z = 1 - Math.abs(x) - Math.abs(y);
  if (z < 0) [x, y] = [(1 - Math.abs(y)) * (x < 0 ? -1 : 1), (1 - Math.abs(x)) * (y < 0 ? -1 : 1)];
  const length = Math.hypot(x, y, z) || 1;
  return [x / length, y / length, z / length];
}

// Positions at rest in the root cell and in the world, normals, all (n, 3); triangles; of a mesh that moves the
// surface's vertices, which own these, and if it is posed the normals at rest; of one with maps coordinates (n, 2), and
// colours (n, 3) in sRGB's codes; of one that is painted the numbers of its parts, if it has several.
export function unpackedMesh(header, bytes, source) {
  const { vertices: count, low, edge } = header;
  const { triangles, predictors, end } = followed(header, bytes);
  let at = end;
  const column = () => predicted(planes(bytes, count, (at += 4 * count) - 4 * count), predictors);
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
    normals.set(unfolded(flat[0][n] / 1023, flat[1][n] / 1023), 3 * n);
    upright?.set(unfolded(flatRest[0][n] / 1023, flatRest[1][n] / 1023), 3 * n);
  }
  return { rest, positions, normals, upright, triangles, owners, uv, colors, parts };
}

// Triangles as they follow one another, and of each vertex the three that predict it: an edge's ends, and the vertex opposite.
function followed(header, bytes) {
  const corners = planes(bytes, header.corners, 0), triangles = new Uint32Array(3 * header.triangles), predictors = new Uint32Array(3 * header.vertices);
  const waiting = []; // edges of triangles, by their first corner, the next one last
  let corner = 0, edge = 4 * header.corners, last = 0, next = 0;
  // The vertex of a corner; a new one is predicted.
  const vertex = (...predictor) => {
    const back = corners[corner++];
    if (back) return next - back;
    predictors.set(predictor, 3 * next);
    return next++;
  };
  const nextIn = (n) => (n % 3 === 2 ? n - 2 : n + 1);
  while (last < triangles.length) {
    const first = last;
    if (waiting.length) {
      const shared = waiting.pop(), start = triangles[shared], end = triangles[nextIn(shared)], opposite = triangles[nextIn(nextIn(shared))];
      if (!bytes[edge++]) continue;
      triangles.set([end, start, vertex(end, start, opposite)], first);
      waiting.push(first + 2, first + 1);
    } else {
      for (let side = 0; side < 3; side++) {
        const before = side ? triangles[first + side - 1] : Math.max(next - 1, 0);
        triangles[first + side] = vertex(before, before, before);
      }
      waiting.push(first, first + 1, first + 2);
    }
    last += 3;
  }
  return { triangles, predictors, end: 4 * header.corners + header.edges };
}

// A column's numbers, of what they are less than what is predicted.
function predicted(numbers, predictors) {
  const found = new Int32Array(numbers.length);
  found[0] = signed(numbers[0]);
  for (let n = 1, at = 3; n < numbers.length; n++, at += 3) {
    found[n] = found[predictors[at]] + found[predictors[at + 1]] - found[predictors[at + 2]] + signed(numbers[n]);
  }
  return found;
}
