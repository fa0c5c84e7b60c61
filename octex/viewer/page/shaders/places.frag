// What the pixels of a picture see: rest positions and directions. Looked up are then pixels, each once, and not
// what hides behind them, nor pixels' neighbours for each of many small triangles.

precision highp float;
precision highp int;

in vec3 v_rest;
in vec3 v_seen;
in vec3 v_normal;
in vec3 v_restNormal;

layout(location = 0) out uvec4 o_place;  // bits of the rest position and of the footprint's side
layout(location = 1) out uvec4 o_ways;  // unit vectors in bytes: the normal, towards the camera, the side at rest

// The side of the square that a pixel covers, in root cells; a long one is shortened by half.
float footprint() {
  vec3 x = dFdx(v_rest), y = dFdy(v_rest);
  float a = dot(x, x), b = dot(x, y), c = dot(y, y);
  float apart = sqrt((a - c) * (a - c) + 4.0 * b * b);
  float longer = sqrt(0.5 * (a + c + apart)), shorter = sqrt(max(0.5 * (a + c - apart), 0.0));
  return max(max(shorter, 0.5 * longer), 1e-9);
}

// A unit vector on an unfolded octahedron.
uint packed(vec3 way) {
  vec2 flat2 = way.xy / (abs(way.x) + abs(way.y) + abs(way.z));
  if (way.z < 0.0) flat2 = (1.0 - abs(flat2.yx)) * vec2(flat2.x < 0.0 ? -1.0 : 1.0, flat2.y < 0.0 ? -1.0 : 1.0);
  return packSnorm2x16(flat2);
}

void main() {
  vec3 toward = normalize(-v_seen);
  vec3 normal = normalize(v_normal), seen = cross(dFdx(v_seen), dFdy(v_seen));
  if (dot(seen, toward) < 0.0) seen = -seen;
  if (dot(normal, seen) < 0.0) normal = -normal;
  vec3 side = cross(dFdx(v_rest), dFdy(v_rest));
#ifndef POSED
  side = dot(side, v_restNormal) < 0.0 ? -v_restNormal : v_restNormal;
#endif
  float size = length(side);
  o_place = floatBitsToUint(vec4(v_rest, footprint()));
  o_ways = uvec4(packed(normal), packed(toward), packed(size > 0.0 ? side / size : vec3(0.0, 0.0, 1.0)), 0u);
}
