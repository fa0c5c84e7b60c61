// Whether anything is seen in a tile of the picture.

precision highp float;
precision highp int;

uniform highp usampler2D u_places;  // as places.frag has drawn them

layout(location = 0) out uint o_seen;

void main() {
  ivec2 first = TILE * ivec2(gl_FragCoord.xy), end = min(first + TILE, textureSize(u_places, 0));
  uint bits = 0u;
  for (int y = first.y; y < end.y; y++) {
    for (int x = first.x; x < end.x; x++) bits |= texelFetch(u_places, ivec2(x, y), 0).w;
  }
  o_seen = uint(bits != 0u);
}
