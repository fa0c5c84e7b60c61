// Dabs along the way of a pen: each takes what is covered a part nearer to its own coverage, the flow, and never beyond.
// A flow of 1 makes what one line does; with less, paint builds up to the same.

const MOST_DABS = 32; // of a draw call, as in dabs.frag
const LEAST_STEP = 0.5; // pixels between dabs
export const CLOSE = 0.25; // dabs so near to each other, as a part of their size, look like a line

export class Dabs {
  constructor(strokes) {
    this.strokes = strokes;
    const { gpu } = strokes.viewer, { gl } = gpu, [width, height] = strokes.size;
    const fine = gl.getExtension("EXT_color_buffer_float") ? gl.R32F : gl.R8; // with 8 bits little flow is lost
    this.before = gpu.target("dabs before", width, height, [fine], strokes.target);
    this.after = gpu.target("dabs after", width, height, [fine, gl.R8], strokes.target);
    gpu.clear(this.before);
    this.left = 0; // pixels to the next dab
  }

  // Put dabs on a line from one place to another: x, y, radius and strength, in pixels from the lower left. Returns their box.
  draw(from, to, { spacing, flow, hardness }) {
    const length = Math.hypot(to[0] - from[0], to[1] - from[1]), dabs = [];
    for (; this.left <= length; ) {
      const t = length ? this.left / length : 0, dab = from.map((number, k) => number + t * (to[k] - number));
      dabs.push(dab);
      this.left += Math.max(2 * spacing * dab[2], LEAST_STEP);
    }
    this.left -= length;
    let box = null;
    for (let n = 0; n < dabs.length; n += MOST_DABS) box = joined(box, this.put(dabs.slice(n, n + MOST_DABS), flow, hardness));
    return box;
  }

  put(dabs, flow, hardness) {
    const { viewer, size, target } = this.strokes, { gpu } = viewer, { gl } = gpu, box = clipped(reached(dabs), size);
    if (!box) return null;
    const program = gpu.programs.use("dabs", viewer.parts[0], viewer.look, 0);
    gpu.bind(program, { u_before: this.before.textures[0] });
    gl.uniform4fv(program.at("u_dabs[0]"), dabs.flat());
    gl.uniform1i(program.at("u_count"), dabs.length);
    gl.uniform1f(program.at("u_flow"), flow);
    gl.uniform1f(program.at("u_hardness"), hardness);
    gpu.drawOn(this.after, box, () => gl.drawArrays(gl.TRIANGLES, 0, 3));
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.after.buffer);
    [this.before, target].forEach(({ buffer }, number) => {
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + number);
      gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, buffer);
      gl.blitFramebuffer(...box, ...box, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return box;
  }
}

// The box (left, bottom, right, top) of discs, each with its middle and radius.
export function reached(discs) {
  const ends = (k, sign) => discs.map((disc) => disc[k] + sign * disc[2]);
  return [0, 1].map((k) => Math.floor(Math.min(...ends(k, -1))) - 1).concat([0, 1].map((k) => Math.ceil(Math.max(...ends(k, 1))) + 1));
}

// What of a box is in a picture of a size; null for nothing.
export function clipped([left, bottom, right, top], [width, height]) {
  const box = [Math.max(left, 0), Math.max(bottom, 0), Math.min(right, width), Math.min(top, height)];
  return box[0] < box[2] && box[1] < box[3] ? box : null;
}

// The box (left, low, right, high) of a picture's pixels that are so; null for none.
export function boxOf(width, height, is) {
  let [left, low, right, high] = [width, height, 0, 0];
  for (let row = 0, n = 0; row < height; row++) {
    for (let column = 0; column < width; column++, n++) {
      if (!is(n)) continue;
      left = Math.min(left, column);
      right = Math.max(right, column + 1);
      low = Math.min(low, row);
      high = row + 1;
    }
  }
  return left < right ? [left, low, right, high] : null;
}

// The box around two: left, low, right, high; either may be none.
export function joined(one, other) {
  if (!one || !other) return one ?? other;
  return one.map((at, n) => (n < 2 ? Math.min(at, other[n]) : Math.max(at, other[n])));
}
