// The base colour's own images, drawn on the mesh by its texture coordinates. See maps.py.

const WRAPS = { repeat: "REPEAT", mirror: "MIRRORED_REPEAT", clamp: "CLAMP_TO_EDGE" };

export class Source {
  constructor(header, images) {
    this.header = header;
    this.images = images; // ImageBitmaps
  }

  // Make the textures of parts of the mesh anew.
  build(gl) {
    const most = gl.getExtension("EXT_texture_filter_anisotropic");
    this.textures = this.header.parts.map(({ image, wraps, isNearest }) => {
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      const set = (name, value) => gl.texParameteri(gl.TEXTURE_2D, gl[name], value);
      if (image === undefined) {
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4).fill(255));
        set("TEXTURE_MIN_FILTER", gl.NEAREST);
        return texture;
      }
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, this.images[image]);
      gl.generateMipmap(gl.TEXTURE_2D);
      set("TEXTURE_WRAP_S", gl[WRAPS[wraps[0]]]);
      set("TEXTURE_WRAP_T", gl[WRAPS[wraps[1]]]);
      set("TEXTURE_MIN_FILTER", gl.LINEAR_MIPMAP_LINEAR);
      set("TEXTURE_MAG_FILTER", isNearest ? gl.NEAREST : gl.LINEAR);
      if (most) gl.texParameterf(gl.TEXTURE_2D, most.TEXTURE_MAX_ANISOTROPY_EXT, 8);
      return texture;
    });
  }

  // Draw the parts with a program that is in use.
  draw(gl, program) {
    gl.activeTexture(gl.TEXTURE0 + 2);
    gl.uniform1i(program.at("u_image"), 2);
    this.header.parts.forEach(({ first, count, factor }, n) => {
      gl.bindTexture(gl.TEXTURE_2D, this.textures[n]);
      gl.uniform3fv(program.at("u_factor"), factor);
      gl.drawElements(gl.TRIANGLES, 3 * count, gl.UNSIGNED_INT, 12 * first);
    });
    gl.activeTexture(gl.TEXTURE0);
  }
}
