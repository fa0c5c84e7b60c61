// Studio light around the camera: soft boxes as spherical Gaussians over a floor and a ceiling.

struct Box {
  vec3 from;
  vec3 light;
  float sharpness;
};

const Box KEY = Box(vec3(-0.45, 0.65, 0.61), vec3(3.4, 3.3, 3.1), 14.0);
const Box FILL = Box(vec3(0.88, 0.15, 0.45), vec3(0.9, 0.95, 1.05), 10.0);
const Box RIM = Box(vec3(0.25, 0.55, -0.80), vec3(2.2, 2.25, 2.4), 18.0);
const float ABOVE = 0.62, BELOW = 0.20;

// A box seen in a direction through a lobe as wide as `spread`, as much light as ever.
vec3 boxIn(Box box, vec3 direction, float spread) {
  float sharpness = 1.0 / (1.0 / box.sharpness + spread);
  return box.light * sharpness / box.sharpness * exp(sharpness * (dot(normalize(box.from), direction) - 1.0));
}

vec3 studio(vec3 direction, float spread) {
  float rise = direction.y / sqrt(direction.y * direction.y + 0.05 + spread);
  vec3 light = vec3(mix(BELOW, ABOVE, 0.5 + 0.5 * rise));
  return light + boxIn(KEY, direction, spread) + boxIn(FILL, direction, spread) + boxIn(RIM, direction, spread);
}

// What a GGX lobe reflects of even light: scale and bias of the colour at normal incidence.
// (Karis, "Physically Based Shading on Mobile", 2014.)
vec2 reflectance(float roughness, float cosine) {
  vec4 r = roughness * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
  float a = min(r.x * r.x, exp2(-9.28 * cosine)) * r.x + r.y;
  return vec2(-1.04, 1.04) * a + r.zw;
}

// Light that a surface sends to the camera: `normal` and `toward` are unit vectors in view space.
vec3 lit(vec3 color, float metallic, float roughness, float occlusion, vec3 specular, vec3 normal, vec3 toward) {
  float cosine = max(dot(normal, toward), 1e-3);
  float alpha = max(roughness * roughness, 0.002);
  vec3 front = mix(0.04 * specular, color, metallic);
  vec2 part = reflectance(roughness, cosine);
  vec3 mirrored = studio(reflect(-toward, normal), 0.5 * alpha * alpha / (0.25 + cosine));
  vec3 diffuse = studio(normal, 0.5) * color * (1.0 - metallic);
  return (diffuse * (1.0 - part.x * front - part.y) + mirrored * (front * part.x + part.y)) * occlusion;
}

// Compress what is brighter than white and keep the rest as it is. (Khronos PBR Neutral tone mapper.)
vec3 toneMapped(vec3 color) {
  const float start = 0.8 - 0.04, desaturation = 0.15;
  float least = min(color.r, min(color.g, color.b));
  float offset = least < 0.08 ? least - 6.25 * least * least : 0.04;
  color -= offset;
  float peak = max(color.r, max(color.g, color.b));
  if (peak < start) return color;
  float d = 1.0 - start;
  float lower = 1.0 - d * d / (peak + d - start);
  color *= lower / peak;
  return mix(color, vec3(lower), 1.0 - 1.0 / (desaturation * (peak - lower) + 1.0));
}

vec3 toSrgb(vec3 light) {
  light = clamp(light, 0.0, 1.0);
  return mix(light * 12.92, 1.055 * pow(light, vec3(1.0 / 2.4)) - 0.055, greaterThan(light, vec3(0.0031308)));
}

// Levels in colours that can be told apart, the root's first.
vec3 levelColor(uint level) {
  return 0.5 + 0.45 * cos(6.2832 * (0.381966 * float(level) + vec3(0.0, 0.33, 0.67)));
}

// The ways that a surface faces, from bits +x −x +y −y +z −z: red, green and blue for the axes, dark for −.
vec3 facingColor(uint flags) {
  vec3 color = vec3(0.0);
  float count = 0.0;
  for (uint bit = 0u; bit < 6u; bit++) {
    if ((flags >> bit & 1u) == 0u) continue;
    vec3 axis = vec3(bit < 2u, bit == 2u || bit == 3u, bit > 3u);
    color += (bit & 1u) == 0u ? 0.25 + 0.7 * axis : 0.08 + 0.4 * axis;
    count += 1.0;
  }
  return count > 0.0 ? color / count : vec3(0.5);
}
