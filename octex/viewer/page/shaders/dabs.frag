// The coverage of a stroke with some more dabs. See dabs.js.

precision highp float;

layout(location = 0) out vec4 o_coverage;
layout(location = 1) out vec4 o_code;  // the same in 8 bits

uniform sampler2D u_before;
uniform vec4 u_dabs[32];  // places, in pixels from the lower left, radii and strengths
uniform int u_count;
uniform float u_flow;
uniform float u_hardness;  // the part of the radius that is covered in full

void main() {
  float covered = texelFetch(u_before, ivec2(gl_FragCoord.xy), 0).r;
  for (int n = 0; n < u_count; n++) {
    vec4 dab = u_dabs[n];
    float inner = min(dab.z * u_hardness, dab.z - 0.5), apart = distance(gl_FragCoord.xy, dab.xy);
    float own = dab.w * (1.0 - smoothstep(inner, dab.z + 0.5, apart));
    covered = max(covered, mix(covered, own, u_flow));
  }
  o_coverage = o_code = vec4(covered);
}
