// Cells as cubes: of each the three faces that the camera sees. An instance is a cell.

layout(location = 0) in uvec4 a_cell;  // x, y, z and level
layout(location = 1) in uint a_number;

uniform mat4 u_projection;
uniform mat4 u_view;
uniform vec3 u_low;  // the root cell's lowest corner in the world
uniform float u_edge;  // and its edge
uniform vec3 u_camera;  // in texture space

flat out vec3 v_normal;
flat out uint v_number;
flat out uint v_level;
flat out uvec4 v_cell;
out vec2 v_face;

void main() {
  float edge = 1.0 / float(1 << a_cell.w);
  vec3 corner = vec3(a_cell.xyz) * edge;
  int face = gl_VertexID / 6, at = gl_VertexID % 6;
  vec2 across = vec2(at == 1 || at == 3 || at == 4, at == 2 || at == 4 || at == 5);
  vec3 middle = corner + 0.5 * edge;
  float side = u_camera[face] > middle[face] ? 1.0 : 0.0;
  vec3 place = vec3(0.0);
  place[face] = side;
  place[(face + 1) % 3] = across.x;
  place[(face + 2) % 3] = across.y;
  v_normal = vec3(0.0);
  v_normal[face] = 2.0 * side - 1.0;
  v_normal = mat3(u_view) * v_normal;
  v_number = a_number;
  v_level = a_cell.w;
  v_cell = a_cell;
  v_face = across;
  vec3 world = u_low + u_edge * (corner + edge * place);
  gl_Position = u_projection * (u_view * vec4(world, 1.0));
}
