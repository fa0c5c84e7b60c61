// Directions: packed into 32 bits, tangent to a surface, and carried from rest to the pose.

precision highp float;
precision highp int;

// Pack a unit vector as a point of an unfolded octahedron.
uint packDirection(vec3 direction) {
  vec2 flat2 = direction.xy / (abs(direction.x) + abs(direction.y) + abs(direction.z));
  if (direction.z < 0.0) flat2 = (1.0 - abs(flat2.yx)) * vec2(flat2.x < 0.0 ? -1.0 : 1.0, flat2.y < 0.0 ? -1.0 : 1.0);
  return packSnorm2x16(flat2);
}

vec3 unpackDirection(uint bits) {
  vec2 flat2 = unpackSnorm2x16(bits);
  vec3 direction = vec3(flat2, 1.0 - abs(flat2.x) - abs(flat2.y));
  if (direction.z < 0.0) direction.xy = (1.0 - abs(direction.yx)) * vec2(direction.x < 0.0 ? -1.0 : 1.0, direction.y < 0.0 ? -1.0 : 1.0);
  return normalize(direction);
}

// Return a unit tangent of a normal. (Duff et al., "Building an Orthonormal Basis, Revisited", 2017.)
vec3 tangent(vec3 n) {
  float s = n.z < 0.0 ? -1.0 : 1.0, a = -1.0 / (s + n.z);
  return vec3(1.0 + s * n.x * n.x * a, s * n.x * n.y * a, -s * n.x);
}

// Return the width of a pixel's footprint, in root cells: its short axis, or half its long one if that is more.
float footprint(vec3 rest) {
  vec3 x = dFdx(rest), y = dFdy(rest);
  float a = dot(x, x), b = dot(x, y), c = dot(y, y);
  float apart = sqrt((a - c) * (a - c) + 4.0 * b * b);
  float longer = sqrt(0.5 * (a + c + apart)), shorter = sqrt(max(0.5 * (a + c - apart), 0.0));
  return max(max(shorter, 0.5 * longer), 1e-9);
}

// Map a tangent at rest to view space, by the screen-space derivatives of the position at rest and in view space.
vec3 tangentToView(vec3 direction, vec3 rest, vec3 seen) {
  vec3 x = dFdx(rest), y = dFdy(rest);
  float a = dot(x, x), b = dot(x, y), c = dot(y, y), p = dot(x, direction), q = dot(y, direction);
  return (c * p - b * q) * dFdx(seen) + (a * q - b * p) * dFdy(seen);
}

// Rotate a direction from rest to view space. `side` is the surface's normal at rest and `normal` its normal in view
// space; `across` is the tangent of `side` in view space.
vec3 restToView(vec3 direction, vec3 side, vec3 across, vec3 normal) {
  vec3 x = tangent(side), y = cross(side, x);
  across = normalize(across - dot(across, normal) * normal);
  return dot(direction, x) * across + dot(direction, y) * cross(normal, across) + dot(direction, side) * normal;
}

// Return a stored normal in view space, facing the camera; the surface's normal if none is stored. `rest` and `seen` are
// the pixel's positions at rest and in view space.
vec3 shownNormal(vec3 stored, vec3 side, vec3 rest, vec3 seen, vec3 normal) {
  vec3 direction = restToView(stored, side, tangentToView(tangent(side), rest, seen), normal);
  if (dot(stored, stored) <= 1e-4) return normal;
  return normalize(dot(direction, normal) < 0.0 ? -direction : direction);
}
