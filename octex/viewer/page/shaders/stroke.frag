// The coverage of a stroke between two places of the pen, a disc whose size changes on the way.

precision highp float;

layout(location = 0) out vec4 o_coverage;

uniform vec4 u_line;  // both places, in pixels from the lower left
uniform vec2 u_radii;
uniform vec2 u_strengths;
uniform float u_hardness;  // the part of the radius that is covered in full

void main() {
  vec2 from = gl_FragCoord.xy - u_line.xy, way = u_line.zw - u_line.xy;
  float along = clamp(dot(from, way) / max(dot(way, way), 1e-9), 0.0, 1.0);
  float radius = mix(u_radii.x, u_radii.y, along), inner = min(radius * u_hardness, radius - 0.5);
  o_coverage = vec4(mix(u_strengths.x, u_strengths.y, along)) * (1.0 - smoothstep(inner, radius + 0.5, distance(from, along * way)));
}
