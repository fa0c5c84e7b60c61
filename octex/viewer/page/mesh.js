// Unpacks the mesh; octex/viewer/mesh.py describes its stream.

import { fromBytePlanes } from "./octree.js";

export const fromZigzag = (number) => (number >>> 1) ^ -(number & 1);

function interleaved(columns, Type, scale) {
  const values = new Type(columns.length * columns[0].length);
  columns.forEach((column, k) => column.forEach((x, n) => (values[columns.length * n + k] = x * scale)));
  return values;
}

// The unit vector of a point (−1 … 1) on the unfolded octahedron.
export function octahedronDirection(x, y) {
  const z = 1 - Math.abs(x) - Math.abs(y);
  if (z < 0) [x, y] = [(1 - Math.abs(y)) * (x < 0 ? -1 : 1), (1 - Math.abs(x)) * (y < 0 ? -1 : 1)];
  const length = Math.hypot(x, y, z) || 1;
  return [x / length, y / length, z / length];
}

// Unpack a mesh: rest positions in the root cell, world positions and normals (3 a vertex), and triangles. Optional, else
// null: `owners`, the surface's vertices, of an animated mesh; `restNormals` of one that is posed too; `uv` (2) and sRGB
// `colors` (3) of a mesh with images; `parts`, the connected part of each vertex, of a mesh to paint.
export function unpackedMesh(header, bytes, source) {
  const { vertices: count, low, edge } = header;
  const { triangles, predictors, end } = connectivity(header, bytes);
  let at = end;
  const column = () => predicted(fromBytePlanes(bytes, count, (at += 4 * count) - 4 * count), predictors);
  const columns = (n) => Array.from({ length: n }, column);
  const steps = columns(3), octahedral = columns(2), posed = header.posed ? columns(3) : steps;
  const owners = header.moves ? column() : null, restOctahedral = header.moves && header.posed ? columns(2) : null;
  const rest = new Float32Array(3 * count), positions = new Float32Array(3 * count), normals = new Float32Array(3 * count);
  const restNormals = restOctahedral && new Float32Array(3 * count);
  const uv = source ? interleaved(columns(2), Float32Array, 2 ** -source.bits) : null;
  const colors = source?.hasColors ? interleaved(columns(3), Uint8Array, 1) : null, parts = header.parts ? Uint32Array.from(column()) : null;
  const scale = 2 ** -header.bits;
  for (let n = 0; n < count; n++) {
    for (let axis = 0; axis < 3; axis++) {
      rest[3 * n + axis] = steps[axis][n] * scale;
      positions[3 * n + axis] = low[axis] + posed[axis][n] * scale * edge;
    }
    normals.set(octahedronDirection(octahedral[0][n] / 1023, octahedral[1][n] / 1023), 3 * n);
    restNormals?.set(octahedronDirection(restOctahedral[0][n] / 1023, restOctahedral[1][n] / 1023), 3 * n);
  }
  return { rest, positions, normals, restNormals, triangles, owners, uv, colors, parts };
}

// Decode the triangles, and the three vertices that predict each vertex: the ends of an edge, and the vertex opposite.
function connectivity(header, bytes) {
  const corners = fromBytePlanes(bytes, header.corners, 0), triangles = new Uint32Array(3 * header.triangles), predictors = new Uint32Array(3 * header.vertices);
  const waiting = []; // edges of decoded triangles, by their first corner; the next one is last
  let corner = 0, edge = 4 * header.corners, last = 0, next = 0;
  // Read the vertex of a corner: one that is known, or a new one with its predictors.
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

// Add the parallelogram's prediction to each number of a column.
function predicted(numbers, predictors) {
  const values = new Int32Array(numbers.length);
  values[0] = fromZigzag(numbers[0]);
  for (let n = 1, at = 3; n < numbers.length; n++, at += 3) {
    values[n] = values[predictors[at]] + values[predictors[at + 1]] - values[predictors[at + 2]] + fromZigzag(numbers[n]);
  }
  return values;
}
