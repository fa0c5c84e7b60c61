// Colours as a screen has them, and those that stand for levels and directions.

uniform vec3 u_levels[22];  // levels in colours that can be told apart, the root's first
uniform vec3 u_facings[7];  // facings likewise, +x −x +y −y +z −z, and none

vec3 toSrgb(vec3 light) {
  light = clamp(light, 0.0, 1.0);
  return mix(light * 12.92, 1.055 * pow(light, vec3(1.0 / 2.4)) - 0.055, greaterThan(light, vec3(0.0031308)));
}

vec3 toLight(vec3 color) {
  return mix(color / 12.92, pow((color + 0.055) / 1.055, vec3(2.4)), greaterThan(color, vec3(0.04045)));
}

// The mean colour of the facings in a cell's flags.
vec3 facingColor(uint flags) {
  vec3 color = vec3(0.0);
  float count = 0.0;
  for (uint bit = 0u; bit < 6u; bit++) {
    if ((flags >> bit & 1u) == 0u) continue;
    color += u_facings[bit];
    count += 1.0;
  }
  return count > 0.0 ? color / count : u_facings[6];
}
