// The field of an octree at a point of texture space: the cells around it, blended. See octex/field.
//
// u_nodes    a texel a node: first child cell << 8 | node mask, first child node << 8 | leaf mask
// u_planeN   a texel a cell: values of channels; in alpha of the first the code of the cell's area
//
// A line with N in braces stands there for each plane that is read. Channels' names in capitals are their
// components among the sums, ALPHA those of one cell.
//
// The 3×3×3 cells around a point are children of a block of 2×2×2 nodes of the level above. The walk goes down
// from block to block, eight nodes at a time, in two vectors: x varies first, then y; z is 0 in `low`.

precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

const int NEAREST = 0, LINEAR = 1, QUADRATIC = 2;
const uint ROW = 4095u;  // texels in a row, less one
const float FINEST = 8388608.0;  // 2²³: positions in fixed point

uniform usampler2D u_nodes;

uniform sampler2D u_plane{N};
vec4 g_sum{N} = vec4(0.0);
uniform int u_depth;  // the deepest level that is looked up
uniform int u_filter;

int g_fetches = 0;

struct Eight {
  uvec4 low, high;
};

// What is looked up are the sums g_sumN under weights; these are their sums: with alpha and without, and that
// of alpha itself.
float g_total = 0.0, g_cover = 0.0, g_alpha = 0.0;

// Root of the area in cell faces; 1 if that is not known.
float areaWeight(float stored) {
  float code = round(stored * 255.0);
  return code > 0.0 ? exp2((code - 207.0) / 16.0) : 1.0;
}

void tap(uint cell, float weight, bool averages) {
  ivec2 at = ivec2(cell & ROW, cell >> 12u);
  vec4 value{N} = texelFetch(u_plane{N}, at, 0);
  g_fetches += PLANES;
  if (averages) weight *= areaWeight(value0.a);
  g_cover += weight;
#ifdef ALPHA
  g_alpha += weight * ALPHA;
  weight *= ALPHA;
#endif
  g_total += weight;
  g_sum{N} += weight * value{N};
}

// Weights of the four cells along an axis that a block has, from their distances to the point.
vec4 kernel(vec4 away) {
  vec4 d = abs(away);
  if (u_filter == QUADRATIC) {
    vec4 rim = max(1.5 - d, 0.0);
    return mix(0.5 * rim * rim, 0.75 - d * d, lessThan(d, vec4(0.5)));
  }
  return max(1.0 - d, 0.0);
}

uvec2 nodeAt(uint number) {
  if (number == 0u) return uvec2(0u);
  g_fetches++;
  number -= 1u;
  return texelFetch(u_nodes, ivec2(number & ROW, number >> 12u), 0).xy;
}

// The children of one node, weighed by their places along the axes.
void children(uvec2 words, vec2 x, vec2 y, vec2 z, bool averages) {
  uint mask = (words.x | words.y) & 255u;
  if (mask == 0u || x.x + x.y <= 0.0 || y.x + y.y <= 0.0 || z.x + z.y <= 0.0) return;
  uint cell = words.x >> 8u;
  vec4 plane = vec4(x * y.x, x * y.y);
  vec4 low = plane * z.x, high = plane * z.y;
  for (int octant = 0; octant < 8; octant++) {
    if ((mask & 1u) != 0u) {
      float weight = low.x;
      if (weight > 0.0) tap(cell, weight, averages);
      cell++;
    }
    mask >>= 1u;
    low = octant == 3 ? high : low.yzwx;
  }
}

// The stored cell that is nearest to the point, among the children of one node.
void nearestChild(uvec2 words, vec2 x, vec2 y, vec2 z, inout float least, inout uint nearest) {
  uint mask = (words.x | words.y) & 255u;
  uint cell = words.x >> 8u;
  for (uint octant = 0u; octant < 8u; octant++) {
    if ((mask >> octant & 1u) == 0u) continue;
    float away = x[octant & 1u] + y[octant >> 1u & 1u] + z[octant >> 2u];
    if (away < least) {
      least = away;
      nearest = cell;
    }
    cell++;
  }
}

// Squared distances along an axis from the point to the four cells; beyond the 27: none is that near.
vec4 distances(vec4 away) {
  vec4 d = max(abs(away) - 0.5, 0.0);
  return mix(d * d, vec4(1e6), greaterThan(abs(away), vec4(1.5)));
}

// Take the cells around a point that is `inside` the cell in their middle, 0 to 1, whose numbers have `parity`.
void gather(Eight first, Eight second, vec3 inside, uvec3 parity, float share, bool averages) {
  // The block's cells begin two below that cell, or one where it is odd.
  vec3 begin = vec3(parity) - 1.5 - inside;
  vec4 steps = vec4(0.0, 1.0, 2.0, 3.0);
  vec4 x = steps + begin.x, y = steps + begin.y, z = steps + begin.z;
  if (u_filter == NEAREST) {
    x = distances(x), y = distances(y), z = distances(z);
    float least = 1e5;
    uint nearest = 0u;
    nearestChild(uvec2(first.low.x, second.low.x), x.xy, y.xy, z.xy, least, nearest);
    nearestChild(uvec2(first.low.y, second.low.y), x.zw, y.xy, z.xy, least, nearest);
    nearestChild(uvec2(first.low.z, second.low.z), x.xy, y.zw, z.xy, least, nearest);
    nearestChild(uvec2(first.low.w, second.low.w), x.zw, y.zw, z.xy, least, nearest);
    nearestChild(uvec2(first.high.x, second.high.x), x.xy, y.xy, z.zw, least, nearest);
    nearestChild(uvec2(first.high.y, second.high.y), x.zw, y.xy, z.zw, least, nearest);
    nearestChild(uvec2(first.high.z, second.high.z), x.xy, y.zw, z.zw, least, nearest);
    nearestChild(uvec2(first.high.w, second.high.w), x.zw, y.zw, z.zw, least, nearest);
    if (least < 1e5) tap(nearest, share, averages);
    return;
  }
  x = kernel(x), y = kernel(y), z = kernel(z) * share;
  children(uvec2(first.low.x, second.low.x), x.xy, y.xy, z.xy, averages);
  children(uvec2(first.low.y, second.low.y), x.zw, y.xy, z.xy, averages);
  children(uvec2(first.low.z, second.low.z), x.xy, y.zw, z.xy, averages);
  children(uvec2(first.low.w, second.low.w), x.zw, y.zw, z.xy, averages);
  children(uvec2(first.high.x, second.high.x), x.xy, y.xy, z.zw, averages);
  children(uvec2(first.high.y, second.high.y), x.zw, y.xy, z.zw, averages);
  children(uvec2(first.high.z, second.high.z), x.xy, y.zw, z.zw, averages);
  children(uvec2(first.high.w, second.high.w), x.zw, y.zw, z.zw, averages);
}

// Read a block's nodes: all, or those that have children in the block below.
void readBlock(Eight block, bvec3 other, uvec3 side, bool all, out Eight first, out Eight second) {
  bvec2 x = bvec2(all || !other.x || side.x == 0u, all || !other.x || side.x == 1u);
  bvec2 y = bvec2(all || !other.y || side.y == 0u, all || !other.y || side.y == 1u);
  bvec2 z = bvec2(all || !other.z || side.z == 0u, all || !other.z || side.z == 1u);
  uvec2 a = x.x && y.x && z.x ? nodeAt(block.low.x) : uvec2(0u);
  uvec2 b = x.y && y.x && z.x ? nodeAt(block.low.y) : uvec2(0u);
  uvec2 c = x.x && y.y && z.x ? nodeAt(block.low.z) : uvec2(0u);
  uvec2 d = x.y && y.y && z.x ? nodeAt(block.low.w) : uvec2(0u);
  first.low = uvec4(a.x, b.x, c.x, d.x);
  second.low = uvec4(a.y, b.y, c.y, d.y);
  a = x.x && y.x && z.y ? nodeAt(block.high.x) : uvec2(0u);
  b = x.y && y.x && z.y ? nodeAt(block.high.y) : uvec2(0u);
  c = x.x && y.y && z.y ? nodeAt(block.high.z) : uvec2(0u);
  d = x.y && y.y && z.y ? nodeAt(block.high.w) : uvec2(0u);
  first.high = uvec4(a.x, b.x, c.x, d.x);
  second.high = uvec4(a.y, b.y, c.y, d.y);
}

// For each child of the block below, the word of its parent.
Eight parents(Eight of, bvec3 other, uvec3 side) {
  if (other.x) {
    of.low = side.x == 0u ? of.low.xxzz : of.low.yyww;
    of.high = side.x == 0u ? of.high.xxzz : of.high.yyww;
  }
  if (other.y) {
    of.low = side.y == 0u ? of.low.xyxy : of.low.zwzw;
    of.high = side.y == 0u ? of.high.xyxy : of.high.zwzw;
  }
  if (other.z) {
    if (side.z == 0u) of.high = of.low;
    else of.low = of.high;
  }
  return of;
}

// Numbers of child nodes, counted from 1; 0 for none.
uvec4 childNodes(uvec4 first, uvec4 second, uvec4 octants) {
  uvec4 mask = first & 255u;
  uvec4 below = mask & ((uvec4(1u) << octants) - 1u);
  below -= below >> 1u & 0x55u;
  below = (below & 0x33u) + (below >> 2u & 0x33u);
  below = (below + (below >> 4u)) & 0x0Fu;
  return (mask >> octants & 1u) * ((second >> 8u) + below + 1u);
}

Eight blockBelow(Eight first, Eight second, bvec3 other, uvec3 side) {
  first = parents(first, other, side);
  second = parents(second, other, side);
  uvec4 x = other.x ? uvec4(0u, 1u, 0u, 1u) : uvec4(1u, 0u, 1u, 0u);
  uvec4 y = other.y ? uvec4(0u, 0u, 2u, 2u) : uvec4(2u, 2u, 0u, 0u);
  uvec4 octants = x + y;
  return Eight(
    childNodes(first.low, second.low, octants + (other.z ? 0u : 4u)),
    childNodes(first.high, second.high, octants + (other.z ? 4u : 0u))
  );
}

// Add the looks at two levels: `shares` of them, `levels` of which the second is not coarser.
void addLooks(vec3 point, ivec2 levels, vec2 shares, int leaves) {
  uvec3 fixedPoint = min(uvec3(clamp(point, 0.0, 1.0) * FINEST), uvec3(FINEST - 1.0));
  if (levels.x == 0) {
    vec3 away = abs(point - 0.5);
    float weight = u_filter == NEAREST ? 1.0 : kernel(away.xxxx).x * kernel(away.yyyy).x * kernel(away.zzzz).x;
    if (shares.x > 0.0) tap(0u, weight * shares.x, leaves > 0);
  }
  uvec3 parity = fixedPoint >> 22u & 1u;
  Eight block = Eight(uvec4(0u), uvec4(0u));
  uint root = (1u - parity.x) + 2u * (1u - parity.y);
  uvec4 at = uvec4(equal(uvec4(0u, 1u, 2u, 3u), uvec4(root)));
  if (parity.z == 1u) block.low = at;
  else block.high = at;
  for (int level = 1; level <= levels.y; level++) {
    bool looks = level == levels.x || level == levels.y;
    uvec3 side = level < 23 ? fixedPoint >> uint(22 - level) & 1u : uvec3(0u);
    bvec3 other = notEqual(side, parity);
    Eight first, second;
    readBlock(block, other, side, looks, first, second);
    if (looks) {
      float share = level == levels.x ? shares.x : shares.y;
      vec3 inside = point * float(1 << level) - vec3(fixedPoint >> uint(23 - level));
      if (share > 0.0) gather(first, second, inside, parity, share, level < leaves);
    }
    if (level == levels.y) break;
    block = blockBelow(first, second, other, side);
    if (block.low == uvec4(0u) && block.high == uvec4(0u)) break;
    parity = side;
  }
}

// Look the field up; `width` is the side of the square to average over, 0 for none.
void lookUp(vec3 point, float width) {
  point = clamp(point, 0.0, 1.0);
  g_sum{N} = vec4(0.0);
  g_total = g_alpha = g_cover = 0.0;
  ivec2 levels = ivec2(u_depth);
  vec2 shares = vec2(1.0, 0.0);
  if (width > 0.0) {
    float level = log2(1.0 / width) + (u_filter == LINEAR ? 0.6 : 0.85);
    float whole = floor(level);
    level = whole + clamp((level - whole - 0.1501) / (1.0 - 2.0 * 0.1501), 0.0, 1.0);
    level = clamp(level, 0.0, float(u_depth));
    levels.x = int(level);
    shares = vec2(1.0 - fract(level), fract(level));
    levels.y = shares.y > 0.0 ? levels.x + 1 : levels.x;
  }
  int leaves = width > 0.0 ? u_depth : 0;
  addLooks(point, levels, shares, leaves);
  // Off the surface: the averages of the deepest level that has one there.
  while (g_cover <= 0.0 && levels.x > 0) {
    levels = ivec2(levels.x - 1);
    addLooks(point, levels, vec2(1.0, 0.0), leaves);
  }
  float scale = g_total > 0.0 ? 1.0 / g_total : 0.0;
  g_sum{N} *= scale;
#ifdef ALPHA
  g_alpha /= max(g_cover, 1e-30);
#else
  g_alpha = 1.0;
#endif
}

// The leaf that holds a point, or the deepest cell above it: its number and its level.
uvec2 leafAt(vec3 point) {
  uvec3 place = min(uvec3(clamp(point, 0.0, 1.0) * FINEST), uvec3(FINEST - 1.0));
  uvec2 found = uvec2(0u);
  uint node = 1u;
  for (int level = 1; level <= u_depth; level++) {
    uvec2 words = nodeAt(node);
    uvec3 bit = place >> uint(23 - level) & 1u;
    uint octant = bit.x | bit.y << 1u | bit.z << 2u;
    uint mask = (words.x | words.y) & 255u;
    if ((mask >> octant & 1u) == 0u) break;
    uvec2 below = uvec2(mask, words.x) & ((1u << octant) - 1u);
    below -= below >> 1u & 0x55u;
    below = (below & 0x33u) + (below >> 2u & 0x33u);
    below = (below + (below >> 4u)) & 0x0Fu;
    found = uvec2((words.x >> 8u) + below.x, level);
    if ((words.x >> octant & 1u) == 0u) break;
    node = (words.y >> 8u) + below.y + 1u;
  }
  return found;
}
