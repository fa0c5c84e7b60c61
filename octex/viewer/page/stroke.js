// The stroke that is drawn, and those that the server has not painted yet: what the picture shows of them.

export const MOST_ANGLE = 85; // degrees beyond which nothing is painted, unless it is set otherwise
const FADE = 10; // and over which paint fades

const cosine = (degrees) => Math.cos((degrees * Math.PI) / 180);
export const toLight = (code) => (code <= 10.31475 ? code / 255 / 12.92 : ((code / 255 + 0.055) / 1.055) ** 2.4);
const LIGHTS = Float32Array.from({ length: 256 }, (_, code) => toLight(code));

// Of matrices, column after column.
function product(a, b) {
  const entry = (n) => [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + (n % 4)] * b[4 * Math.floor(n / 4) + k], 0);
  return Float32Array.from({ length: 16 }, (_, n) => entry(n));
}

// The smallest box around two (left, bottom, right, top), of which the first may be none.
export const around = (a, b) => (a ? [Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.max(a[2], b[2]), Math.max(a[3], b[3])] : b);

export class Strokes {
  constructor(viewer) {
    this.viewer = viewer;
    this.channel = "base_color";
    this.current = null; // color or picture, opacity, hardness, box
    this.sent = []; // what is not painted yet: number, box, coverage, opacity, color or planes of colors
    this.size = [0, 0];
  }

  // Make all anew, as after a lost context.
  build() {
    this.size = [0, 0];
    this.fit();
    this.compose();
  }

  // Be ready for strokes on the view as it is now. Those that were sent from another one are then no longer shown.
  fit() {
    const { gpu, film, camera, look, parts } = this.viewer, { width, height } = film, view = String(camera.view);
    const isLarge = this.size[0] === width && this.size[1] === height;
    if (isLarge && this.view === view) return;
    if (!isLarge) this.allocate(width, height);
    this.view = view;
    this.sent = [];
    this.places = gpu.target("stroke places", width, height, [gpu.gl.RGBA32UI, gpu.gl.RGBA32UI]);
    gpu.drawPlaces({ ...look, paint: this }, camera, this.places, width, height);
    const { origin, size } = parts[0].header, root = [size, 0, 0, 0, 0, size, 0, 0, 0, 0, size, 0, ...origin, 1];
    this.camera = product(camera.projection(), product(camera.view, root));
  }

  // Make the textures as large as the picture is.
  allocate(width, height) {
    const { gpu } = this.viewer, { gl } = gpu;
    this.size = [width, height];
    this.target = gpu.target("stroke", width, height, [gl.R8]);
    if (this.texture) gl.deleteTexture(this.texture);
    this.texture = gl.createTexture();
    for (const texture of [this.texture, this.target.textures[0]]) {
      gl.bindTexture(gl.TEXTURE_2D, texture);
      for (const name of ["MIN", "MAG"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}_FILTER`], gl.LINEAR);
      for (const name of ["S", "T"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_WRAP_${name}`], gl.CLAMP_TO_EDGE);
    }
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    this.light = new Float32Array(4 * width * height);
    this.clear();
  }

  clear() {
    const { gl } = this.viewer.gpu;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.buffer);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // Begin a stroke, drawn on the view as it is now.
  begin(brush) {
    this.fit();
    this.clear();
    this.current = { ...brush, box: null };
  }

  // Draw from one place of the pen to another, with radii, in CSS pixels; returns what of the picture has changed.
  extend(from, to) {
    const { viewer, current, target } = this, { gl } = viewer.gpu, [width, height] = this.size;
    const { times } = viewer.film, place = ([x, y]) => [x * times, height - y * times];
    const reach = times * Math.max(from[2], to[2]) + 1, low = place(from), high = place(to), ends = [low, high];
    const left = Math.max(Math.floor(Math.min(...ends.map((p) => p[0])) - reach), 0);
    const right = Math.min(Math.ceil(Math.max(...ends.map((p) => p[0])) + reach), width);
    const bottom = Math.max(Math.floor(Math.min(...ends.map((p) => p[1])) - reach), 0);
    const top = Math.min(Math.ceil(Math.max(...ends.map((p) => p[1])) + reach), height);
    if (left >= right || bottom >= top) return null;
    current.picture?.ready?.([left, bottom, right, top], low, high, [from[2] * times, to[2] * times]);
    const program = viewer.gpu.program("stroke", viewer.parts[0], viewer.look, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, bottom, right - left, top - bottom);
    gl.enable(gl.BLEND);
    gl.blendEquation(gl.MAX);
    gl.uniform4f(program.at("u_line"), ...low, ...high);
    gl.uniform2f(program.at("u_radii"), from[2] * times, to[2] * times);
    gl.uniform1f(program.at("u_hardness"), current.hardness);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.BLEND);
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    current.box = around(current.box, [left, bottom, right, top]);
    return { left: left / times, right: right / times, top: (height - top) / times, bottom: (height - bottom) / times };
  }

  // Cover all of a box (left, bottom, right, top).
  cover(box) {
    const { gl } = this.viewer.gpu, [left, bottom, right, top] = box;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.buffer);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, bottom, right - left, top - bottom);
    gl.clearBufferfv(gl.COLOR, 0, [1, 0, 0, 0]);
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.current.box = box;
  }

  // End the stroke; returns its box in pixels from the upper left, the coverage in it, and of a picture the planes of
  // its colors; or null for none.
  end() {
    const { gl } = this.viewer.gpu, { current, size } = this;
    this.current = null;
    if (!current?.box) return null;
    const [left, bottom, right, top] = current.box, width = right - left, height = top - bottom;
    const read = ({ buffer }) => {
      const codes = new Uint8Array(4 * width * height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
      gl.readPixels(left, bottom, width, height, gl.RGBA, gl.UNSIGNED_BYTE, codes);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      return codes;
    };
    const drawn = read(this.target), picture = current.picture && read(current.picture), pixels = width * height;
    const coverage = new Uint8Array(pixels), colors = picture && new Uint8Array(3 * pixels);
    for (let row = 0, n = 0; row < height; row++) {
      for (let at = 4 * width * (height - 1 - row), column = 0; column < width; column++, at += 4, n++) {
        coverage[n] = picture ? Math.round((drawn[at] * picture[at + 3]) / 255) : drawn[at];
        if (picture && coverage[n]) for (let k = 0; k < 3; k++) colors[k * pixels + n] = picture[at + k];
      }
    }
    if (!coverage.some((each) => each > 0)) return null;
    return { ...current, picture: null, color: picture ? undefined : current.color, colors, box: [left, size[1] - top, right, size[1] - bottom], coverage };
  }

  // Show a stroke until it is painted.
  keep(stroke) {
    this.sent.push(stroke);
    this.compose();
  }

  // Strokes up to a number are painted.
  painted(number) {
    const before = this.sent.length;
    this.sent = this.sent.filter((stroke) => stroke.number > number);
    if (this.sent.length !== before) this.compose();
  }

  // Lay strokes that are not painted yet over each other, as they will be painted.
  compose() {
    const { gl } = this.viewer.gpu, [width, height] = this.size, { light } = this;
    if (!this.sent.length) return;
    light.fill(0);
    for (const { box: [left, top, right, bottom], coverage, color, colors, opacity } of this.sent) {
      const paint = color?.map(toLight), plane = coverage.length;
      for (let row = top, n = 0; row < bottom; row++) {
        for (let at = 4 * (width * (height - 1 - row) + left), column = left; column < right; column++, at += 4, n++) {
          const share = (opacity * coverage[n]) / 255;
          for (let k = 0; k < 3; k++) light[at + k] += share * ((paint ? paint[k] : LIGHTS[colors[k * plane + n]]) - light[at + k]);
          light[at + 3] += share * (1 - light[at + 3]);
        }
      }
    }
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.FLOAT, light);
  }

  // What the picture is drawn with.
  get textures() {
    const [u_strokesPlaces, u_strokesWays] = this.places.textures;
    const u_colors = this.current?.picture?.texture ?? this.texture;
    return { u_strokes: this.texture, u_stroke: this.target.textures[0], u_colors, u_strokesPlaces, u_strokesWays };
  }

  set(program, width, height) {
    const { current, viewer } = this, { gl } = viewer.gpu, isHere = this.view === String(viewer.camera.view);
    const { color = [0, 0, 0], opacity = 0, angle = MOST_ANGLE, backFaces = false } = current ?? this.sent.at(-1) ?? {};
    const isWhole = angle >= 90;
    gl.uniform4f(program.at("u_paint"), ...color.map(toLight), isHere && current ? opacity : 0);
    gl.uniform1i(program.at("u_isPicture"), current?.picture ? 1 : 0);
    gl.uniform2f(program.at("u_picture"), width, height);
    gl.uniform3f(program.at("u_angles"), isWhole ? -1 : cosine(Math.max(angle - FADE, 0)), isWhole ? -2 : cosine(angle), backFaces ? 1 : 0);
    const canTurn = !viewer.look.moved && !viewer.parts[0].header.mesh?.posed;
    gl.uniform1i(program.at("u_strokesView"), !this.sent.length ? 0 : isHere ? 1 : canTurn ? 2 : 0);
    gl.uniformMatrix4fv(program.at("u_strokesCamera"), false, this.camera);
  }
}
