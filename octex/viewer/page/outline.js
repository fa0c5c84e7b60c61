// The outline of the brush: the extent of its paint on the surface, within that half its radius measured along the surface,
// and a needle along the normal.

import { dot } from "./camera.js";
import { make } from "./elements.js";

const ANGLES = 64; // as in outline.frag

export class Outline {
  constructor(viewer) {
    this.viewer = viewer;
    this.paths = [make("path"), make("path")];
    this.needle = make("i");
    this.note = make("b");
    this.ring = make("div", { id: "ring", hidden: true }, make("svg", {}, ...this.paths), this.needle, this.note);
    this.string = make("div", { id: "string", hidden: true });
  }

  hide() {
    this.ring.hidden = this.string.hidden = true;
  }

  // Show a string between two places: from the brush to the pen, or to the end of a straight line.
  showString([x, y], [right, down]) {
    const { string } = this, length = Math.hypot(right - x, down - y);
    string.hidden = length < 1;
    string.style.width = `${length}px`;
    string.style.transform = `translate(${x}px, ${y}px) rotate(${Math.atan2(down - y, right - x)}rad)`;
  }

  // Show the outline around a place with a width in CSS pixels; `hit` is the surface there, see hit.js.
  show([x, y], width, hit, brush) {
    const { ring, needle, paths } = this, radius = width / 2, extents = hit && this.extents([x, y], radius, hit, brush);
    ring.hidden = false;
    ring.classList.toggle("beside", !extents);
    ring.style.width = ring.style.height = `${width}px`;
    ring.style.transform = `translate(${x - radius}px, ${y - radius}px)`;
    paths.forEach((path, k) => path.setAttribute("d", extents ? this.pathOf(extents[k], radius) : ""));
    // The needle is the normal's part across the view.
    const { normal = [0, 0, 1], toward = [0, 0, 1] } = hit ?? {}, cosine = dot(normal, toward);
    const [across, up] = normal.map((component, k) => component - cosine * toward[k]);
    needle.style.width = `${radius * Math.hypot(across, up)}px`;
    needle.style.transform = `rotate(${Math.atan2(-up, across)}rad)`;
  }

  pathOf(extents, radius) {
    const points = extents.map((extent, n) => {
      const angle = (2 * Math.PI * (n + 0.5)) / extents.length;
      return [1 + extent * Math.cos(angle), 1 - extent * Math.sin(angle)].map((x) => (radius * x).toFixed(1));
    });
    return `M${points.join("L")}Z`;
  }

  // Measure at angles around the place, in radii: the extent of paint, and half the radius along the surface.
  extents([x, y], radius, { depth }, { angle, backFaces }) {
    const { viewer } = this, { gpu, canvas, camera, parts: [part], display } = viewer, { gl } = gpu, { gbuffer } = gpu.targets;
    const target = gpu.target("outline", ANGLES, 1, [gl.RGBA32UI]), program = gpu.programs.use("outline", part, display, 0);
    const scale = gbuffer.height / canvas.clientHeight, [u_positions, u_directions] = gbuffer.textures;
    gpu.bind(program, { u_positions, u_directions });
    program.set({
      u_brush: [x * scale, gbuffer.height - y * scale, radius * scale], u_limits: [Math.cos((angle * Math.PI) / 180), backFaces],
      u_half: (radius * Math.tan(camera.fov / 2) * depth) / canvas.clientHeight / part.header.size,
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, ANGLES, 1);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    const values = new Float32Array(gpu.readUints(target).buffer);
    return [0, 1].map((k) => Array.from({ length: ANGLES }, (_, n) => values[4 * n + k]));
  }
}
