// One point for each tile of the image that shows any surface. Points at the border move inward, since GPUs discard
// points whose centres are outside. Software renderers also shade pixels that the stencil rejects, so tiles replace it.

uniform highp usampler2D u_positions;  // by gbuffer.frag

void main() {
  ivec2 size = textureSize(u_positions, 0);
  int across = (size.x + TILE - 1) / TILE;
  ivec2 tile = ivec2(gl_VertexID % across, gl_VertexID / across), first = TILE * tile, end = min(first + TILE, size);
  uint bits = 0u;
  for (int y = first.y; y < end.y; y++) {
    for (int x = first.x; x < end.x && bits == 0u; x++) bits = texelFetch(u_positions, ivec2(x, y), 0).w;
  }
  vec2 side = vec2(TILE), middle = max(min(side * (vec2(tile) + 0.5), vec2(size) - 0.5 * side), 0.5);
  gl_Position = vec4(bits != 0u ? 2.0 * middle / vec2(size) - 1.0 : vec2(2.0), 0.0, 1.0);
  gl_PointSize = side.x;
}
