// The surface, coloured by the field at its rest positions, which places.frag has drawn.

uniform highp usampler2D u_places;
uniform highp usampler2D u_ways;

#ifdef PROBE

layout(location = 0) out uvec4 o_value;  // bits of the plane that is asked for, or of alpha and the fetches
layout(location = 1) out uvec4 o_way;  // bits of the side that is looked at, and of the part's number
uniform int u_plane;
uniform float u_part;
uniform float u_width;  // below 0: the footprint

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 place = uintBitsToFloat(texelFetch(u_places, at, 0));
  o_value = o_way = uvec4(0u);
  if (place.w <= 0.0) return;
  vec3 side = unpacked(texelFetch(u_ways, at, 0).z);
#ifdef FACING
  face(side);
#endif
  lookUp(place.xyz, u_width < 0.0 ? place.w : u_width);
  vec4 value = vec4(g_alpha, float(g_fetches), g_cover, 1.0);
  if (u_plane == {N}) value = g_sum{N};
  o_value = floatBitsToUint(value);
  o_way = floatBitsToUint(vec4(side, u_part));
}

#else

#ifdef SHOWS_HEIGHT
layout(location = 0) out uint o_height;
vec4 o_color;
#else
layout(location = 0) out vec4 o_color;
#endif

uniform bool u_footprints;  // averages over what a pixel covers; else leaves
uniform int u_kind;  // of the channel that is shown: 0 light, 1 data, 2 directions
uniform mat4 u_view;
uniform vec3 u_marked;  // the lowest corner of the cell that is marked
uniform float u_markedEdge;  // its edge; 0: none
uniform bool u_isNear;  // only pixels that look up cells in a box, or that lie in a part of the picture, are drawn
uniform vec3 u_nearLow;
uniform vec3 u_nearHigh;
uniform vec4 u_nearPart;  // the lowest and the highest corner, in pictures
uniform vec2 u_size;  // pixels

// Averages reach so many footprints: of two levels, refined from the ones above them.
const float REACH = 8.0;

bool isNear(vec4 place) {
  vec2 at = gl_FragCoord.xy / u_size;
  vec3 reach = vec3(REACH * place.w);
  bool isInside = all(greaterThan(at, u_nearPart.xy)) && all(lessThan(at, u_nearPart.zw));
  return isInside || (all(greaterThan(place.xyz + reach, u_nearLow)) && all(lessThan(place.xyz - reach, u_nearHigh)));
}

#ifndef BASE_COLOR
#define BASE_COLOR vec3(0.6)
#endif
#ifdef BESIDE
uniform sampler2D u_source;  // the base colour as source.frag has drawn it
uniform float u_divider;  // pixels on its left show that

vec3 beside(vec3 looked, ivec2 at) {
  return float(at.x) < u_divider ? texelFetch(u_source, at, 0).rgb : looked;
}
#else
#define beside(looked, at) looked
#endif
#ifdef OVER
uniform sampler2D u_behind;  // the picture of what is behind, with nothing translucent in it
#endif
#ifndef CHANNEL
#define CHANNEL vec3(0.5)
#endif
#ifndef EMISSIVE
#define EMISSIVE vec3(0.0)
#endif
#ifndef SPECULAR
#define SPECULAR vec3(0.04)
#endif
#ifndef METALLIC
#define METALLIC 0.0
#endif
#ifndef ROUGHNESS
#define ROUGHNESS 1.0
#endif
#ifndef HEIGHT
#define HEIGHT 0.0
#endif
#ifndef OCCLUSION
#define OCCLUSION 1.0
#endif

#ifdef PAINTS
uniform highp sampler2DArray u_strokes;  // what is sent and not yet painted: how it covers what is there, then what it adds
uniform int u_strokesAt[PLANES];  // where each plane's begins; below 0: it has none
uniform sampler2D u_stroke;  // the coverage of the stroke that is drawn
uniform vec4 u_cover[PLANES];  // how its paint covers what is there, and what it adds
uniform vec4 u_added[PLANES];
uniform float u_opacity;
uniform int u_picturePlane;  // which plane a picture paints where it has alpha, with its first components; below 0: none
uniform sampler2D u_colors;  // its colours in sRGB, and alpha, a texel a pixel of the stroke
uniform vec3 u_blend;  // how it covers what is there, by its alpha and by its light, and how much of its light it adds
uniform vec2 u_picture;  // pixels
uniform vec3 u_angles;  // cosines from which on paint fades, and where it has vanished; 1: back faces too
uniform int u_strokesView;  // what they were drawn on: 0: there are none, 1: this view, 2: another one, of which
uniform mat4 u_strokesCamera;  // sees positions at rest in the root cell
uniform highp usampler2D u_strokesPlaces;  // what its pixels see, as places.frag has drawn it
uniform highp usampler2D u_strokesWays;
uniform vec3 u_strokesEye;  // that camera, in the root cell
uniform bool u_hidden;  // they reach what is hidden
uniform vec2 u_mirrored;  // whether those that are sent have another half, and the opacity of that of the one that is drawn
uniform mat4 u_mirrorCamera;  // the strokes' camera, as the mirror shows it
uniform vec3 u_mirrorEye;
uniform highp usampler2D u_mirrorPlaces;
uniform ivec2 u_parts;  // the part that the stroke that is drawn stays on, and that of its other half; below 0: any
vec3 p_sent = vec3(0.0), p_other = vec3(0.0);  // where the strokes have the pixel, and how much it takes; of their other halves
vec2 p_part;  // how much it takes of the stroke that is drawn, and of its other half

// How much of paint stays at an angle, as octex.painting.reading has it.
float paintable(bool isAway, float cosine) {
  float share = clamp((min(cosine, 1.0) - u_angles.y) / (u_angles.x - u_angles.y), 0.0, 1.0);
  return isAway && u_angles.z < 0.5 ? 0.0 : share * share * (3.0 - 2.0 * share);
}

// Light times alpha of the picture, and alpha, between texels.
vec4 pictured(vec2 at) {
  ivec2 size = textureSize(u_colors, 0);
  vec2 place = at * vec2(size) - 0.5, shares = fract(place);
  vec4 sum = vec4(0.0);
  for (int n = 0; n < 4; n++) {
    ivec2 side = ivec2(n & 1, n >> 1);
    vec4 color = texelFetch(u_colors, clamp(ivec2(floor(place)) + side, ivec2(0), size - 1), 0);
    float share = (side.x == 1 ? shares.x : 1.0 - shares.x) * (side.y == 1 ? shares.y : 1.0 - shares.y) * color.a;
    sum += share * vec4(toLight(color.rgb), 1.0);
  }
  return sum;
}

// Where a camera's picture has a place, and how much of the paint there that takes. `normal` points out of the model.
vec3 takenBy(mat4 camera, vec3 eye, highp usampler2D places, vec4 place, vec3 normal) {
  vec4 seen = camera * vec4(place.xyz, 1.0);
  vec2 from = 0.5 + 0.5 * seen.xy / seen.w;
  if (seen.w <= 0.0 || from != clamp(from, 0.0, 1.0)) return vec3(0.0);
  vec4 there = uintBitsToFloat(texelFetch(places, ivec2(from * vec2(textureSize(places, 0))), 0));
  bool isSeen = u_hidden || (there.w > 0.0 && distance(there.xyz, place.xyz) < 3.0 * there.w);
  float cosine = dot(normal, mat3(u_view) * normalize(eye - place.xyz));
  return vec3(from, isSeen ? paintable(cosine < 0.0, abs(cosine)) : 0.0);
}

// Find the strokes at a pixel.
void findStrokes(vec4 place, vec3 normal, vec3 toward) {
  vec2 at = gl_FragCoord.xy / u_picture;
  bool isAway = (floatBitsToUint(place.w) & 1u) == 1u;
  vec3 here = vec3(at, paintable(isAway, dot(normal, toward))), outward = isAway ? -normal : normal;
  if (u_mirrored != vec2(0.0)) p_other = takenBy(u_mirrorCamera, u_mirrorEye, u_mirrorPlaces, place, outward);
  if (u_strokesView == 1) p_sent = here;
  if (u_strokesView == 2) p_sent = takenBy(u_strokesCamera, u_strokesEye, u_strokesPlaces, place, outward);
  p_part = vec2(u_opacity * here.z * texture(u_stroke, at).r, u_mirrored.y * p_other.z * texture(u_stroke, p_other.xy).r);
  if (u_parts == ivec2(-1)) return;
  int part = int(texelFetch(u_strokesWays, ivec2(at * vec2(textureSize(u_strokesWays, 0))), 0).w) - 1;
  bvec2 isOther = notEqual(ivec2(part), u_parts);
  if (isOther.x) p_part.x = 0.0;
  if (isOther.y) p_part.y = 0.0;
  if (u_strokesView != 1 || u_mirrored.x == 0.0) return;  // strokes without another half are sent without other parts
  if (isOther.x) p_sent.z = 0.0;
  if (isOther.y) p_other.z = 0.0;
}

vec4 withSent(vec4 values, int layer, vec3 taken) {
  return values * (1.0 - taken.z * texture(u_strokes, vec3(taken.xy, layer))) + taken.z * texture(u_strokes, vec3(taken.xy, layer + 1));
}

// A part of the stroke that is drawn, of which the picture has this pixel at a place.
vec4 withDrawn(vec4 values, int plane, float part, vec2 from) {
  vec4 cover = u_cover[plane], added = u_added[plane];
  if (plane == u_picturePlane && part > 0.0) {
    vec4 paint = pictured(from);
    cover.rgb = (1.0 - paint.a) * cover.rgb + u_blend.x * paint.a + u_blend.y * paint.rgb;
    added.rgb = (1.0 - paint.a) * added.rgb + u_blend.z * paint.rgb;
  }
  return values * (1.0 - part * cover) + part * added;
}

// What a plane's components are with the strokes.
vec4 painted(vec4 values, int plane) {
  int layer = u_strokesAt[plane];
  if (layer >= 0 && p_sent.z > 0.0) values = withSent(values, layer, p_sent);
  if (layer >= 0 && u_mirrored.x * p_other.z > 0.0) values = withSent(values, layer, p_other);
  values = withDrawn(values, plane, p_part.x, gl_FragCoord.xy / u_picture);
  return min(withDrawn(values, plane, p_part.y, p_other.xy), 1.0);
}
#endif

#ifdef RELIEF
uniform float u_relief;  // how far a height of 1 rises, in root cells
uniform highp usampler2D u_heights;  // bits of the heights that pixels see

// How positions at rest and heights differ from one neighbour of a pixel to the other, as far as these are beside it.
vec4 along(vec4 place, ivec2 at, ivec2 aside) {
  vec4 ends[2];
  for (int n = 0; n < 2; n++) {
    ivec2 to = n == 0 ? at - aside : at + aside;
    vec4 there = uintBitsToFloat(texelFetch(u_places, to, 0));
    bool isBeside = there.w > 0.0 && distance(there.xyz, place.xyz) < 4.0 * place.w;
    ends[n] = vec4(isBeside ? there.xyz : place.xyz, uintBitsToFloat(texelFetch(u_heights, isBeside ? to : at, 0).x));
  }
  return ends[1] - ends[0];
}

// How what is raised changes along the surface at rest.
vec3 slopes(vec4 place, ivec2 at) {
  vec4 x = along(place, at, ivec2(1, 0)), y = along(place, at, ivec2(0, 1));
  vec3 side = cross(x.xyz, y.xyz);
  float square = dot(side, side);
  return square > 0.0 ? u_relief / square * (x.w * cross(y.xyz, side) + y.w * cross(side, x.xyz)) : vec3(0.0);
}
#endif

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 place = uintBitsToFloat(texelFetch(u_places, at, 0));
  o_color = vec4(0.0);
  if (u_isNear && !isNear(place)) discard;
  if (place.w <= 0.0) return;
  uvec4 ways = texelFetch(u_ways, at, 0);
  vec3 normal = unpacked(ways.x), toward = unpacked(ways.y);
#ifdef FACING
  face(unpacked(ways.z));
#endif
  lookUp(place.xyz, u_footprints ? place.w : 0.0);
#ifdef PAINTS
  findStrokes(place, normal, toward);
  g_sum{N} = painted(g_sum{N}, {N});
#endif
  vec3 shown;
#if defined(SHOWS_HEIGHT)
  o_height = floatBitsToUint(HEIGHT);
#elif defined(SHOWS_LIT)
#ifdef RELIEF
  vec3 slope = slopes(place, at);
#ifdef POSED
  slope = turned(slope, unpacked(ways.z), unpacked(ways.w), normal);
#else
  slope = mat3(u_view) * slope;
#endif
#endif
#ifdef NORMAL
  vec3 stored = 2.0 * NORMAL - 1.0;
  if (dot(stored, stored) > 1e-4) {
#ifdef POSED
    stored = turned(stored, unpacked(ways.z), unpacked(ways.w), normal);
#else
    stored = mat3(u_view) * stored;
#endif
    stored = normalize(stored);
    normal = dot(stored, normal) < 0.0 ? -stored : stored;
  }
#endif
#ifdef RELIEF
  normal = normalize(normal - slope + dot(slope, normal) * normal);
#endif
  vec3 light = lit(beside(BASE_COLOR, at), METALLIC, ROUGHNESS, OCCLUSION, SPECULAR, normal, toward);
  shown = toSrgb(toneMapped(light + EMISSIVE));
#elif defined(SHOWS_UNLIT)
  shown = toSrgb(beside(BASE_COLOR, at) + EMISSIVE);
#elif defined(SHOWS_CHANNEL)
  shown = beside(CHANNEL, at);
  if (u_kind == 2) shown = 0.5 * normalize(2.0 * shown - 1.0) + 0.5;
  if (u_kind == 0) shown = toSrgb(shown);
#elif defined(SHOWS_SPREAD)
  shown = vec3(1.0 - min(length(2.0 * CHANNEL - 1.0), 1.0));
#else
  uvec3 cell = leafAt(place.xyz, u_depth);
  shown = u_levels[cell.y];
#ifdef SHOWS_FACING
  ivec2 texel = ivec2(cell.x & ROW, cell.x >> 12u);
  shown = facingColor(FLAGS_AT(texel));
#endif
  shown *= 0.55 + 0.45 * max(dot(normal, toward), 0.0);
#endif
  vec3 inside = (place.xyz - u_marked) / max(u_markedEdge, 1e-9);
  if (u_markedEdge > 0.0 && all(greaterThanEqual(inside, vec3(0.0))) && all(lessThanEqual(inside, vec3(1.0)))) {
    shown = mix(shown, vec3(1.0, 0.85, 0.1), 0.45);
  }
#ifdef OVER
  shown = toSrgb(mix(toLight(texelFetch(u_behind, at, 0).rgb), toLight(shown), g_alpha));
#endif
#ifdef KNOWN
  o_color = vec4(shown, step(0.5, g_alpha));
#else
  o_color = vec4(shown, 1.0);
#endif
}

#endif
