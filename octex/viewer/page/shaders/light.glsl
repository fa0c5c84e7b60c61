// Studio light around the camera, and what surfaces reflect of it: as octex.drawing.reflection has it.
//
// u_studio   a texel a number: the studio's tables of light by latitude and longitude, one for each step of
//            roughness, the last of what white matte surfaces reflect; then A and B of the reflectance A·F₀ + B

const int STEPS = 8;  // of roughness; one table more is of matte surfaces
const float PI = 3.14159265;
const float GRAZING = 1e-3, DARKEST = 0.02;

uniform highp sampler2D u_studio;
uniform ivec3 u_tables[STEPS + 2];  // of each table its first number, height and width
uniform ivec2 u_reflectances;  // the first number of these, and how many there are along each side

float numberAt(int n) {
  return texelFetch(u_studio, ivec2(n & 4095, n >> 12), 0).x;
}

// A table's light in a direction of view space, interpolated between four texels.
float tableLight(int number, vec3 way) {
  ivec3 table = u_tables[number];
  float column = (0.5 - atan(way.x, way.z) / (2.0 * PI)) * float(table.z) - 0.5;
  float row = (0.5 - asin(clamp(way.y, -1.0, 1.0)) / PI) * float(table.y) - 0.5;
  row = clamp(row, 0.0, float(table.y - 1));
  int left = int(floor(column)), top = int(row), below = min(top + 1, table.y - 1);
  float across = column - float(left), down = row - float(top);
  ivec2 columns = (ivec2(left, left + 1) + table.z) % table.z;
  ivec2 rows = table.x + ivec2(top, below) * table.z;
  float high = mix(numberAt(rows.x + columns.x), numberAt(rows.x + columns.y), across);
  return mix(high, mix(numberAt(rows.y + columns.x), numberAt(rows.y + columns.y), across), down);
}

float glossyLight(float roughness, vec3 way) {
  float level = roughness * float(STEPS);
  int below = min(int(level), STEPS - 1);
  return mix(tableLight(below, way), tableLight(below + 1, way), level - float(below));
}

vec2 reflectance(float cosine, float roughness) {
  int size = u_reflectances.y;
  vec2 place = clamp(vec2(cosine, roughness) * float(size) - 0.5, 0.0, float(size - 1));
  ivec2 at = min(ivec2(place), size - 2);
  vec2 part = place - vec2(at), found = vec2(0.0);
  for (int corner = 0; corner < 4; corner++) {
    ivec2 side = ivec2(corner & 1, corner >> 1);
    vec2 weights = mix(1.0 - part, part, vec2(side));
    int n = u_reflectances.x + 2 * ((at.x + side.x) * size + at.y + side.y);
    found += weights.x * weights.y * vec2(numberAt(n), numberAt(n + 1));
  }
  return found;
}

// The parts that are scattered once and more often, where `first` is along the normal.
void scatter(vec3 first, float slope, vec3 bias, out vec3 once, out vec3 again) {
  once = first * slope + bias;
  vec3 lost = 1.0 - slope - bias, average = first + (1.0 - first) / 21.0;
  again = once * average / (1.0 - lost * average) * lost;
}

// Light that a surface sends to the camera: `normal` and `toward` are unit vectors in view space.
vec3 lit(vec3 color, float metallic, float roughness, float occlusion, vec3 specular, vec3 normal, vec3 toward) {
  float cosine = dot(normal, toward);
  if (cosine < GRAZING) {
    normal = normalize(normal + (GRAZING - cosine) * toward);
    cosine = max(dot(normal, toward), GRAZING);
  }
  vec2 part = reflectance(cosine, roughness);
  float glossy = glossyLight(roughness, reflect(-toward, normal)), matte = tableLight(STEPS + 1, normal);
  vec3 once, again, metal, metalAgain;
  scatter(specular, part.x, part.y * min(specular / DARKEST, 1.0), once, again);
  scatter(color, part.x, vec3(part.y), metal, metalAgain);
  vec3 plain = once * glossy + (again + color * (1.0 - once - again)) * matte;
  return occlusion * mix(plain, metal * glossy + metalAgain * matte, metallic);
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
