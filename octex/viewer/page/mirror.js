// The mirrored view of a stroke's camera: it shows where the mirror image of the stroke lands.

import { dot } from "./camera.js";

// The product of two matrices, column by column.
export function product(a, b) {
  const entry = (n) => [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + (n % 4)] * b[4 * Math.floor(n / 4) + k], 0);
  return Float32Array.from({ length: 16 }, (_, n) => entry(n));
}

// The reflection across the plane at a position on an axis.
function reflection(axis, position) {
  const matrix = Float32Array.from({ length: 16 }, (_, n) => (n % 5 ? 0 : 1));
  matrix[5 * axis] = -1;
  matrix[12 + axis] = 2 * position;
  return matrix;
}

export class Mirror {
  constructor(viewer) {
    this.viewer = viewer;
    this.key = ""; // of the stroke and the view that it was prepared for
  }

  // A key of a stroke's mirror and view; "" if there is no mirror. It is "" for posed models too: the page does not know
  // where the mirror image lies on them.
  keyOf({ mirror, offset = 0 }, viewKey) {
    const { display, parts } = this.viewer;
    return mirror && !display.moment && !parts[0].header.mesh?.posed ? `${mirror} ${offset} ${viewKey}` : "";
  }

  // Whether this is the mirror of a stroke on a view.
  isOf(stroke, viewKey) {
    return this.key !== "" && this.keyOf(stroke, viewKey) === this.key;
  }

  // Prepare for a stroke. `rootToClip` is its camera's matrix, from the root cell to clip space; the size is the image's.
  prepare(stroke, viewKey, rootToClip, [width, height]) {
    const { viewer } = this, { gpu, camera, parts, display } = viewer, key = this.keyOf(stroke, viewKey);
    if (key === this.key || !key) return;
    this.key = key;
    const axis = "xyz".indexOf(stroke.mirror), [low, high] = viewer.bounds().map((corner) => corner[axis]), { origin, size } = parts[0].header;
    const position = (low + high) / 2 + (stroke.offset ?? 0), inRoot = reflection(axis, (position - origin[axis]) / size);
    const projection = camera.projection(), shift = 2 * Math.abs(stroke.offset ?? 0); // the mirrored model is nearer or farther by this
    const near = Math.max(projection[14] / (projection[10] - 1) - shift, 1e-3 * camera.distance), far = projection[14] / (projection[10] + 1) + shift;
    projection[10] = -(far + near) / (far - near);
    projection[14] = (-2 * far * near) / (far - near);
    Object.assign(this, { axis, position, camera: product(rootToClip, inRoot) });
    this.eye = camera.position.map((x, n) => ((n === axis ? 2 * position - x : x) - origin[n]) / size);
    this.gbuffer = gpu.uintTarget("mirror gbuffer", width, height);
    const mirrored = { view: product(camera.view, reflection(axis, position)), projection: () => projection };
    gpu.drawGBuffer({ ...display, strokes: true, writesPart: true }, mirrored, this.gbuffer, width, height);
  }

  // The box of the view, in CSS pixels, that can show the mirror image of a brush at a hit of the surface; see hit.js.
  boxAround({ rest, normal, toward, depth }, brushWidth) {
    const { camera, canvas } = this.viewer, facing = Math.max(dot(normal, toward), 0.2);
    const reach = (brushWidth * Math.tan(camera.fov / 2) * depth) / canvas.clientHeight / facing, matrix = product(camera.projection(), camera.view);
    const middle = rest.map((x, n) => (n === this.axis ? 2 * this.position - x : x));
    const corners = Array.from({ length: 8 }, (_, n) => [...middle.map((x, k) => x + (n & (1 << k) ? reach : -reach)), 1]);
    const [across, down] = [0, 1].map((row) => corners.map((corner) => {
      const [at, w] = [row, 3].map((entry) => corner.reduce((sum, x, k) => sum + matrix[4 * k + entry] * x, 0));
      return row ? (0.5 - (0.5 * at) / w) * canvas.clientHeight : (0.5 + (0.5 * at) / w) * canvas.clientWidth;
    }));
    return [Math.min(...across), Math.min(...down), Math.max(...across), Math.max(...down)];
  }
}
