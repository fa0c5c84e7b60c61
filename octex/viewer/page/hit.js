// Reads the surface under the pointer from the G-buffer of the last image.

import { clippedBox } from "./boxes.js";
import { octahedronDirection } from "./mesh.js";

// Unpack a unit vector, as packDirection of directions.glsl packs it.
const unpackDirection = (bits) => octahedronDirection(...[bits << 16, bits].map((half) => Math.max((half >> 16) / 32767, -1)));

// The G-buffer of the last image; null if it does not show the surface as it is.
function gbufferOf({ gpu, display, isDrawn, isContextLost }) {
  return isDrawn && !isContextLost && !gpu.showsCubes(display) ? gpu.targets.gbuffer : null;
}

// Whether a disc of the image, in CSS pixels, meets the surface.
export function isHitIn(viewer, [x, y, radius]) {
  const gbuffer = gbufferOf(viewer), { gpu, canvas: { clientWidth, clientHeight } } = viewer;
  if (!gbuffer) return false;
  const { width, height } = gbuffer, across = width / clientWidth, down = height / clientHeight, [column, row] = [x * across, height - y * down];
  const ends = [column - radius * across, row - radius * down, column + radius * across, row + radius * down].map(Math.round);
  const box = clippedBox(ends, [width, height]);
  if (!box) return false;
  const [left, bottom, right] = box, footprints = new Float32Array(gpu.readUints(gbuffer, 0, box).buffer);
  for (let n = 3; n < footprints.length; n += 4) {
    const pixel = (n - 3) / 4, dx = left + (pixel % (right - left)) + 0.5 - column, dy = bottom + Math.floor(pixel / (right - left)) + 0.5 - row;
    if (footprints[n] > 0 && Math.hypot(dx / across, dy / down) < radius) return true;
  }
  return false;
}

// At a position of the image, in CSS pixels: the rest position, the normal and the direction to the camera in view space,
// and the depth along the view. Null for the background.
export function hitAt(viewer, x, y) {
  const { gpu, canvas, parts, camera, display } = viewer, gbuffer = gbufferOf(viewer);
  if (!gbuffer) return null;
  const column = Math.floor((x / canvas.clientWidth) * gbuffer.width), row = Math.floor((1 - y / canvas.clientHeight) * gbuffer.height);
  if (!(column >= 0 && column < gbuffer.width && row >= 0 && row < gbuffer.height)) return null;
  const [positions, directions] = [0, 1].map((number) => gpu.readUints(gbuffer, number, [column, row, column + 1, row + 1]));
  const [a, b, c, footprint] = new Float32Array(positions.buffer);
  if (!(footprint > 0)) return null;
  const { origin, size, mesh } = parts[0].header, { view } = camera;
  const rest = [a, b, c].map((at, n) => origin[n] + size * at), [p, q, r] = rest;
  const isPosed = mesh.posed || display.moment; // then the rest position is not where the surface is
  const depth = isPosed ? gpu.depthAt(display, camera, [x, y], [canvas.clientWidth, canvas.clientHeight]) : -(view[2] * p + view[6] * q + view[10] * r + view[14]);
  return { rest, normal: unpackDirection(directions[0]), toward: unpackDirection(directions[1]), depth };
}
