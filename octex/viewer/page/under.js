// What lies under the pointer, as gbuffer.frag has drawn it for the picture that is shown.

import { unfolded } from "./mesh.js";

// The unit vector that gbuffer.frag has packed.
const unpacked = (bits) => unfolded(...[bits << 16, bits].map((part) => Math.max((part >> 16) / 32767, -1)));

// At a place of the picture, in CSS pixels: where the surface rests, its normal and the direction towards the camera in
// view space, and how far along the view it is; or null where nothing is.
export function under(viewer, x, y) {
  const { gpu, canvas, parts, camera } = viewer, { gbuffer } = gpu.pictures;
  if (!gbuffer || !viewer.isDrawn || viewer.isLost || gpu.showsCubes(viewer.look)) return null;
  const column = Math.floor((x / canvas.clientWidth) * gbuffer.width), row = Math.floor((1 - y / canvas.clientHeight) * gbuffer.height);
  if (!(column >= 0 && column < gbuffer.width && row >= 0 && row < gbuffer.height)) return null;
  const [place, ways] = [0, 1].map((number) => gpu.words(gbuffer, number, [column, row, column + 1, row + 1]));
  const [a, b, c, width] = new Float32Array(place.buffer);
  if (!(width > 0)) return null;
  const { origin, size, mesh } = parts[0].header, { view } = camera;
  const rest = [a, b, c].map((at, n) => origin[n] + size * at), [p, q, r] = rest;
  const away = mesh.posed || viewer.look.moved ? gpu.awayAt(viewer.look, camera, [x, y], [canvas.clientWidth, canvas.clientHeight]) : -(view[2] * p + view[6] * q + view[10] * r + view[14]);
  return { rest, normal: unpacked(ways[0]), toward: unpacked(ways[1]), away };
}
