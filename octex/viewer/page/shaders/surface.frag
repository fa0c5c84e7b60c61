// The surface, coloured by the field at its rest positions.

in vec3 v_rest;
in vec3 v_seen;
in vec3 v_normal;
in vec3 v_restNormal;

uniform bool u_footprints;  // averages over what a pixel covers; else leaves
uniform float u_finer;  // the side of a footprint in pixels as they are drawn

// The side of the square that a pixel covers, in root cells; a long one is shortened by half.
float footprint() {
  vec3 x = dFdx(v_rest), y = dFdy(v_rest);
  float a = dot(x, x), b = dot(x, y), c = dot(y, y);
  float apart = sqrt((a - c) * (a - c) + 4.0 * b * b);
  float longer = sqrt(0.5 * (a + c + apart)), shorter = sqrt(max(0.5 * (a + c - apart), 0.0));
  return max(shorter, 0.5 * longer) * u_finer;
}

#ifdef FACING
// Which way the side that is seen faces, at rest.
vec3 facing() {
  vec3 seen = cross(dFdx(v_rest), dFdy(v_rest));
#ifdef POSED
  return seen;
#else
  return dot(seen, v_restNormal) < 0.0 ? -v_restNormal : v_restNormal;
#endif
}
#endif

#ifdef PROBE

layout(location = 0) out uvec4 o_place;  // bits of the rest position and of the footprint's side
layout(location = 1) out uvec4 o_value;  // bits of the plane that is asked for, or of alpha and the fetches
layout(location = 2) out uvec4 o_normal;  // bits of the way that is looked at
uniform int u_plane;
uniform float u_width;  // below 0: the footprint

void main() {
  float width = u_width < 0.0 ? footprint() : u_width;
  vec3 normal = vec3(0.0);
#ifdef FACING
  normal = facing();
  face(normal);
#endif
  lookUp(v_rest, width);
  o_normal = floatBitsToUint(vec4(normal, 0.0));
  o_place = floatBitsToUint(vec4(v_rest, width));
  vec4 value = vec4(g_alpha, float(g_fetches), g_cover, 1.0);
  if (u_plane == {N}) value = g_sum{N};
  o_value = floatBitsToUint(value);
}

#else

layout(location = 0) out vec4 o_color;

uniform int u_kind;  // of the channel that is shown: 0 light, 1 data, 2 directions
uniform int u_pass;  // 0: what covers; 1: what is translucent
uniform vec3 u_marked;  // the lowest corner of the cell that is marked
uniform float u_markedEdge;  // its edge; 0: none

#ifndef BASE_COLOR
#define BASE_COLOR vec3(0.6)
#endif
#ifndef EMISSIVE
#define EMISSIVE vec3(0.0)
#endif
#ifndef SPECULAR
#define SPECULAR vec3(1.0)
#endif
#ifndef METALLIC
#define METALLIC 0.0
#endif
#ifndef ROUGHNESS
#define ROUGHNESS 0.6
#endif
#ifndef OCCLUSION
#define OCCLUSION 1.0
#endif

#ifdef NORMAL
// The normal that a texture has, which is of the surface at rest, on the surface as it is posed.
vec3 posedNormal(vec3 normal) {
  vec3 stored = 2.0 * NORMAL - 1.0;
  vec3 x = dFdx(v_rest), y = dFdy(v_rest), u = dFdx(v_seen), v = dFdy(v_seen);
  vec3 across = cross(x, y), flat_ = cross(u, v);
  float area = dot(across, across), seen = length(flat_);
  if (area <= 0.0 || seen <= 0.0 || dot(stored, stored) < 1e-6) return normal;
  float alongX = dot(cross(stored, y), across) / area, alongY = dot(cross(x, stored), across) / area;
  float size = sqrt(sqrt(area) / seen);
  vec3 turned = (alongX * u + alongY * v) * size * size + dot(stored, across) / sqrt(area) * flat_ / seen;
  return normalize(turned);
}
#endif

void main() {
  vec3 normal = normalize(v_normal);
  vec3 toward = normalize(-v_seen);
  vec3 flatNormal = normalize(cross(dFdx(v_seen), dFdy(v_seen)));
  if (dot(flatNormal, toward) < 0.0) flatNormal = -flatNormal;
  if (dot(normal, flatNormal) < 0.0) normal = -normal;
  float width = footprint();
#ifdef FACING
  face(facing());
#endif
  lookUp(v_rest, u_footprints ? width : 0.0);
  if (u_pass == 0 ? g_alpha < 0.5 : g_alpha >= 0.5) discard;
  vec3 shown;
#if defined(SHOWS_LIT)
#ifdef NORMAL
  normal = posedNormal(normal);
#endif
  vec3 light = lit(
    BASE_COLOR, METALLIC, ROUGHNESS, OCCLUSION, SPECULAR, normal, toward
  );
  shown = toSrgb(toneMapped(light + EMISSIVE));
#elif defined(SHOWS_UNLIT)
  shown = toSrgb(BASE_COLOR + EMISSIVE);
#elif defined(SHOWS_CHANNEL)
  shown = CHANNEL;
  if (u_kind == 2) shown = 0.5 * normalize(2.0 * shown - 1.0) + 0.5;
  if (u_kind == 0) shown = toSrgb(shown);
#else
  uvec2 cell = leafAt(v_rest, u_depth);
  shown = levelColor(cell.y);
#ifdef SHOWS_FACING
  shown = facingColor(uint(texelFetch(FLAGS_PLANE, ivec2(cell.x & ROW, cell.x >> 12u), 0).FLAGS_PART * 255.0 + 0.5));
#endif
  shown *= 0.55 + 0.45 * max(dot(normal, toward), 0.0);
#endif
  if (u_markedEdge > 0.0 && u_markedEdge <= 1.0) {
    vec3 inside = (v_rest - u_marked) / u_markedEdge;
    if (all(greaterThanEqual(inside, vec3(0.0))) && all(lessThanEqual(inside, vec3(1.0)))) {
      shown = mix(shown, vec3(1.0, 0.85, 0.1), 0.35);
    }
  }
  o_color = vec4(shown, u_pass == 0 ? 1.0 : g_alpha);
}

#endif
