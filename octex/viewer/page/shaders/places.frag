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
layout(location = 1) out uvec4 o_ways;  // unit vectors in bytes: the normal, towards the camera, the side at rest, across, or 1 and the part's number

#ifdef LAYERED
uniform bool u_footprints;  // as in surface.frag
uniform vec2 u_alphas;  // only what has an alpha from the first to below the second is seen
#endif

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
  across = carried(tangent(side), v_rest, v_seen);
#endif
  float width = footprint(v_rest);
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
  o_ways.w = v_part + 1u;
#endif
}
