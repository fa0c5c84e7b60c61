// What a mirror shows of the strokes' camera: where their other halves land.

// Of matrices, column after column.
export function product(a, b) {
  const entry = (n) => [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + (n % 4)] * b[4 * Math.floor(n / 4) + k], 0);
  return Float32Array.from({ length: 16 }, (_, n) => entry(n));
}

// The mirror across an axis at a place.
function reflection(axis, place) {
  const made = Float32Array.from({ length: 16 }, (_, n) => (n % 5 ? 0 : 1));
  made[5 * axis] = -1;
  made[12 + axis] = 2 * place;
  return made;
}

export class Mirror {
  constructor(viewer) {
    this.viewer = viewer;
    this.key = ""; // of what it was made for
  }

  // What tells mirrors apart; nothing for strokes without one, and on posed models, whose other halves are not known
  // before they are painted.
  keyOf({ mirror, offset = 0 }, view) {
    const { look, parts } = this.viewer;
    return mirror && !look.moved && !parts[0].header.mesh?.posed ? `${mirror} ${offset} ${view}` : "";
  }

  // Whether it is the mirror of a stroke on a view.
  isOf(stroke, view) {
    return this.key !== "" && this.keyOf(stroke, view) === this.key;
  }

  // Be ready for a stroke whose camera sees the root cell so, in a picture of a size.
  fit(stroke, view, seen, [width, height]) {
    const { viewer } = this, { gpu, camera, parts, look } = viewer, key = this.keyOf(stroke, view);
    if (key === this.key || !key) return;
    this.key = key;
    const axis = "xyz".indexOf(stroke.mirror), [low, high] = viewer.bounds().map((corner) => corner[axis]), { origin, size } = parts[0].header;
    const place = (low + high) / 2 + (stroke.offset ?? 0), inRoot = reflection(axis, (place - origin[axis]) / size);
    const projection = camera.projection(), reach = 2 * Math.abs(stroke.offset ?? 0); // that the model is nearer or farther in it
    const near = Math.max(projection[14] / (projection[10] - 1) - reach, 1e-3 * camera.distance), far = projection[14] / (projection[10] + 1) + reach;
    projection[10] = -(far + near) / (far - near);
    projection[14] = (-2 * far * near) / (far - near);
    Object.assign(this, { axis, place, camera: product(seen, inRoot) });
    this.eye = camera.position.map((x, n) => ((n === axis ? 2 * place - x : x) - origin[n]) / size);
    this.gbuffer = gpu.targetOfTwo("mirror gbuffer", width, height);
    const shown = { view: product(camera.view, reflection(axis, place)), projection: () => projection };
    gpu.drawGBuffer({ ...look, paint: true, asksPart: true }, shown, this.gbuffer, width, height);
  }

  // Where the picture may show the other half of what is drawn around a place of the surface, so many CSS pixels wide; see
  // under.js.
  around({ rest, normal, toward, away }, width) {
    const { camera, canvas } = this.viewer, facing = Math.max(normal.reduce((sum, x, k) => sum + x * toward[k], 0), 0.2);
    const reach = (width * Math.tan(camera.fov / 2) * away) / canvas.clientHeight / facing, seen = product(camera.projection(), camera.view);
    const middle = rest.map((x, n) => (n === this.axis ? 2 * this.place - x : x)), corners = Array.from({ length: 8 }, (_, n) => [
      ...middle.map((x, k) => x + (n & (1 << k) ? reach : -reach)), 1]);
    const [across, down] = [0, 1].map((row) => corners.map((corner) => {
      const [at, w] = [row, 3].map((entry) => corner.reduce((sum, x, k) => sum + seen[4 * k + entry] * x, 0));
      return row ? (0.5 - (0.5 * at) / w) * canvas.clientHeight : (0.5 + (0.5 * at) / w) * canvas.clientWidth;
    }));
    return [Math.min(...across), Math.min(...down), Math.max(...across), Math.max(...down)];
  }
}
