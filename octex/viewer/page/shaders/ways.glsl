// Directions: in few bits, across a surface, and from rest to where it is posed.

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

// The side of the square that a pixel covers, in root cells; a long one is shortened by half.
float footprint(vec3 rest) {
  vec3 x = dFdx(rest), y = dFdy(rest);
  float a = dot(x, x), b = dot(x, y), c = dot(y, y);
  float apart = sqrt((a - c) * (a - c) + 4.0 * b * b);
  float longer = sqrt(0.5 * (a + c + apart)), shorter = sqrt(max(0.5 * (a + c - apart), 0.0));
  return max(max(shorter, 0.5 * longer), 1e-9);
}

// Where a direction across the surface at rest points in view space, by what both do along the picture's axes.
vec3 carried(vec3 way, vec3 rest, vec3 seen) {
  vec3 x = dFdx(rest), y = dFdy(rest);
  float a = dot(x, x), b = dot(x, y), c = dot(y, y), p = dot(x, way), q = dot(y, way);
  return (c * p - b * q) * dFdx(seen) + (a * q - b * p) * dFdy(seen);
}

// A direction at rest as it is posed: `side` is the surface's normal at rest, `normal` that in view space, in which
// `across` is what became of the side's tangent.
vec3 turned(vec3 way, vec3 side, vec3 across, vec3 normal) {
  vec3 x = tangent(side), y = cross(side, x);
  across = normalize(across - dot(across, normal) * normal);
  return dot(way, x) * across + dot(way, y) * cross(normal, across) + dot(way, side) * normal;
}

// A stored normal as it is posed, on the side that is seen; the surface's where none is stored. `rest` and `seen` are where
// the pixel is at rest and in view space.
vec3 shownNormal(vec3 stored, vec3 side, vec3 rest, vec3 seen, vec3 normal) {
  vec3 way = turned(stored, side, carried(tangent(side), rest, seen), normal);
  if (dot(stored, stored) <= 1e-4) return normal;
  return normalize(dot(way, normal) < 0.0 ? -way : way);
}
