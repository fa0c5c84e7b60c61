// A vertex of the model: where it is drawn, and where it rests in the root cell.

precision highp float;

layout(location = 0) in vec3 a_rest;
layout(location = 1) in vec3 a_position;
layout(location = 2) in vec3 a_normal;

uniform mat4 u_projection;  // of the whole picture, or of the pixel that is picked
uniform mat4 u_view;

out vec3 v_rest;
out vec3 v_seen;  // in view space
out vec3 v_normal;
out vec3 v_restNormal;  // where the model is not posed


void main() {
  vec4 seen = u_view * vec4(a_position, 1.0);
  v_rest = a_rest;
  v_seen = seen.xyz;
  v_restNormal = a_normal;
  v_normal = mat3(u_view) * a_normal;
  gl_Position = u_projection * seen;
}
