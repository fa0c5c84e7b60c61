// The camera, which orbits a target. Angles are in radians, matrices column by column.

const MIN_DISTANCE = 1e-3, MAX_DISTANCE = 100; // from the target, in the model's radius
const SAME_MODEL = 0.25; // largest difference between the bounds of one model, in its radius
const MAX_TILT = Math.PI / 2 - 0.001;

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

export class Camera {
  constructor(low, high) {
    this.low = low; // corners of the model's bounding box
    this.high = high;
    this.turn = 0.55;
    this.tilt = 0.3;
    this.fov = 0.6;
    this.aspect = 4 / 3;
    this.isFlat = false; // a patch that is laid flat: it is seen from the front only
    this.reset();
  }

  get radius() {
    return 0.5 * Math.hypot(...this.high.map((x, n) => x - this.low[n])) || 1;
  }

  // Show the whole model, from the current direction or a given one.
  reset(turn = this.turn, tilt = this.tilt) {
    [this.turn, this.tilt] = this.isFlat ? [0, 0] : [turn, tilt];
    this.target = this.low.map((x, n) => (x + this.high[n]) / 2);
    const narrow = Math.min(1, this.aspect);
    this.distance = (1.02 * this.radius) / Math.sin(Math.atan(Math.tan(this.fov / 2) * narrow));
  }

  get backward() {
    const across = Math.cos(this.tilt);
    return [Math.sin(this.turn) * across, Math.sin(this.tilt), Math.cos(this.turn) * across];
  }

  get axes() {
    const back = this.backward, right = [Math.cos(this.turn), 0, -Math.sin(this.turn)];
    return [right, cross(back, right), back];
  }

  get position() {
    return this.target.map((x, n) => x + this.distance * this.backward[n]);
  }

  get view() {
    const [x, y, z] = this.axes, at = this.position;
    const columns = [0, 1, 2].map((n) => [x[n], y[n], z[n], 0]);
    return new Float32Array([...columns.flat(), -dot(x, at), -dot(y, at), -dot(z, at), 1]);
  }

  // The projection of the whole image, or of one pixel (column, row, from the upper left) of an image of a size.
  projection(pixel = null, size = null) {
    const depth = dot(this.backward, this.position.map((x, n) => x - (this.low[n] + this.high[n]) / 2)); // of the model's middle
    const near = Math.max(depth - 1.1 * this.radius, 0.002 * Math.min(this.distance, this.radius));
    const far = Math.max(depth + 1.1 * this.radius, 2 * near);
    const high = near * Math.tan(this.fov / 2), wide = high * this.aspect;
    let [left, right, bottom, top] = [-wide, wide, -high, high];
    if (pixel) {
      const [w, h] = size, x = -wide + (2 * wide * pixel[0]) / w, y = high - (2 * high * pixel[1]) / h;
      [left, right, bottom, top] = [x, x + (2 * wide) / w, y - (2 * high) / h, y];
    }
    return new Float32Array([
      (2 * near) / (right - left), 0, 0, 0,
      0, (2 * near) / (top - bottom), 0, 0,
      (right + left) / (right - left), (top + bottom) / (top - bottom), -(far + near) / (far - near), -1,
      0, 0, (-2 * far * near) / (far - near), 0,
    ]);
  }

  // The content of an octex camera file, for an image of a size in pixels.
  file(name, width, height) {
    const high = Math.tan(this.fov / 2), at = this.position, [x, y, z] = this.axes;
    const rows = [x, y.map((a) => -a), z.map((a) => -a)].map((axis) => [...axis, -dot(axis, at)]);
    const K = [[width / 2 / (high * this.aspect), 0, width / 2], [0, height / 2 / high, height / 2], [0, 0, 1]];
    const camera = { name, width, height, projection: "pinhole", K, pose: [...rows, [0, 0, 0, 1]], convention: "opencv" };
    return { octex_cameras: 1, cameras: [camera] };
  }

  // Turn around the target; a flat patch is panned instead.
  orbit(turn, tilt) {
    if (this.isFlat) return this.pan(-turn / 4, -tilt / 4);
    this.turn += turn;
    this.tilt = Math.min(Math.max(this.tilt + tilt, -MAX_TILT), MAX_TILT);
  }

  // Move the model in the image, by shares of its height.
  pan(right, up) {
    const step = 2 * this.distance * Math.tan(this.fov / 2), [x, y] = this.axes;
    this.target = this.target.map((at, n) => at - step * (right * x[n] + up * y[n]));
  }

  // The point that a pixel shows at a depth along the view; by default at the target's depth.
  pointAt([x, y], [width, height], depth = this.distance) {
    const high = depth * Math.tan(this.fov / 2), right = ((2 * x) / width - 1) * high * this.aspect, up = (1 - (2 * y) / height) * high;
    const [along, above, back] = this.axes, at = this.position;
    return at.map((p, n) => p + right * along[n] + up * above[n] - depth * back[n]);
  }

  // Project a point to pixels from the upper left; null behind the camera.
  project(point, [width, height]) {
    const from = point.map((p, n) => p - this.position[n]), [along, above, back] = this.axes;
    const depth = -dot(from, back), high = depth * Math.tan(this.fov / 2);
    return depth > 0 ? [(1 + dot(from, along) / (high * this.aspect)) * (width / 2), (1 - dot(from, above) / high) * (height / 2)] : null;
  }

  // Move closer to a point by a factor; the point stays in place in the image.
  zoom(factor, point = this.target) {
    const before = this.distance;
    this.distance = Math.min(Math.max(before / factor, MIN_DISTANCE * this.radius), MAX_DISTANCE * this.radius);
    this.target = point.map((p, n) => p + (this.target[n] - p) * (this.distance / before));
  }

  // Make a point the target, and move close to it.
  focus(point) {
    const distance = Math.hypot(...this.position.map((p, n) => p - point[n]));
    this.target = point;
    this.distance = Math.max(Math.min(distance, this.radius), MIN_DISTANCE * this.radius);
  }

  // The camera's pose, and the bounds of its model.
  get state() {
    const { turn, tilt, target, distance, low, high } = this;
    return { turn, tilt, target, distance, low, high };
  }

  // Restore a state, unless it is of another model.
  restore({ low, high, ...pose }) {
    const differences = [...low.map((x, n) => x - this.low[n]), ...high.map((x, n) => x - this.high[n])];
    if (Math.max(...differences.map(Math.abs)) < SAME_MODEL * this.radius) Object.assign(this, pose);
  }
}
