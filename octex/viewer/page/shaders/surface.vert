// A vertex of the model: where it is drawn, and where it rests in the root cell.

precision highp float;

layout(location = 0) in vec3 a_rest;
layout(location = 1) in vec3 a_position;
layout(location = 2) in vec3 a_normal;

uniform mat4 u_projection;  // of the whole image, or of the pixel that is picked
uniform mat4 u_view;

#ifdef PARTS
layout(location = 7) in uint a_part;  // its number

flat out uint v_part;
#endif

out vec3 v_rest;
out vec3 v_seen;  // in view space
out vec3 v_normal;
out vec3 v_restNormal;  // where the model is not posed

invariant gl_Position;

#ifdef SOURCE
layout(location = 4) in vec2 a_uv;
layout(location = 5) in vec3 a_color;  // sRGB

out vec2 v_uv;
out vec3 v_color;  // light
#endif

#ifdef MOVED
#ifdef FROM_REST
layout(location = 6) in vec3 a_upright;  // the normal at rest
#endif
layout(location = 3) in uvec4 a_links;  // the vertex's first bone and how many, its first target and how many

uniform highp sampler2D u_links;  // a bone and its share; a target and what it adds; what targets add to normals
uniform uint u_turns;  // how far behind targets these stand
uniform highp sampler2D u_frames;  // of each frame the rows of bones, 3 texels each, and the weights of targets
uniform ivec2 u_frame;  // the texels that two frames begin at
uniform float u_share;  // of the second
uniform int u_firstTarget;  // among a frame's texels
uniform vec4 u_root;  // the root cell's lowest corner, and its edge

vec4 linkAt(uint n) {
  return texelFetch(u_links, ivec2(n & 4095u, n >> 12u), 0);
}

vec4 now(int n) {
  ivec2 before = ivec2(u_frame.x + n & 4095, u_frame.x + n >> 12), after = ivec2(u_frame.y + n & 4095, u_frame.y + n >> 12);
  return mix(texelFetch(u_frames, before, 0), texelFetch(u_frames, after, 0), u_share);
}

void move(inout vec3 position, inout vec3 normal) {
  for (uint n = a_links.z; n < a_links.z + a_links.w; n++) {
    vec4 link = linkAt(n);
    float weight = now(u_firstTarget + int(link.x)).x;
    position += weight * link.yzw;
#ifdef TURNS
    normal += weight * linkAt(n + u_turns).xyz;
#endif
  }
  mat3x4 rows = mat3x4(0.0);
  for (uint n = a_links.x; n < a_links.x + a_links.y; n++) {
    vec4 link = linkAt(n);
    int row = 3 * int(link.x);
    rows += link.y * mat3x4(now(row), now(row + 1), now(row + 2));
  }
  position = vec4(position, 1.0) * rows;
  // Normals are turned by the cofactors, which keep them upright where bones stretch unevenly.
  vec3 x = rows[0].xyz, y = rows[1].xyz, z = rows[2].xyz;
  normal = vec3(dot(cross(y, z), normal), dot(cross(z, x), normal), dot(cross(x, y), normal));
}
#endif

void main() {
  vec3 position = a_position, normal = a_normal;
#ifdef MOVED
#ifdef FROM_REST
  position = u_root.xyz + u_root.w * a_rest;
  normal = a_upright;
#endif
  move(position, normal);
#endif
#ifdef SOURCE
  v_uv = a_uv;
  v_color = mix(a_color / 12.92, pow((a_color + 0.055) / 1.055, vec3(2.4)), greaterThan(a_color, vec3(0.04045)));
#endif
  vec4 seen = u_view * vec4(position, 1.0);
#ifdef PARTS
  v_part = a_part;
#endif
  v_rest = a_rest;
  v_seen = seen.xyz;
  v_restNormal = a_normal;
  v_normal = mat3(u_view) * normal;
  gl_Position = u_projection * seen;
}
