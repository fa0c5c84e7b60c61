// Tiles of a picture in which something is seen, a point each. Those at the rim move inward, as GPUs leave out
// points whose middles are outside. Renderers without a GPU also run shaders for pixels that the stencil leaves out.

uniform highp usampler2D u_places;  // as places.frag has drawn them

void main() {
  ivec2 size = textureSize(u_places, 0);
  int across = (size.x + TILE - 1) / TILE;
  ivec2 tile = ivec2(gl_VertexID % across, gl_VertexID / across), first = TILE * tile, end = min(first + TILE, size);
  uint bits = 0u;
  for (int y = first.y; y < end.y; y++) {
    for (int x = first.x; x < end.x && bits == 0u; x++) bits = texelFetch(u_places, ivec2(x, y), 0).w;
  }
  vec2 side = vec2(TILE), middle = max(min(side * (vec2(tile) + 0.5), vec2(size) - 0.5 * side), 0.5);
  gl_Position = vec4(bits != 0u ? 2.0 * middle / vec2(size) - 1.0 : vec2(2.0), 0.0, 1.0);
  gl_PointSize = side.x;
}
