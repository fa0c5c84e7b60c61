// The model's own images of base colour, drawn on the mesh by its texture coordinates. See octex/viewer/maps.py.

const WRAPS = { repeat: "REPEAT", mirror: "MIRRORED_REPEAT", clamp: "CLAMP_TO_EDGE" };
const IMAGE_UNIT = 2; // of textures

export class Source {
  constructor(header, images) {
    this.header = header;
    this.images = images; // ImageBitmaps
  }

  // Create the textures of the mesh's materials, at first and after a lost context.
  build(gl) {
    const anisotropy = gl.getExtension("EXT_texture_filter_anisotropic");
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
      if (anisotropy) gl.texParameterf(gl.TEXTURE_2D, anisotropy.TEXTURE_MAX_ANISOTROPY_EXT, 8);
      return texture;
    });
  }

  // Draw all materials with the program in use.
  draw(gl, program) {
    gl.activeTexture(gl.TEXTURE0 + IMAGE_UNIT);
    program.set({ u_image: IMAGE_UNIT });
    this.header.parts.forEach(({ first, count, factor }, n) => {
      gl.bindTexture(gl.TEXTURE_2D, this.textures[n]);
      program.set({ u_factor: factor });
      gl.drawElements(gl.TRIANGLES, 3 * count, gl.UNSIGNED_INT, 12 * first);
    });
    gl.activeTexture(gl.TEXTURE0);
  }
}
