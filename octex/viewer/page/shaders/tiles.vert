// Tiles of a picture in which something is seen, a point each. Those at the rim move inward, as GPUs leave out
// points whose middles are outside. Renderers without a GPU also run shaders for pixels that the stencil leaves out.

uniform highp usampler2D u_places;
uniform highp usampler2D u_tiles;  // see tiles.frag

void main() {
  int across = textureSize(u_tiles, 0).x;
  ivec2 tile = ivec2(gl_VertexID % across, gl_VertexID / across);
  vec2 size = vec2(textureSize(u_places, 0)), side = vec2(TILE);
  vec2 middle = max(min(side * (vec2(tile) + 0.5), size - 0.5 * side), 0.5);
  gl_Position = vec4(texelFetch(u_tiles, tile, 0).x > 0u ? 2.0 * middle / size - 1.0 : vec2(2.0), 0.0, 1.0);
  gl_PointSize = side.x;
}
