// The base colour as the model's own images have it, of what gbuffer.frag has drawn.

precision highp float;

in vec2 v_uv;
in vec3 v_color;

uniform sampler2D u_image;
uniform vec3 u_factor;

layout(location = 0) out vec4 o_color;

void main() {
  o_color = vec4(u_factor * v_color * texture(u_image, v_uv).rgb, 1.0);
}
