// How far a brush reaches on the surface around its middle, a pixel an angle. See outline.js.

layout(location = 0) out uvec4 o_reach;  // bits: how far paint goes, and where the surface is half the radius away, in radii

uniform highp usampler2D u_places;  // as places.frag has drawn them
uniform highp usampler2D u_ways;
uniform vec3 u_brush;  // the middle and the radius, in pixels from the lower left
uniform float u_half;  // half the radius, in root cells
uniform vec2 u_limits;  // the least cosine that is painted; 1: back faces too

const int STEPS = 40, ANGLES = 64;

void main() {
  float angle = 6.28318531 * gl_FragCoord.x / float(ANGLES);
  ivec2 size = textureSize(u_places, 0);
  vec3 middle = uintBitsToFloat(texelFetch(u_places, ivec2(u_brush.xy), 0)).xyz;
  vec2 reach = vec2(0.0);
  for (int n = 1; n <= STEPS; n++) {
    float part = float(n) / float(STEPS);
    ivec2 at = ivec2(floor(u_brush.xy + part * u_brush.z * vec2(cos(angle), sin(angle))));
    if (at != clamp(at, ivec2(0), size - 1)) break;
    vec4 place = uintBitsToFloat(texelFetch(u_places, at, 0));
    uvec4 ways = texelFetch(u_ways, at, 0);
    bool isAway = (floatBitsToUint(place.w) & 1u) == 1u;
    if (place.w <= 0.0 || (isAway && u_limits.y < 0.5) || dot(unpacked(ways.x), unpacked(ways.y)) < u_limits.x) continue;  // the last one counts
    reach.x = part;
    if (distance(place.xyz, middle) <= u_half) reach.y = part;
  }
  o_reach = uvec4(floatBitsToUint(reach), 0u, 1u);
}
