// Copies, blurs, sharpens and smudges the colours of the view. See retouch.js.

layout(location = 0) out vec4 o_color;

uniform sampler2D u_from;  // sRGB; alpha 0: no surface is seen
uniform sampler2D u_before;  // the original of a blurred image, to mix or sharpen
uniform highp usampler2D u_positions;  // by gbuffer.frag
uniform sampler2D u_paint;  // paint of a layer below others
uniform int u_action;  // 0: copy, 1: blur, 2: smudge, 3: paint below other layers
uniform ivec2 u_step;  // offset that colours are copied by, or direction of the blur
uniform float u_sigma;  // of the blur, in pixels
uniform float u_share;  // of the blurred or smudged colour; below 0 it sharpens
uniform vec4 u_disc;  // the brush: centre, radius, and the share of the radius that is fully covered

const float NEAR = 2.5;  // the most footprints, for each pixel between them, that positions of one surface are apart

vec4 colorAt(ivec2 at) {
  ivec2 size = textureSize(u_from, 0);
  return at == clamp(at, ivec2(0), size - 1) ? texelFetch(u_from, at, 0) : vec4(0.0);
}

vec4 placeAt(ivec2 at) {
  return uintBitsToFloat(texelFetch(u_positions, at, 0));
}

// Return whether two pixels, `pixels` apart, show the same surface.
bool isSameSurface(vec4 a, vec4 b, float pixels) {
  return distance(a.xyz, b.xyz) <= NEAR * 0.5 * (a.w + b.w) * pixels;
}

vec4 blurred(ivec2 at, vec4 place) {
  int reach = int(ceil(2.5 * u_sigma));
  vec4 sum = vec4(0.0);
  for (int n = -reach; n <= reach; n++) {
    ivec2 other = at + n * u_step;
    vec4 color = colorAt(other);
    if (color.a == 0.0 || (n != 0 && !isSameSurface(place, placeAt(other), abs(float(n))))) continue;
    float weight = exp(-0.5 * float(n * n) / (u_sigma * u_sigma));
    sum += weight * vec4(toLight(color.rgb), 1.0);
  }
  vec3 light = sum.rgb / sum.a, before = toLight(texelFetch(u_before, at, 0).rgb);
  return vec4(toSrgb(mix(before, light, u_share)), 1.0);
}

vec4 smudged(ivec2 at, vec4 place, vec4 color) {
  float radius = u_disc.z, inner = min(radius * u_disc.w, radius - 0.5);
  float share = u_share * (1.0 - smoothstep(inner, radius + 0.5, distance(gl_FragCoord.xy, u_disc.xy)));
  ivec2 other = at - u_step;
  vec4 moved = colorAt(other);
  if (share <= 0.0 || moved.a == 0.0 || !isSameSurface(place, placeAt(other), length(vec2(u_step)))) return color;
  return vec4(toSrgb(mix(toLight(color.rgb), toLight(moved.rgb), share)), 1.0);
}

// Show paint through the layers above it: between the result of black paint and that of white. Its colour is u_disc if
// u_share is below 0.
vec4 ledTo(ivec2 at) {
  vec4 black = colorAt(at), paint = texelFetch(u_paint, at, 0);
  if (u_share < 0.0) paint = vec4(u_disc.rgb, 1.0);
  if (black.a == 0.0) return u_share < 0.0 ? vec4(0.0) : vec4(paint.rgb, paint.a * u_share);
  vec3 white = texelFetch(u_before, at, 0).rgb;
  return vec4(toSrgb(mix(toLight(black.rgb), toLight(white), toLight(paint.rgb))), paint.a);
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  if (u_action == 0) {
    o_color = colorAt(at - u_step);
    return;
  }
  if (u_action == 3) {
    o_color = ledTo(at);
    return;
  }
  vec4 color = colorAt(at), place = placeAt(at);
  o_color = color.a == 0.0 ? vec4(0.0) : u_action == 1 ? blurred(at, place) : smudged(at, place, color);
}
