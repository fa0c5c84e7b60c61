// Directions: in few bits, and across a surface.

precision highp float;
precision highp int;

// A unit vector on an unfolded octahedron.
uint packed(vec3 way) {
  vec2 flat2 = way.xy / (abs(way.x) + abs(way.y) + abs(way.z));
  if (way.z < 0.0) flat2 = (1.0 - abs(flat2.yx)) * vec2(flat2.x < 0.0 ? -1.0 : 1.0, flat2.y < 0.0 ? -1.0 : 1.0);
  return packSnorm2x16(flat2);
}

vec3 unpacked(uint bits) {
  vec2 flat2 = unpackSnorm2x16(bits);
  vec3 way = vec3(flat2, 1.0 - abs(flat2.x) - abs(flat2.y));
  if (way.z < 0.0) way.xy = (1.0 - abs(way.yx)) * vec2(way.x < 0.0 ? -1.0 : 1.0, way.y < 0.0 ? -1.0 : 1.0);
  return normalize(way);
}

// A direction across the surface, by its normal. (Duff et al., "Building an Orthonormal Basis, Revisited", 2017.)
vec3 tangent(vec3 n) {
  float s = n.z < 0.0 ? -1.0 : 1.0, a = -1.0 / (s + n.z);
  return vec3(1.0 + s * n.x * n.x * a, s * n.x * n.y * a, -s * n.x);
}
