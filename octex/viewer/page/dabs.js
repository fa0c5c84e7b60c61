// Dabs along the path of a stroke. Each moves the coverage by the share `flow` towards the dab's own coverage, and never
// beyond: with flow 1 dabs cover as one line does, with less the paint builds up to that.

import { boxOfDiscs, clippedBox, unionOf } from "./boxes.js";

const MAX_DABS = 32; // in a draw call, as in dabs.frag
const MIN_STEP = 0.5; // pixels between dabs
export const LINE_SPACING = 0.25; // up to this spacing, as a share of their size, dabs look like a line

export class Dabs {
  constructor(strokes) {
    this.strokes = strokes;
    const { gpu } = strokes.viewer, { gl } = gpu, [width, height] = strokes.size;
    const precise = gl.getExtension("EXT_color_buffer_float") ? gl.R32F : gl.R8; // 8 bits would lose a small flow
    this.before = gpu.target("dabs before", width, height, [precise], strokes.target);
    this.after = gpu.target("dabs after", width, height, [precise, gl.R8], strokes.target);
    gpu.clear(this.before);
    this.rest = 0; // pixels to the next dab
  }

  // Draw dabs on a line between two places: x, y, radius and strength, in pixels from the lower left. Returns their box.
  draw(from, to, { spacing, flow, hardness }) {
    const length = Math.hypot(to[0] - from[0], to[1] - from[1]), dabs = [];
    while (this.rest <= length) {
      const t = length ? this.rest / length : 0, dab = from.map((number, k) => number + t * (to[k] - number));
      dabs.push(dab);
      this.rest += Math.max(2 * spacing * dab[2], MIN_STEP);
    }
    this.rest -= length;
    let box = null;
    for (let n = 0; n < dabs.length; n += MAX_DABS) box = unionOf(box, this.drawSome(dabs.slice(n, n + MAX_DABS), flow, hardness));
    return box;
  }

  drawSome(dabs, flow, hardness) {
    const { viewer, size, target } = this.strokes, { gpu } = viewer, { gl } = gpu, box = clippedBox(boxOfDiscs(dabs), size);
    if (!box) return null;
    const program = gpu.programs.use("dabs", viewer.parts[0], viewer.display, 0);
    gpu.bind(program, { u_before: this.before.textures[0] });
    program.set({ u_dabs: dabs, u_count: dabs.length, u_flow: flow, u_hardness: hardness });
    gpu.drawInBox(this.after, box, () => gl.drawArrays(gl.TRIANGLES, 0, 3));
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
