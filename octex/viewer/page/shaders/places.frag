// What the pixels of a picture see: rest positions and directions. Looked up are then pixels, each once, and not
// what hides behind them, nor pixels' neighbours for each of many small triangles.

#ifdef PARTS
flat in uint v_part;
#endif

in vec3 v_rest;
in vec3 v_seen;
in vec3 v_normal;
in vec3 v_restNormal;

layout(location = 0) out uvec4 o_place;  // bits of the rest position and of the footprint's side, or how far away it is; the last one: it faces away
layout(location = 1) out uvec4 o_ways;  // unit vectors in bytes: the normal, towards the camera, the side at rest, across, or the number of what hangs together

#ifdef LAYERED
uniform bool u_footprints;  // as in surface.frag
uniform vec2 u_alphas;  // only what has an alpha from the first to below the second is seen
#endif

// The side of the square that a pixel covers, in root cells; a long one is shortened by half.
float footprint() {
  vec3 x = dFdx(v_rest), y = dFdy(v_rest);
  float a = dot(x, x), b = dot(x, y), c = dot(y, y);
  float apart = sqrt((a - c) * (a - c) + 4.0 * b * b);
  float longer = sqrt(0.5 * (a + c + apart)), shorter = sqrt(max(0.5 * (a + c - apart), 0.0));
  return max(max(shorter, 0.5 * longer), 1e-9);
}

// Where a direction across the surface at rest points in view space, by what both do along the picture's axes.
vec3 carried(vec3 way) {
  vec3 x = dFdx(v_rest), y = dFdy(v_rest);
  float a = dot(x, x), b = dot(x, y), c = dot(y, y), p = dot(x, way), q = dot(y, way);
  return (c * p - b * q) * dFdx(v_seen) + (a * q - b * p) * dFdy(v_seen);
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
  side = size > 0.0 ? side / size : vec3(0.0, 0.0, 1.0);
  vec3 across = normal;
#ifdef POSED
  across = carried(tangent(side));
#endif
  float width = footprint();
#ifdef LAYERED
#ifdef FACING
  face(side);
#endif
  lookUp(v_rest, u_footprints ? width : 0.0);
  if (g_alpha < u_alphas.x || g_alpha >= u_alphas.y) discard;
#endif
#ifdef AWAY
  width = 1.0 / gl_FragCoord.w;
#endif
  o_place = floatBitsToUint(vec4(v_rest, width));
#ifdef PAINTS
  o_place.w = (o_place.w & ~1u) | (gl_FrontFacing ? 0u : 1u);
#endif
  o_ways = uvec4(packed(normal), packed(toward), packed(side), packed(across));
#ifdef PARTS
  o_ways.w = v_part;
#endif
}
