// Tiles of a picture in which something is seen, an instance each: corners of a strip of two triangles.
// Renderers without a GPU run shaders of pixels that the stencil leaves out, too.

uniform highp usampler2D u_places;
uniform highp usampler2D u_tiles;  // see tiles.frag

void main() {
  ivec2 tiles = textureSize(u_tiles, 0), size = textureSize(u_places, 0), tile = ivec2(gl_VertexID % tiles.x, gl_VertexID / tiles.x);
  vec2 at = vec2(TILE) * (vec2(tile) + 0.5);
  at = max(min(at, vec2(size) - 0.5 * vec2(TILE)), 0.5);
  gl_Position = vec4(texelFetch(u_tiles, tile, 0).x > 0u ? 2.0 * at / vec2(size) - 1.0 : vec2(2.0), 0.0, 1.0);
  gl_PointSize = float(TILE);
}
