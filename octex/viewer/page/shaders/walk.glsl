// Evaluates the octree's field at a point of texture space, from the cells around it. See octex/field.
//
// u_nodes    a texel a node: first child cell << 8 | node mask, first child node << 8 | leaf mask
// u_srgb, u_linear   a layer a plane, a texel a cell: values of channels; in alpha of the first the code of the cell's
//            area. PLANEn(at) reads plane n.
//
// A line with N in braces is repeated for each plane that is read. A channel's name in capitals selects its components
// of the sums; ALPHA those of one cell.
//
// The 3×3×3 cells around a point are children of a block of 2×2×2 nodes of the level above. The walk goes down
// from block to block, eight nodes at a time, in two vectors: x varies first, then y; z is 0 in `low`.
//
// The filter is NEAREST, LINEAR or else quadratic. three/wgsl.js translates this file; its first lines say what it accepts.

precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

const uint ROW = 4095u;  // texels in a row, less one
const float FINEST = 8388608.0;  // 2²³: positions in fixed point
const float FAR = 4.0;  // a squared distance in cells

uniform usampler2D u_nodes;

uniform highp sampler2DArray u_srgb;
uniform highp sampler2DArray u_linear;
vec4 g_sum{N} = vec4(0.0);
uniform int u_depth;  // the deepest level that is sampled
uniform bool u_leafRoot;  // the root is a leaf
#if defined(SPLIT) || defined(KEPT)
uniform usampler2D u_entries;  // a texel an entry: a cell, and the first of its rows
uniform uvec3 u_split;  // of split cells: the first entry, how many, the row of planes that their rows begin at
uniform uvec3 u_kept;  // of nodes with kept coefficients likewise
uniform int u_keptLevel;  // the first level with such nodes
#endif

int g_fetches = 0;

struct PerNode {
  uvec4 low, high;
};

// Eight nodes around a point: their words, the parity of the child cell that holds the point, and the bit of the
// children's level in fixed-point positions.
struct Block {
  PerNode first, second;
  uvec3 parity;
  uint bit;
};

// Samples add to weighted sums g_sumN. These are the sums of the weights: times alpha, without alpha, and of alpha itself.
float g_total = 0.0, g_cover = 0.0, g_alpha = 0.0;
bool g_ignoresAlpha = false;

// The terms of one cell in the sums, for a weight of 1.
float r_total, r_cover, r_alpha;
vec4 r_sum{N};

void add(float weight) {
  g_total += weight * r_total;
  g_cover += weight * r_cover;
  g_alpha += weight * r_alpha;
  g_sum{N} += weight * r_sum{N};
}

ivec2 texelOf(uint row) {
  return ivec2(uvec2(row & ROW, row >> 12u));
}

// Add a row of the planes to a cell's terms.
void readRow(uint row, float weight) {
  ivec2 at = texelOf(row);
  vec4 value{N} = PLANE{N}(at);
  g_fetches += PLANES;
  r_cover += weight;
#ifdef ALPHA
  r_alpha += weight * ALPHA;
  if (!g_ignoresAlpha) weight *= ALPHA;
#endif
  r_total += weight;
  r_sum{N} += weight * value{N};
}

// Count the set bits of eight. Software renderers take as long for a shift as for ten products.
uint bitsOf(uint bits) {
  return (bits * 0x08040201u >> 3u & 0x11111111u) * 0x11111111u >> 28u;
}

#if defined(SPLIT) || defined(KEPT)
// Return a cell's row in an ascending table that begins at `first` and has `count` cells.
uint tableRow(uint cell, uint first, uint count) {
  uint low = 0u, high = count;
  while (low + 1u < high) {
    uint middle = (low + high) >> 1u;
    g_fetches++;
    if (texelFetch(u_entries, texelOf(first + middle), 0).x <= cell) low = middle;
    else high = middle;
  }
  return low;
}
#endif

#ifdef FACING
// The absolute cosines of the normal with the axes, and the three facings on its side.
vec3 g_cosines;
uvec3 g_facings;
const float AWAY = 1e-6;

void face(vec3 normal) {
  g_cosines = abs(normal) / max(length(normal), 1e-20);
  g_facings = uvec3(1u, 4u, 16u) * (uvec3(lessThan(normal, vec3(0.0))) + 1u);
}

float ramp(float cosine) {
  float t = min(2.0 * cosine, 1.0);
  return t * t * (3.0 - 2.0 * t);
}

// The cosines with a cell's facings on the normal's side, and the cell's weight by them.
vec3 seenOf(uint flags) {
  return g_cosines * vec3(uvec3(notEqual(uvec3(flags) & g_facings, uvec3(0u))));
}

float sideWeight(uint flags, vec3 seen) {
  return max(ramp(max(seen.x, max(seen.y, seen.z))), float((flags & 63u) == 0u)) + AWAY;
}
#endif

#ifdef SPLIT
bool isSplit(uint flags, vec3 seen) {
  return all(bvec3((flags & 128u) != 0u, max(seen.x, max(seen.y, seen.z)) > 0.0, u_split.y > 0u));
}

// Read the rows of a split cell for the facings on the normal's side; return whether the cell is split.
bool readSides(uint cell, uint flags, vec3 seen, float weight) {
  if (!isSplit(flags, seen)) return false;
  float most = max(seen.x, max(seen.y, seen.z));
  vec3 shares = max(seen - (most - 0.2), vec3(0.0)) * vec3(greaterThan(seen, vec3(0.0)));
  shares /= shares.x + shares.y + shares.z;
  uint entry = u_split.x + tableRow(cell, u_split.x, u_split.y);
  uint first = u_split.z + texelFetch(u_entries, texelOf(entry), 0).y;
  for (uint axis = 0u; axis < 3u; axis++) {
    if (shares[axis] > 0.0) readRow(first + bitsOf(flags & (g_facings[axis] - 1u)), weight * shares[axis]);
  }
  return true;
}
#endif

// The weight of an average: the square root of its area. An area of 0 weighs 1, as leaves do.
float areaWeight(float area) {
  float code = round(area * 255.0);
  return exp2(min(code, 1.0) * (code - 207.0) / 16.0);
}

// Read a cell's terms, weighted by its area if `averages`.
void read(uint cell, bool averages) {
  r_total = r_cover = r_alpha = 0.0;
  r_sum{N} = vec4(0.0);
  ivec2 at = texelOf(cell);
  float weight = areaWeight(float(averages) * PLANE0(at).a);
#ifdef FACING
  uint flags = FLAGS_AT(at);
  g_fetches++;
  vec3 seen = seenOf(flags);
  weight *= sideWeight(flags, seen);
#ifdef SPLIT
  if (readSides(cell, flags, seen, weight)) return;
#endif
#endif
  readRow(cell, weight);
}

#ifdef KEPT
// The coefficient that a node keeps.
void readKept(uint cell) {
  r_total = r_cover = r_alpha = 0.0;
  r_sum{N} = vec4(0.0);
  float weight = 1.0;
#ifdef FACING
  uint flags = FLAGS_AT(texelOf(cell));
  vec3 seen = seenOf(flags);
  weight = sideWeight(flags, seen);
#ifdef SPLIT
  if (readSides(cell, flags, seen, weight)) return;
#endif
#endif
  readRow(u_kept.z + tableRow(cell, u_kept.x, u_kept.y), weight);
}
#endif

void tap(uint cell, float weight, bool averages) {
  read(cell, averages);
  add(weight);
}

// Add a cell to the sums, unless it is split; return whether it is.
bool addWhole(uint cell, float weight, bool averages) {
  ivec2 at = texelOf(cell);
  bool isLeft = false;
  vec4 value{N} = PLANE{N}(at);
  g_fetches += PLANES;
  weight *= areaWeight(float(averages) * value0.a);
#ifdef FACING
  vec3 seen = seenOf(FLAGS);
  weight *= sideWeight(FLAGS, seen);
#ifdef SPLIT
  isLeft = isSplit(FLAGS, seen);
  weight *= float(!isLeft);
#endif
#endif
  g_cover += weight;
#ifdef ALPHA
  g_alpha += weight * ALPHA;
  if (!g_ignoresAlpha) weight *= ALPHA;
#endif
  g_total += weight;
  g_sum{N} += weight * value{N};
  return isLeft;
}

#ifdef SPLIT
// Add the sides of a split cell.
void addSides(uint cell, float weight, bool averages) {
  r_total = r_cover = r_alpha = 0.0;
  r_sum{N} = vec4(0.0);
  ivec2 at = texelOf(cell);
  uint flags = FLAGS_AT(at);
  g_fetches += 2;
  vec3 seen = seenOf(flags);
  readSides(cell, flags, seen, weight * areaWeight(float(averages) * PLANE0(at).a) * sideWeight(flags, seen));
  add(1.0);
}
#endif

// The weights of a block's four cells along an axis, by their distances from the point.
vec4 kernel(vec4 away) {
  vec4 d = abs(away);
#ifdef LINEAR
  return max(1.0 - d, vec4(0.0));
#else
  vec4 rim = max(1.5 - d, vec4(0.0));
  return mix(0.5 * rim * rim, 0.75 - d * d, vec4(lessThan(d, vec4(0.5))));
#endif
}

uvec2 nodeAt(uint number) {
  if (number == 0u) return uvec2(0u);
  g_fetches++;
  number -= 1u;
  return texelFetch(u_nodes, texelOf(number), 0).xy;
}

// The children of a block, a bit each: those present, and those still to be taken; of the lower four nodes, and of the
// upper four. Loops over bits take few turns. Software renderers run both branches of each `if` for all pixels, and the
// body of each loop at least once: fewer and shorter loops are faster.
struct Taps {
  PerNode cells;  // the first child of each node
  uvec2 present, pending;
  vec4 x, y, z;  // weights by the places along the axes
};

// The bits of children by their position along an axis; along z both words have the same.
const uvec4 ALONG_X = uvec4(0x00550055u, 0x00AA00AAu, 0x55005500u, 0xAA00AA00u);
const uvec4 ALONG_Y = uvec4(0x00003333u, 0x0000CCCCu, 0x33330000u, 0xCCCC0000u);
const uvec4 ALONG_Z = uvec4(0x0F0F0F0Fu, 0xF0F0F0F0u, 0x0F0F0F0Fu, 0xF0F0F0F0u);

uint joined(uvec4 masks) {
  return masks.x + masks.y * 0x100u + masks.z * 0x10000u + masks.w * 0x1000000u;
}

// The bits of positions along an axis with a weight, or near enough.
uvec4 wanted(vec4 along) {
#ifdef NEAREST
  return uvec4(lessThan(along, vec4(FAR)));
#else
  return uvec4(greaterThan(along, vec4(0.0)));
#endif
}

Taps tapsOf(Block block, vec4 x, vec4 y, vec4 z) {
  uvec4 low = (block.first.low | block.second.low) & uvec4(255u), high = (block.first.high | block.second.high) & uvec4(255u);
  uvec2 there = uvec2(joined(low), joined(high));
  uvec4 inX = ALONG_X * wanted(x), inY = ALONG_Y * wanted(y), inZ = ALONG_Z * wanted(z);
  uint plane = (inX.x | inX.y | inX.z | inX.w) & (inY.x | inY.y | inY.z | inY.w);
  PerNode cells = PerNode(block.first.low >> uvec4(8u), block.first.high >> uvec4(8u));
  return Taps(cells, there, there & uvec2(plane) & (inZ.xz | inZ.yw), x, y, z);
}

// Select the first of two numbers if a bit is among some, else the second, without a branch.
float either(uint bit, uint bits, vec2 both) {
  float is = float((bit & bits) != 0u);
  return is * both.x + (1.0 - is) * both.y;
}

// Take the first pending child; return its bit.
uvec2 take(inout Taps taps, out uint cell, out float weight) {
  uint upper = uint(taps.pending.x == 0u), left = taps.pending.x + upper * taps.pending.y;
  uvec2 word = uvec2(1u - upper, upper);
  uint lowest = left & (~left + 1u);
  uvec4 is = uvec4(notEqual(uvec4(lowest) & uvec4(0xFFu, 0xFF00u, 0xFF0000u, 0xFF000000u), uvec4(0u)));
  uvec4 first = is * (word.x * taps.cells.low + word.y * taps.cells.high);
  // The node's byte becomes the highest.
  uint up = is.x * 0x1000000u + is.y * 0x10000u + is.z * 0x100u + is.w;
  uint below = ((word.x * taps.present.x + word.y * taps.present.y) & (lowest - 1u)) * up;
  cell = first.x + first.y + first.z + first.w + bitsOf(below >> 24u);
  vec2 x = vec2(either(lowest, 0x00FF00FFu, taps.x.xz), either(lowest, 0x00FF00FFu, taps.x.yw));
  vec2 y = vec2(either(lowest, 0x0000FFFFu, taps.y.xz), either(lowest, 0x0000FFFFu, taps.y.yw));
  vec2 z = float(word.x) * taps.z.xy + float(word.y) * taps.z.zw;
  vec3 along = vec3(either(lowest, 0x55555555u, x), either(lowest, 0x33333333u, y), either(lowest, 0x0F0F0F0Fu, z));
#ifdef NEAREST
  weight = along.x + along.y + along.z;
#else
  weight = along.x * along.y * along.z;
#endif
  uvec2 bit = lowest * word;
  taps.pending ^= bit;
  return bit;
}

// Squared distances along an axis from the point to the four cells; FAR beyond the 27.
vec4 distances(vec4 away) {
  vec4 d = max(abs(away) - 0.5, vec4(0.0));
  return mix(d * d, vec4(FAR), vec4(greaterThan(abs(away), vec4(1.5))));
}

// Add the cells around a point; `inside` is its position in the middle cell, 0 to 1.
void gather(Block block, vec3 inside, float share, bool averages) {
  // The block begins two cells before the middle one, or one where that is odd.
  vec3 begin = vec3(block.parity) - 1.5 - inside;
  vec4 steps = vec4(0.0, 1.0, 2.0, 3.0);
  vec4 x = steps + begin.x, y = steps + begin.y, z = steps + begin.z;
  uint cell;
  float weight;
#ifdef NEAREST
  Taps taps = tapsOf(block, distances(x), distances(y), distances(z));
  float least = FAR;
  uint nearest = 0u;
  while ((taps.pending.x | taps.pending.y) != 0u) {
    take(taps, cell, weight);
    if (weight < least) nearest = cell;
    least = min(weight, least);
  }
  if (least < FAR) tap(nearest, share, averages);
#else
  Taps taps = tapsOf(block, kernel(x), kernel(y), kernel(z) * share);
  uvec2 split = uvec2(0u);
  while ((taps.pending.x | taps.pending.y) != 0u) {
    uvec2 bit = take(taps, cell, weight);
    split |= bit * uint(addWhole(cell, weight, averages));
  }
#ifdef SPLIT
  taps.pending = split;
  while ((taps.pending.x | taps.pending.y) != 0u) {
    take(taps, cell, weight);
    addSides(cell, weight, averages);
  }
#endif
#endif
}

// Return the parent's word for each node of the block below.
PerNode parents(PerNode all, uvec3 other, uvec3 side) {
  uvec3 before = other * side, after = 1u - other * (1u - side);
  uvec4 x = uvec2(before.x, after.x).xyxy, y = uvec2(before.y, after.y).xxyy;
  all.low = all.low.xxzz + x * (all.low.yyww - all.low.xxzz);
  all.high = all.high.xxzz + x * (all.high.yyww - all.high.xxzz);
  all.low = all.low.xyxy + y * (all.low.zwzw - all.low.xyxy);
  all.high = all.high.xyxy + y * (all.high.zwzw - all.high.xyxy);
  uvec4 apart = all.high - all.low;
  return PerNode(all.low + before.z * apart, all.low + after.z * apart);
}

// Return the numbers of child nodes plus 1; 0 for none. `nodes` are first child nodes << 8 | node masks.
uvec4 childNodes(uvec4 nodes, uvec4 bits) {
  uvec4 below = (nodes & (bits - 1u)) * 0x08040201u >> uvec4(3u) & uvec4(0x11111111u);
  return uvec4(notEqual(nodes & bits, uvec4(0u))) * ((nodes >> uvec4(8u)) + (below * 0x11111111u >> uvec4(28u)) + 1u);
}

// A point in fixed point, and the parity of the cell there of a bit's level.
uvec3 fixedAt(vec3 point) {
  return min(uvec3(clamp(point, vec3(0.0), vec3(1.0)) * FINEST), uvec3(vec3(FINEST - 1.0)));
}

uvec3 parityAt(uvec3 place, uint bit) {
  return uvec3(notEqual(place & uvec3(bit), uvec3(0u)));
}

// The words of a node whose only child is the root.
uvec2 aboveRoot() {
  return uvec2(uint(!u_leafRoot), uint(u_leafRoot));
}

// The block of one node with some words, above the level of a bit, and of seven that there are not.
Block blockOf(uvec2 words, uvec3 place, uint bit) {
  uvec3 parity = parityAt(place, bit);
  uvec4 at = uvec4(equal(uvec4(0u, 1u, 2u, 3u), uvec4(3u - parity.x - 2u * parity.y)));
  uvec4 low = at * parity.z, high = at * (1u - parity.z);
  return Block(PerNode(low * words.x, high * words.x), PerNode(low * words.y, high * words.y), parity, bit);
}

// Descend a level around a position. `span` has the bits in which the wanted parents differ: along an axis without any at
// this level, only the ancestor of the position is read.
void goDown(inout Block block, uvec3 place, uvec3 span) {
  uvec3 straddles = uvec3(greaterThanEqual(span, uvec3(block.bit)));
  block.bit = block.bit >> 1u;
  uvec3 side = parityAt(place, block.bit), other = side ^ block.parity;
  const uvec4 masks = uvec4(255u);
  PerNode nodes = PerNode(block.second.low & ~masks | block.first.low & masks, block.second.high & ~masks | block.first.high & masks);
  nodes = parents(nodes, other, side);
  uvec3 low = uvec3(2u, 4u, 16u) - other * uvec3(1u, 3u, 15u), high = 1u + other * uvec3(1u, 3u, 15u);
  uvec4 bits = uvec2(low.x, high.x).xyxy * uvec2(low.y, high.y).xxyy;
  uvec4 lower = childNodes(nodes.low, bits * low.z), upper = childNodes(nodes.high, bits * high.z);
  block = Block(PerNode(uvec4(0u), uvec4(0u)), PerNode(uvec4(0u), uvec4(0u)), side, block.bit);
  uvec3 own = uvec3(0xAAu, 0xCCu, 0xF0u) - side * uvec3(0x55u, 0x99u, 0xE1u);
  own |= straddles * 0xFFu;
  const uvec4 ones = uvec4(1u, 2u, 4u, 8u);
  uvec4 there = uvec4(notEqual(lower, uvec4(0u))) * ones + uvec4(notEqual(upper, uvec4(0u))) * (ones * 16u);
  uint needed = own.x & own.y & own.z & (there.x + there.y + there.z + there.w);
  while (needed != 0u) {
    uint lowest = needed & (~needed + 1u);
    uvec4 isLow = uvec4(equal(ones, uvec4(lowest))), isHigh = uvec4(equal(ones * 16u, uvec4(lowest)));
    uvec4 number = isLow * lower + isHigh * upper;
    uvec2 words = nodeAt(number.x + number.y + number.z + number.w);
    block.first.low += isLow * words.x;
    block.first.high += isHigh * words.x;
    block.second.low += isLow * words.y;
    block.second.high += isHigh * words.y;
    needed ^= lowest;
  }
}

uvec3 cellOf(uvec3 place, int level) {
  return place >> uvec3(uint(23 - level));
}

// Add samples of two levels with their shares; the second level is the same as the first, or the next.
void addLevels(vec3 point, ivec2 levels, vec2 shares, int leaves) {
  uvec3 place = fixedAt(point);
  // The parents of the cells of the first sample, and the bits in which their positions differ.
  ivec3 low = (ivec3(cellOf(place, levels.x)) - 1) >> uvec3(1u);
  ivec3 least = max(low, ivec3(0)), most = min(low + 1, ivec3((1 << uint(max(levels.x - 1, 0))) - 1));
  uvec3 span = uvec3(least ^ most) << uvec3(uint(24 - levels.x));
  // Begin with their last common ancestor.
  uvec2 words = aboveRoot();
  uint bit = uint(FINEST), widest = max(span.x, max(span.y, span.z));
  int level = 0;
  for (; level < levels.x && widest < bit && words.x != 0u; level++) {
    uvec3 side = parityAt(place, bit);
    uint child = (1u + side.x) * (1u + 3u * side.y) * (1u + 15u * side.z);
    uint isNode = uint((words.x & child) != 0u);
    words = nodeAt(isNode * ((words.y >> 8u) + bitsOf(words.x & (child - 1u)) + 1u));
    bit = bit >> 1u;
  }
  Block block = blockOf(words, place, bit);
  for (int sampled = levels.x; sampled <= levels.y; sampled++) {
    for (; level < sampled; level++) goDown(block, place, span);
    vec3 inside = point * float(1 << uint(level)) - vec3(cellOf(place, level));
    gather(block, inside, sampled == levels.x ? shares.x : shares.y, level < leaves);
    span = uvec3(uint(FINEST));
  }
}

// Return the leaf that holds a point, or its deepest ancestor: its number, its level, and 1 for a node.
uvec3 leafAt(vec3 point, int last) {
  uvec3 place = fixedAt(point);
  uvec3 found = uvec3(0u, 0u, uint(!u_leafRoot));
  uint node = 1u;
  for (int level = 1; level <= last; level++) {
    uvec2 words = nodeAt(node);
    uvec3 bit = parityAt(place, uint(FINEST) >> uint(level));
    uint octant = bit.x | bit.y << 1u | bit.z << 2u;
    uint mask = (words.x | words.y) & 255u;
    if ((mask >> octant & 1u) == 0u) break;
    uint below = (1u << octant) - 1u;
    found = uvec3((words.x >> 8u) + bitsOf(mask & below), uint(level), words.x >> octant & 1u);
    if (found.z == 0u) break;
    node = (words.y >> 8u) + bitsOf(words.x & below) + 1u;
  }
  return found;
}

#if defined(MIXED) && !defined(NEAREST)
// Leaves of several depths. The walk descends to the first level with leaves or kept coefficients around the point. From
// there on, each of the 3×3×3 cells holds terms of the sums. Refinement carries them to the next level, and leaves there
// replace them.
float m_total[27];
float m_weight[27];  // how much of a cell comes from cells that were read
vec4 m_sum{N}[27];
#ifdef ALPHA
float m_cover[27], m_alpha[27];  // without alpha, m_total is both
#endif
#ifdef KEPT
bool m_keeps[27];  // nodes with a kept coefficient
#endif
#ifdef LINEAR
// Linear interpolation refines leaves only.
bool m_leaf[27];  // leaves, and cells below leaves
#endif

void put(int at, float weight) {
  m_total[at] = weight * r_total;
  m_weight[at] = weight;
  m_sum{N}[at] = weight * r_sum{N};
#ifdef ALPHA
  m_cover[at] = weight * r_cover;
  m_alpha[at] = weight * r_alpha;
#endif
}

// Set the terms of all cells to 0.
void clearMixed() {
  r_total = r_cover = r_alpha = 0.0;
  r_sum{N} = vec4(0.0);
  for (int at = 0; at < 27; at++) {
    put(at, 0.0);
#ifdef KEPT
    m_keeps[at] = false;
#endif
#ifdef LINEAR
    m_leaf[at] = false;
#endif
  }
}

#ifdef LINEAR
// Keep only the terms of cells below the leaves of the level above, and only what these leaves give.
void keepBelow(uvec3 parity) {
  bool leaves[27] = m_leaf;
  for (int at = 0; at < 27; at++) {
    ivec3 owner = (ivec3(at % 3, at / 3 % 3, at / 9) + ivec3(parity) + 1) >> uvec3(1u);
    m_leaf[at] = leaves[owner.x + 3 * owner.y + 9 * owner.z];
    float scale = m_leaf[at] && m_weight[at] > 0.0 ? 1.0 / m_weight[at] : 0.0;
    m_total[at] *= scale;
    m_weight[at] *= scale;
    m_sum{N}[at] *= scale;
#ifdef ALPHA
    m_cover[at] *= scale;
    m_alpha[at] *= scale;
#endif
  }
}
#endif

// Chaikin's rule along a line of three cells: of a cell's halves each takes a quarter of its neighbour.
#define LINE(M, V) { V a = M[i], b = M[j], c = M[k]; M[i] = mix(a, b, low.x), M[j] = mix(odd ? b : a, odd ? c : b, low.y), M[k] = mix(b, c, low.z); }

void refine(uvec3 parity) {
  int step = 1;
  for (int axis = 0; axis < 3; axis++) {
    bool odd = parity[axis] == 1u;
    vec3 low = odd ? vec3(0.75, 0.25, 0.75) : vec3(0.25, 0.75, 0.25);
    for (int line = 0; line < 9; line++) {
      int i = line / step * step * 3 + line % step, j = i + step, k = j + step;
      LINE(m_total, float)
#if defined(KEPT) || defined(LINEAR)
      LINE(m_weight, float)
#endif
      LINE(m_sum{N}, vec4)
#ifdef ALPHA
      LINE(m_cover, float)
      LINE(m_alpha, float)
#endif
    }
    step *= 3;
  }
#ifdef LINEAR
  keepBelow(parity);
#endif
}

// Return the word of a block's node, by its position along the axes.
uint wordAt(PerNode words, uvec3 place) {
  uvec4 four = place.z == 0u ? words.low : words.high;
  return four[place.x + 2u * place.y];
}

// Replace refined terms by those of the cells around the point; return whether any cell is refined further.
bool putCells(Block block, bool isLast, bool averages) {
#if defined(KEPT) && !defined(LINEAR)
  bool kept[27] = m_keeps;
#endif
  bool goesOn = false;
  for (int at = 0; at < 27; at++) {
    uvec3 place = uvec3(uint(at % 3), uint(at / 3 % 3), uint(at / 9)) + 1u - block.parity;
    uvec3 parent = place >> uvec3(1u), octant = place & uvec3(1u);
    uint first = wordAt(block.first, parent), second = wordAt(block.second, parent), masks = (first | second) & 255u;
    uint bit = (1u + octant.x) * (1u + 3u * octant.y) * (1u + 15u * octant.z), cell = (first >> 8u) + bitsOf(masks & (bit - 1u));
    bool isNode = (first & bit) != 0u, isLeaf = (second & bit) != 0u;
    bool isBelow = false, keeps = false;  // whether the parent has a kept coefficient, and whether the cell has
#if defined(KEPT) && !defined(LINEAR)
    uvec3 owner = parent + block.parity;
    isBelow = kept[owner.x + 3u * owner.y + 9u * owner.z];
#endif
    float weight = isBelow ? m_weight[at] : 1.0;
    if (isLeaf || (isNode && isLast)) {
      read(cell, averages && isNode);
      put(at, weight);
#ifdef LINEAR
      m_leaf[at] = true;
#endif
    } else if (isNode || (masks != 0u && !isBelow)) {
#ifdef KEPT
      keeps = isNode && (FLAGS_AT(texelOf(cell)) & 64u) != 0u && u_kept.y > 0u;
      if (keeps) readKept(cell);
#endif
      put(at, keeps ? weight : 0.0);
    }
#ifdef KEPT
    m_keeps[at] = keeps;
#endif
    goesOn = goesOn || (isNode && !isLast);
  }
  return goesOn;
}

// Return whether any of the cells around the point has its bit in the words of a block's nodes.
bool isAround(PerNode words, uvec3 parity) {
  uvec4 plane = parity.x == 1u ? uvec4(0xFFu, 0x55u, 0xFFu, 0x55u) : uvec4(0xAAu, 0xFFu, 0xAAu, 0xFFu);
  plane &= parity.y == 1u ? uvec4(0xFFu, 0xFFu, 0x33u, 0x33u) : uvec4(0xCCu, 0xCCu, 0xFFu, 0xFFu);
  uvec4 low = plane & uvec4(parity.z == 1u ? 0xFFu : 0xF0u), high = plane & uvec4(parity.z == 1u ? 0x0Fu : 0xFFu);
  return any(notEqual(words.low & low | words.high & high, uvec4(0u)));
}

// Descend to the first level, at most `last`, without nodes around the point; add its cells.
void addMixedDepths(vec3 point, int last, float share, bool averages) {
  uvec3 place = fixedAt(point);
  Block block = blockOf(aboveRoot(), place, uint(FINEST));
  int level = 0;
  bool hasNodes = true, isMixed = false, goesOn = true;
  while (goesOn) {
    hasNodes = isAround(block.first, block.parity);
    isMixed = hasNodes && isAround(block.second, block.parity);
#ifdef KEPT
    isMixed = isMixed || (hasNodes && level < last && level >= u_keptLevel);
#endif
    goesOn = hasNodes && !isMixed && level < last;
    if (goesOn) goDown(block, place, uvec3(uint(FINEST)));
    level += int(goesOn);
  }
  if (!isMixed) {
    gather(block, point * float(1 << uint(level)) - vec3(cellOf(place, level)), share, averages && hasNodes);
    return;
  }
  clearMixed();
  goesOn = true;
  while (goesOn) {
    refine(block.parity);
    goesOn = putCells(block, level == last, averages);
    if (goesOn) goDown(block, place, uvec3(uint(FINEST)));
    level += int(goesOn);
  }
  vec3 inside = point * float(1 << uint(level)) - vec3(cellOf(place, level));
#ifdef LINEAR
  vec3 low = max(0.5 - inside, vec3(0.0)), high = max(inside - 0.5, vec3(0.0)), middle = 1.0 - low - high;
#else
  vec3 low = 0.5 * (1.0 - inside) * (1.0 - inside), high = 0.5 * inside * inside, middle = 1.0 - low - high;
#endif
  float total = 0.0;
  for (int at = 0; at < 27; at++) {
    ivec3 index = ivec3(at % 3, at / 3 % 3, at / 9);
    float weight = share;
    for (int axis = 0; axis < 3; axis++) weight *= index[axis] == 0 ? low[axis] : index[axis] == 1 ? middle[axis] : high[axis];
    total += weight * m_total[at];
    g_sum{N} += weight * m_sum{N}[at];
#ifdef ALPHA
    g_cover += weight * m_cover[at];
    g_alpha += weight * m_alpha[at];
#endif
  }
  g_total += total;
#ifndef ALPHA
  g_cover += total;
#endif
}
#endif

// Add samples of two levels, in any tree.
void addSamples(vec3 point, ivec2 levels, vec2 shares, int leaves) {
#ifdef MIXED
  for (int n = 0; n < 2; n++) {
    if (shares[n] <= 0.0) continue;
    bool averages = levels[n] < leaves;
#ifdef NEAREST
    uvec3 cell = leafAt(point, levels[n]);
    tap(cell.x, shares[n], averages && cell.z == 1u);
#else
    addMixedDepths(point, levels[n], shares[n], averages);
#endif
  }
#else
  addLevels(point, levels, shares, leaves);
#endif
}

// Sample the field; `width` is that of the footprint, 0 for none.
void lookUp(vec3 point, float width) {
  point = clamp(point, vec3(0.0), vec3(1.0));
  g_sum{N} = vec4(0.0);
  g_total = g_alpha = g_cover = 0.0;
  ivec2 levels = ivec2(u_depth);
  vec2 shares = vec2(1.0, 0.0);
  if (width > 0.0) {
#ifdef LINEAR
    float level = log2(1.0 / width) + 0.6;
#else
    float level = log2(1.0 / width) + 0.85;
#endif
    float whole = floor(level);
    level = whole + clamp((level - whole - 0.1501) / (1.0 - 2.0 * 0.1501), 0.0, 1.0);
    level = clamp(level, 0.0, float(u_depth));
    levels.x = int(level);
    shares = vec2(1.0 - fract(level), fract(level));
    levels.y = shares.y > 0.0 ? levels.x + 1 : levels.x;
  }
  int leaves = width > 0.0 ? u_depth : 0;
  // Off the surface, use the averages of the deepest level that has a cell there.
  for (;;) {
    addSamples(point, levels, shares, leaves);
#ifdef ALPHA
    // Where all alphas are zero, values are not weighted by them.
    if (g_cover > 0.0 && g_total <= 0.0 && !g_ignoresAlpha) {
      g_ignoresAlpha = true;
      g_cover = g_alpha = 0.0;
      continue;
    }
#endif
    if (g_cover > 0.0 || levels.x == 0) break;
    levels = ivec2(levels.x - 1);
    shares = vec2(1.0, 0.0);
  }
  float scale = g_total > 0.0 ? 1.0 / g_total : 0.0;
  g_sum{N} *= scale;
#ifdef ALPHA
  g_alpha /= max(g_cover, 1e-30);
#else
  g_alpha = 1.0;
#endif
}
