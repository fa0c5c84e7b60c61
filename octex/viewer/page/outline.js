// The outline of the brush under the pointer: how far its paint goes on the surface, within that half its radius as the
// surface bends it, and a needle that shows how the surface is turned.

import { make } from "./elements.js";

const SVG = "http://www.w3.org/2000/svg";
const ANGLES = 64; // as in outline.frag

export class Outline {
  constructor(viewer) {
    this.viewer = viewer;
    const svg = document.createElementNS(SVG, "svg");
    this.lines = [0, 1].map(() => svg.appendChild(document.createElementNS(SVG, "path")));
    this.needle = make("i");
    this.note = make("b");
    this.ring = make("div", { id: "ring", hidden: true }, svg, this.needle, this.note);
    this.string = make("div", { id: "string", hidden: true });
  }

  hide() {
    this.ring.hidden = this.string.hidden = true;
  }

  // Show a string from one place to another.
  tie([x, y], [right, down]) {
    const { string } = this, length = Math.hypot(right - x, down - y);
    string.hidden = length < 1;
    string.style.width = `${length}px`;
    string.style.transform = `translate(${x}px, ${y}px) rotate(${Math.atan2(down - y, right - x)}rad)`;
  }

  // Show it around a place, so many CSS pixels wide; `below` is what lies there, see under.js.
  show([x, y], width, below, brush) {
    const { ring, needle, lines } = this, radius = width / 2, reach = below && this.reach([x, y], radius, below, brush);
    ring.hidden = false;
    ring.classList.toggle("beside", !reach);
    ring.style.width = ring.style.height = `${width}px`;
    ring.style.transform = `translate(${x - radius}px, ${y - radius}px)`;
    lines.forEach((line, k) => line.setAttribute("d", reach ? this.path(reach[k], radius) : ""));
    // The needle's length goes with the sine of the angle that the surface is seen at.
    const { normal = [0, 0, 1], toward = [0, 0, 1] } = below ?? {}, cosine = normal.reduce((sum, part, k) => sum + part * toward[k], 0);
    const [across, up] = normal.map((part, k) => part - cosine * toward[k]);
    needle.style.width = `${radius * Math.hypot(across, up)}px`;
    needle.style.transform = `rotate(${Math.atan2(-up, across)}rad)`;
  }

  path(reach, radius) {
    const at = (part, n) => [Math.cos, Math.sin].map((of, k) => radius * (1 + (k ? -1 : 1) * part * of((2 * Math.PI * (n + 0.5)) / reach.length)));
    return `M${reach.map((part, n) => at(part, n).map((x) => x.toFixed(1))).join("L")}Z`;
  }

  // How far it reaches at angles around the middle, in radii: paint, and half the radius along the surface.
  reach([x, y], radius, { away }, { angle, backFaces }) {
    const { viewer } = this, { gpu, canvas, camera, parts: [part], look } = viewer, { gl } = gpu, { gbuffer } = gpu.pictures, count = ANGLES;
    const target = gpu.target("outline", count, 1, [gl.RGBA32UI]), program = gpu.programs.use("outline", part, look, 0), times = gbuffer.height / canvas.clientHeight;
    const [u_positions, u_directions] = gbuffer.textures;
    gpu.bind(program, { u_positions, u_directions });
    gl.uniform3f(program.at("u_brush"), x * times, gbuffer.height - y * times, radius * times);
    gl.uniform1f(program.at("u_half"), (radius * Math.tan(camera.fov / 2) * away) / canvas.clientHeight / part.header.size);
    gl.uniform2f(program.at("u_limits"), Math.cos((angle * Math.PI) / 180), backFaces ? 1 : 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, count, 1);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    const parts = new Float32Array(gpu.words(target).buffer);
    return [0, 1].map((k) => Array.from({ length: count }, (_, n) => parts[4 * n + k]));
  }
}
