// The G-buffer: rest position, footprint and directions of the surface at each pixel. The octree is then sampled once a
// pixel: not for hidden surface, and not for the helper pixels of small triangles.

#ifdef PARTS
flat in uint v_part;
#endif

in vec3 v_rest;
in vec3 v_seen;
in vec3 v_normal;
in vec3 v_restNormal;

layout(location = 0) out uvec4 o_position;  // bits of the rest position and of the footprint's width, or of the depth; the lowest bit of the last: a back face
layout(location = 1) out uvec4 o_directions;  // packed unit vectors: normal, direction to the camera, normal at rest, tangent (or the part's number plus 1)

#ifdef LAYERED
uniform bool u_footprints;  // as in surface.frag
uniform vec2 u_alphas;  // discard alphas below the first or from the second on
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
  across = tangentToView(tangent(side), v_rest, v_seen);
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
  o_position = floatBitsToUint(vec4(v_rest, width));
#ifdef PAINTS
  o_position.w = (o_position.w & ~1u) | (gl_FrontFacing ? 0u : 1u);
#endif
  o_directions = uvec4(packDirection(normal), packDirection(toward), packDirection(side), packDirection(across));
#ifdef PARTS
  o_directions.w = v_part + 1u;
#endif
}
