// The brush's outline on the surface: its reach in each direction, one pixel an angle. See outline.js.

layout(location = 0) out uvec4 o_reach;  // bits, in radii: how far paint reaches, and where the surface is half a radius away

uniform highp usampler2D u_positions;  // by gbuffer.frag
uniform highp usampler2D u_directions;
uniform vec3 u_brush;  // centre and radius, in pixels from the lower left
uniform float u_half;  // half the radius, in root cells
uniform vec2 u_limits;  // the least painted cosine; 1: paint back faces too

const int STEPS = 40, ANGLES = 64;

void main() {
  float angle = 6.28318531 * gl_FragCoord.x / float(ANGLES);
  ivec2 size = textureSize(u_positions, 0);
  vec3 middle = uintBitsToFloat(texelFetch(u_positions, ivec2(u_brush.xy), 0)).xyz;
  vec2 reach = vec2(0.0);
  for (int n = 1; n <= STEPS; n++) {
    float part = float(n) / float(STEPS);
    ivec2 at = ivec2(floor(u_brush.xy + part * u_brush.z * vec2(cos(angle), sin(angle))));
    if (at != clamp(at, ivec2(0), size - 1)) break;
    vec4 place = uintBitsToFloat(texelFetch(u_positions, at, 0));
    uvec4 directions = texelFetch(u_directions, at, 0);
    bool isBackFace = (floatBitsToUint(place.w) & 1u) == 1u;
    if (place.w <= 0.0 || (isBackFace && u_limits.y < 0.5) || dot(unpackDirection(directions.x), unpackDirection(directions.y)) < u_limits.x) continue;  // the last one counts
    reach.x = part;
    if (distance(place.xyz, middle) <= u_half) reach.y = part;
  }
  o_reach = uvec4(floatBitsToUint(reach), 0u, 1u);
}
