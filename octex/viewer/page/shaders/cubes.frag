// The faces of cells, in the colours that are stored.

flat in vec3 v_normal;
flat in uint v_number;
flat in uint v_level;
in vec2 v_face;

#ifdef PICKED

flat in uvec4 v_cell;

layout(location = 0) out uvec4 o_cell;  // x, y, z and level
layout(location = 1) out uvec4 o_number;  // the cell's, the part's, bits of how far away it is, and 1

uniform uint u_part;

void main() {
  o_cell = v_cell;
  o_number = uvec4(v_number, u_part, floatBitsToUint(1.0 / gl_FragCoord.w), 1u);
}

#else

uniform int u_kind;
uniform int u_by;  // 0 what is stored, 1 the level, 2 the facings

layout(location = 0) out vec4 o_color;

void main() {
  vec4 stored = CHANNEL_AT(ivec2(v_number & ROW, v_number >> 12u));
  vec3 value = CHANNEL_STORED;
  vec3 shown = u_kind == 0 ? toSrgb(value) : value;
  if (u_by == 1) shown = u_levels[v_level];
#ifdef FLAGS_AT
  if (u_by == 2) shown = facingColor(FLAGS_AT(ivec2(v_number & ROW, v_number >> 12u)));
#endif
  float shade = 0.62 + 0.38 * max(dot(v_normal, normalize(vec3(-0.3, 0.6, 0.75))), 0.0);
  vec2 rim = min(v_face, 1.0 - v_face) / max(fwidth(v_face), vec2(1e-6));
  if (min(rim.x, rim.y) < 1.0 && max(fwidth(v_face).x, fwidth(v_face).y) < 0.2) shade *= 0.75;
  o_color = vec4(shown * shade, 1.0);
}

#endif
