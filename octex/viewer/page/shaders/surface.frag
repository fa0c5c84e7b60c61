// Shade the pixels of the G-buffer with the octree's field at their rest positions.

uniform highp usampler2D u_positions;
uniform highp usampler2D u_directions;

#ifdef PROBE

layout(location = 0) out uvec4 o_value;  // bits of plane u_plane, or of alpha and the number of fetches
layout(location = 1) out uvec4 o_direction;  // bits of the normal at rest, and of the part's number
uniform int u_plane;
uniform float u_part;
uniform float u_width;  // below 0: the footprint

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 place = uintBitsToFloat(texelFetch(u_positions, at, 0));
  o_value = o_direction = uvec4(0u);
  if (place.w <= 0.0) return;
  vec3 side = unpackDirection(texelFetch(u_directions, at, 0).z);
#ifdef FACING
  face(side);
#endif
  lookUp(place.xyz, u_width < 0.0 ? place.w : u_width);
  vec4 value = vec4(g_alpha, float(g_fetches), g_cover, 1.0);
  if (u_plane == {N}) value = g_sum{N};
  o_value = floatBitsToUint(value);
  o_direction = floatBitsToUint(vec4(side, u_part));
}

#else

#ifdef SHOWS_HEIGHT
layout(location = 0) out uint o_height;
vec4 o_color;
#else
layout(location = 0) out vec4 o_color;
#endif

uniform bool u_footprints;  // averages over a pixel's footprint; else samples leaves
uniform int u_kind;  // of the shown channel: 0 light, 1 data, 2 directions
uniform mat4 u_view;
uniform vec3 u_marked;  // the lowest corner of the marked cell
uniform float u_markedEdge;  // its edge; 0: none
uniform bool u_hasRegion;  // draw only pixels whose samples reach a box of rest space, or that lie in a part of the image
uniform vec3 u_regionLow;
uniform vec3 u_regionHigh;
uniform vec4 u_regionPart;  // lowest and highest corner, as shares of the image
uniform vec2 u_size;  // pixels

// Averages reach so many footprints: they mix two levels, refined from the levels above.
const float REACH = 8.0;

bool isInRegion(vec4 place) {
  vec2 at = gl_FragCoord.xy / u_size;
  vec3 reach = vec3(REACH * place.w);
  bool isInside = all(greaterThan(at, u_regionPart.xy)) && all(lessThan(at, u_regionPart.zw));
  return isInside || (all(greaterThan(place.xyz + reach, u_regionLow)) && all(lessThan(place.xyz - reach, u_regionHigh)));
}

#ifndef BASE_COLOR
#define BASE_COLOR vec3(0.6)
#endif
#ifdef COMPARES
uniform sampler2D u_source;  // the base colour, by source.frag
uniform float u_divider;  // pixels left of it show u_source

vec3 compared(vec3 looked, ivec2 at) {
  return float(at.x) < u_divider ? texelFetch(u_source, at, 0).rgb : looked;
}
#else
#define compared(looked, at) looked
#endif
#ifdef BLENDS
uniform sampler2D u_background;  // the opaque image behind translucent surface
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
uniform highp sampler2DArray u_strokes;  // strokes that the server has not painted yet, two layers a plane: the factors of old values, then the sums that are added
uniform int u_strokesAt[PLANES];  // the first of a plane's layers; −1 for none
uniform sampler2D u_stroke;  // coverage of the current stroke
uniform vec4 u_cover[PLANES];  // its blend: new = old · (1 − coverage · u_cover) + coverage · u_added
uniform vec4 u_added[PLANES];
uniform float u_opacity;
uniform int u_imagePlane;  // the plane that the brush's image paints; −1 for none
uniform sampler2D u_colors;  // that image: sRGB colours and alpha, a texel a pixel of the stroke
uniform vec3 u_blend;  // its blend mode: factors of alpha and of light in u_cover, and of light in u_added
uniform vec2 u_image;  // pixels
uniform vec3 u_angles;  // cosines at which paint begins to fade and has vanished; 1: paint back faces too
uniform int u_strokesView;  // the view of the sent strokes: 0 no strokes, 1 this view, 2 another view, with these:
uniform mat4 u_strokesCamera;  // from rest positions in the root cell to clip space
uniform highp usampler2D u_strokesPositions;  // its G-buffer
uniform highp usampler2D u_strokesDirections;
uniform vec3 u_strokesEye;  // the camera's position, in the root cell
uniform bool u_hidden;  // strokes paint hidden surface too
uniform vec2 u_mirrored;  // whether sent strokes are mirrored, and the opacity of the current stroke's mirror image
uniform mat4 u_mirrorCamera;  // the strokes' camera, mirrored
uniform vec3 u_mirrorEye;
uniform highp usampler2D u_mirrorPositions;
uniform ivec2 u_parts;  // the parts that the current stroke and its mirror image stay on; −1: any
vec3 p_sent = vec3(0.0), p_other = vec3(0.0);  // place in the strokes' image, and share that is painted; of the sent strokes and of their mirror images
vec2 p_part;  // share that the current stroke paints, and its mirror image

// Return how much paint an angle to the camera leaves, as octex.painting.reading does.
float paintable(bool isBackFace, float cosine) {
  float share = clamp((min(cosine, 1.0) - u_angles.y) / (u_angles.x - u_angles.y), 0.0, 1.0);
  return isBackFace && u_angles.z < 0.5 ? 0.0 : share * share * (3.0 - 2.0 * share);
}

// Sample the brush's image bilinearly: light times alpha, and alpha.
vec4 imaged(vec2 at) {
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

// Project a position into a camera's image; return the place there, and the share of its paint that lands. `normal` points
// out of the model.
vec3 takenBy(mat4 camera, vec3 eye, highp usampler2D places, vec4 place, vec3 normal) {
  vec4 seen = camera * vec4(place.xyz, 1.0);
  vec2 from = 0.5 + 0.5 * seen.xy / seen.w;
  if (seen.w <= 0.0 || from != clamp(from, 0.0, 1.0)) return vec3(0.0);
  vec4 there = uintBitsToFloat(texelFetch(places, ivec2(from * vec2(textureSize(places, 0))), 0));
  bool isSeen = u_hidden || (there.w > 0.0 && distance(there.xyz, place.xyz) < 3.0 * there.w);
  float cosine = dot(normal, mat3(u_view) * normalize(eye - place.xyz));
  return vec3(from, isSeen ? paintable(cosine < 0.0, abs(cosine)) : 0.0);
}

// Find the strokes that paint a pixel.
void findStrokes(vec4 place, vec3 normal, vec3 toward) {
  vec2 at = gl_FragCoord.xy / u_image;
  bool isBackFace = (floatBitsToUint(place.w) & 1u) == 1u;
  vec3 here = vec3(at, paintable(isBackFace, dot(normal, toward))), outward = isBackFace ? -normal : normal;
  if (u_mirrored != vec2(0.0)) p_other = takenBy(u_mirrorCamera, u_mirrorEye, u_mirrorPositions, place, outward);
  if (u_strokesView == 1) p_sent = here;
  if (u_strokesView == 2) p_sent = takenBy(u_strokesCamera, u_strokesEye, u_strokesPositions, place, outward);
  p_part = vec2(u_opacity * here.z * texture(u_stroke, at).r, u_mirrored.y * p_other.z * texture(u_stroke, p_other.xy).r);
  if (u_parts == ivec2(-1)) return;
  int part = int(texelFetch(u_strokesDirections, ivec2(at * vec2(textureSize(u_strokesDirections, 0))), 0).w) - 1;
  bvec2 isOther = notEqual(ivec2(part), u_parts);
  if (isOther.x) p_part.x = 0.0;
  if (isOther.y) p_part.y = 0.0;
  if (u_strokesView != 1 || u_mirrored.x == 0.0) return;  // without a mirror, sent strokes hold no paint of other parts
  if (isOther.x) p_sent.z = 0.0;
  if (isOther.y) p_other.z = 0.0;
}

vec4 withSent(vec4 values, int layer, vec3 taken) {
  return values * (1.0 - taken.z * texture(u_strokes, vec3(taken.xy, layer))) + taken.z * texture(u_strokes, vec3(taken.xy, layer + 1));
}

// Blend a share of the current stroke over values; `from` is the pixel's place in its image.
vec4 withDrawn(vec4 values, int plane, float part, vec2 from) {
  vec4 cover = u_cover[plane], added = u_added[plane];
  if (plane == u_imagePlane && part > 0.0) {
    vec4 paint = imaged(from);
    cover.rgb = (1.0 - paint.a) * cover.rgb + u_blend.x * paint.a + u_blend.y * paint.rgb;
    added.rgb = (1.0 - paint.a) * added.rgb + u_blend.z * paint.rgb;
  }
  return values * (1.0 - part * cover) + part * added;
}

// Return a plane's components with all strokes blended over.
vec4 painted(vec4 values, int plane) {
  int layer = u_strokesAt[plane];
  if (layer >= 0 && p_sent.z > 0.0) values = withSent(values, layer, p_sent);
  if (layer >= 0 && u_mirrored.x * p_other.z > 0.0) values = withSent(values, layer, p_other);
  values = withDrawn(values, plane, p_part.x, gl_FragCoord.xy / u_image);
  return min(withDrawn(values, plane, p_part.y, p_other.xy), 1.0);
}
#endif

#ifdef RELIEF
uniform float u_relief;  // the displacement of height 1, in root cells
uniform highp usampler2D u_heights;  // bits of the height at each pixel

// Return the difference of rest position and height between a pixel's two neighbours, where they lie on the same surface.
vec4 along(vec4 place, ivec2 at, ivec2 aside) {
  vec4 ends[2];
  for (int n = 0; n < 2; n++) {
    ivec2 to = n == 0 ? at - aside : at + aside;
    vec4 there = uintBitsToFloat(texelFetch(u_positions, to, 0));
    bool isBeside = there.w > 0.0 && distance(there.xyz, place.xyz) < 4.0 * place.w;
    ends[n] = vec4(isBeside ? there.xyz : place.xyz, uintBitsToFloat(texelFetch(u_heights, isBeside ? to : at, 0).x));
  }
  return ends[1] - ends[0];
}

// Return the gradient of the displacement along the surface at rest.
vec3 slopes(vec4 place, ivec2 at) {
  vec4 x = along(place, at, ivec2(1, 0)), y = along(place, at, ivec2(0, 1));
  vec3 side = cross(x.xyz, y.xyz);
  float square = dot(side, side);
  return square > 0.0 ? u_relief / square * (x.w * cross(y.xyz, side) + y.w * cross(side, x.xyz)) : vec3(0.0);
}
#endif

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 place = uintBitsToFloat(texelFetch(u_positions, at, 0));
  o_color = vec4(0.0);
  if (u_hasRegion && !isInRegion(place)) discard;
  if (place.w <= 0.0) return;
  uvec4 directions = texelFetch(u_directions, at, 0);
  vec3 normal = unpackDirection(directions.x), toward = unpackDirection(directions.y);
#ifdef FACING
  face(unpackDirection(directions.z));
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
  slope = restToView(slope, unpackDirection(directions.z), unpackDirection(directions.w), normal);
#else
  slope = mat3(u_view) * slope;
#endif
#endif
#ifdef NORMAL
  vec3 stored = 2.0 * NORMAL - 1.0;
  if (dot(stored, stored) > 1e-4) {
#ifdef POSED
    stored = restToView(stored, unpackDirection(directions.z), unpackDirection(directions.w), normal);
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
  vec3 light = lit(compared(BASE_COLOR, at), METALLIC, ROUGHNESS, OCCLUSION, SPECULAR, normal, toward);
  shown = toSrgb(toneMapped(light + EMISSIVE));
#elif defined(SHOWS_UNLIT)
  shown = toSrgb(compared(BASE_COLOR, at) + EMISSIVE);
#elif defined(SHOWS_CHANNEL)
  shown = compared(CHANNEL, at);
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
#ifdef BLENDS
  shown = toSrgb(mix(toLight(texelFetch(u_background, at, 0).rgb), toLight(shown), g_alpha));
#endif
#ifdef KNOWN
  o_color = vec4(shown, step(0.5, g_alpha));
#else
  o_color = vec4(shown, 1.0);
#endif
}

#endif
