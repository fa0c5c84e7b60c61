// The faces of cells, in the colours that are stored.

flat in vec3 v_normal;
flat in uint v_number;
flat in uint v_level;
in vec2 v_face;

uniform int u_kind;
uniform bool u_byLevel;

layout(location = 0) out vec4 o_color;

void main() {
  vec4 stored = texelFetch(CHANNEL_PLANE, ivec2(v_number & ROW, v_number >> 12u), 0);
  vec3 value = CHANNEL_STORED;
  vec3 shown = u_kind == 0 ? toSrgb(value) : value;
  if (u_byLevel) shown = levelColor(v_level);
  float shade = 0.62 + 0.38 * max(dot(v_normal, normalize(vec3(-0.3, 0.6, 0.75))), 0.0);
  vec2 rim = min(v_face, 1.0 - v_face) / max(fwidth(v_face), vec2(1e-6));
  if (min(rim.x, rim.y) < 1.0 && max(fwidth(v_face).x, fwidth(v_face).y) < 0.2) shade *= 0.75;
  o_color = vec4(shown * shade, 1.0);
}
