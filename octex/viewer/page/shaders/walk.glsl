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
const float FAR = 4.0;  // above all squared distances in cells

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

ivec2 texelOf(uint row) {
  return ivec2(uvec2(row & ROW, row >> 12u));
}

// Add a row of the planes to the sums.
void addRow(uint row, float weight) {
  ivec2 at = texelOf(row);
  vec4 value{N} = PLANE{N}(at);
  g_fetches += PLANES;
  g_cover += weight;
#ifdef ALPHA
  g_alpha += weight * ALPHA;
  if (!g_ignoresAlpha) weight *= ALPHA;
#endif
  g_total += weight;
  g_sum{N} += weight * value{N};
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

// Add the rows of a split cell for the facings on the normal's side; return whether the cell is split.
bool addSides(uint cell, uint flags, vec3 seen, float weight) {
  if (!isSplit(flags, seen)) return false;
  float most = max(seen.x, max(seen.y, seen.z));
  vec3 shares = max(seen - (most - 0.2), vec3(0.0)) * vec3(greaterThan(seen, vec3(0.0)));
  shares /= shares.x + shares.y + shares.z;
  uint entry = u_split.x + tableRow(cell, u_split.x, u_split.y);
  uint first = u_split.z + texelFetch(u_entries, texelOf(entry), 0).y;
  for (uint axis = 0u; axis < 3u; axis++) {
    if (shares[axis] > 0.0) addRow(first + bitsOf(flags & (g_facings[axis] - 1u)), weight * shares[axis]);
  }
  return true;
}
#endif

// The weight of an average: the square root of its area. An area of 0 weighs 1, as leaves do.
float areaWeight(float area) {
  float code = round(area * 255.0);
  return exp2(min(code, 1.0) * (code - 207.0) / 16.0);
}

// A cell's weight by its area, if `averages`.
float averageWeight(uint cell, bool averages) {
  return areaWeight(float(averages) * PLANE0(texelOf(cell)).a);
}

// Add a row of a cell, unless the cell is split: then its sides.
void addCell(uint cell, uint row, float weight) {
#ifdef FACING
  uint flags = FLAGS_AT(texelOf(cell));
  g_fetches++;
  vec3 seen = seenOf(flags);
  weight *= sideWeight(flags, seen);
#ifdef SPLIT
  if (addSides(cell, flags, seen, weight)) return;
#endif
#endif
  addRow(row, weight);
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

// A number for each of the 3×3×3 cells around a point: planes along z, with columns along y and rows along x.
struct Cells {
  mat3 low, middle, high;
};

// Their weights are products of the spline's weights along the axes. Of NEAREST, squared distances are sums.
#ifdef NEAREST
vec3 alongAxis(float inside) {
  return vec3(inside * inside, 0.0, (1.0 - inside) * (1.0 - inside));
}

mat3 planeOf(vec3 x, vec3 y, float z) {
  x = x + z;
  return mat3(x + y.x, x + y.y, x + y.z);
}
#else
vec3 alongAxis(float inside) {
  vec2 away = vec2(1.0 - inside, inside);
#ifdef LINEAR
  vec2 rim = max(away - 0.5, vec2(0.0));
#else
  vec2 rim = 0.5 * away * away;
#endif
  return vec3(rim.x, 1.0 - rim.x - rim.y, rim.y);
}

mat3 planeOf(vec3 x, vec3 y, float z) {
  x = x * z;
  return mat3(x * y.x, x * y.y, x * y.z);
}
#endif

// The weights for a position in the middle cell, 0 to 1.
Cells weightsAt(vec3 inside) {
  vec3 x = alongAxis(inside.x), y = alongAxis(inside.y), z = alongAxis(inside.z);
  return Cells(planeOf(x, y, z.x), planeOf(x, y, z.y), planeOf(x, y, z.z));
}

float totalOf(mat3 plane) {
  return dot(plane * vec3(1.0), vec3(1.0));
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
  uvec3 parity;
  Cells weights;
};

// The bits of children by their position along an axis; along z both words have the same.
const uvec4 ALONG_X = uvec4(0x00550055u, 0x00AA00AAu, 0x55005500u, 0xAA00AA00u);
const uvec4 ALONG_Y = uvec4(0x00003333u, 0x0000CCCCu, 0x33330000u, 0xCCCC0000u);
const uvec4 ALONG_Z = uvec4(0x0F0F0F0Fu, 0xF0F0F0F0u, 0x0F0F0F0Fu, 0xF0F0F0F0u);

uint joined(uvec4 masks) {
  return masks.x + masks.y * 0x100u + masks.z * 0x10000u + masks.w * 0x1000000u;
}

uvec2 masksOf(PerNode words) {
  return uvec2(joined(words.low & uvec4(255u)), joined(words.high & uvec4(255u)));
}

// Of four positions along an axis of a block, the three around the point.
uvec3 around(uvec4 along, uint parity) {
  return along.yzw + parity * (along.xyz - along.yzw);
}

// The children that lie in some of the three positions along each axis.
uvec2 crossing(uvec3 parity, bvec3 x, bvec3 y, bvec3 z) {
  uvec3 inX = around(ALONG_X, parity.x) * uvec3(x), inY = around(ALONG_Y, parity.y) * uvec3(y);
  uvec3 lowZ = around(uvec4(ALONG_Z.xy, 0u, 0u), parity.z) * uvec3(z), highZ = around(uvec4(0u, 0u, ALONG_Z.zw), parity.z) * uvec3(z);
  uint plane = (inX.x | inX.y | inX.z) & (inY.x | inY.y | inY.z);
  return uvec2(plane & (lowZ.x | lowZ.y | lowZ.z), plane & (highZ.x | highZ.y | highZ.z));
}

// Those of some children around the point that have a weight.
Taps tapsOf(Block block, Cells weights, uvec2 among) {
#ifdef NEAREST
  vec3 x = vec3(1.0), y = x, z = x;
#else
  mat3 all = weights.low + weights.middle + weights.high;
  vec3 x = all * vec3(1.0), y = vec3(1.0) * all, z = vec3(totalOf(weights.low), totalOf(weights.middle), totalOf(weights.high));
#endif
  const vec3 none = vec3(0.0);
  uvec2 seen = crossing(block.parity, greaterThan(x, none), greaterThan(y, none), greaterThan(z, none));
  PerNode cells = PerNode(block.first.low >> uvec4(8u), block.first.high >> uvec4(8u));
  return Taps(cells, masksOf(block.first) | masksOf(block.second), among & seen, block.parity, weights);
}

// The three places along an axis that have some of the bits.
vec3 isAt(uvec3 bits) {
  return vec3(notEqual(bits, uvec3(0u)));
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
  uvec2 bit = lowest * word;
  vec3 x = isAt(around(ALONG_X & uvec4(lowest), taps.parity.x)), y = isAt(around(ALONG_Y & uvec4(lowest), taps.parity.y));
  vec3 z = isAt(around(ALONG_Z & bit.xxyy, taps.parity.z));
  weight = dot(x, (z.x * taps.weights.low + z.y * taps.weights.middle + z.z * taps.weights.high) * y);
  taps.pending ^= bit;
  return bit;
}

// Add some of the cells around a point, with weights times a share.
void gather(Block block, Cells weights, float share, bool averages, uvec2 among) {
  Taps taps = tapsOf(block, weights, among);
  uint cell;
  float weight;
#ifdef NEAREST
  float least = FAR;
  uint nearest = 0u;
  while ((taps.pending.x | taps.pending.y) != 0u) {
    take(taps, cell, weight);
    if (weight < least) nearest = cell;
    least = min(weight, least);
  }
  if (least < FAR) addCell(nearest, nearest, share * averageWeight(nearest, averages));
#else
  uvec2 split = uvec2(0u);
  while ((taps.pending.x | taps.pending.y) != 0u) {
    uvec2 bit = take(taps, cell, weight);
    split |= bit * uint(addWhole(cell, weight * share, averages));
  }
#ifdef SPLIT
  taps.pending = split;
  while ((taps.pending.x | taps.pending.y) != 0u) {
    take(taps, cell, weight);
    addCell(cell, cell, weight * share * averageWeight(cell, averages));
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
    uvec2 every = masksOf(block.first) | masksOf(block.second);
    gather(block, weightsAt(inside), sampled == levels.x ? shares.x : shares.y, level < leaves, every);
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
// Leaves of several depths. The walk goes down to the first level without nodes around the point, where the spline's weights
// fall on the cells. Leaves take theirs. Cells without a node above them are refined from cells of the level above: their
// weights go up to those, and so on. See octex/field/walk_taps.py.
const int LEVELS = 24;
Block m_blocks[LEVELS];
#if defined(KEPT) || defined(LINEAR)
uvec2 m_below[LEVELS];  // the children of a block that are below kept nodes; of LINEAR, those below leaves
uvec2 m_kept[LEVELS];  // nodes with a kept coefficient
#endif
#if defined(KEPT) && !defined(LINEAR)
Cells m_cover[LEVELS];  // how much of a cell comes from cells that are read
#endif

// Chaikin's rule, transposed: from three cells along an axis to those that they are refined from; ODD is the difference of
// the rules for odd and for even parity.
const mat3 EVEN = mat3(0.75, 0.25, 0.0, 0.25, 0.75, 0.0, 0.0, 0.75, 0.25), ODD = mat3(-0.5, 0.5, 0.0, -0.25, 0.0, 0.25, 0.0, -0.5, 0.5);

// Transform cells along each axis.
Cells transformed(Cells cells, mat3 x, mat3 y, mat3 z) {
  mat3 across = transpose(y), low = x * cells.low * across, middle = x * cells.middle * across, high = x * cells.high * across;
  return Cells(z[0].x * low + z[1].x * middle + z[2].x * high, z[0].y * low + z[1].y * middle + z[2].y * high,
    z[0].z * low + z[1].z * middle + z[2].z * high);
}

mat3 timesPlane(mat3 a, mat3 b) {
  return mat3(a[0] * b[0], a[1] * b[1], a[2] * b[2]);
}

Cells times(Cells a, Cells b) {
  return Cells(timesPlane(a.low, b.low), timesPlane(a.middle, b.middle), timesPlane(a.high, b.high));
}

#ifdef LINEAR
mat3 overPlane(mat3 a, mat3 b) {
  const vec3 least = vec3(1e-6);
  return mat3(a[0] / max(b[0], least), a[1] / max(b[1], least), a[2] / max(b[2], least));
}

Cells over(Cells a, Cells b) {
  return Cells(overPlane(a.low, b.low), overPlane(a.middle, b.middle), overPlane(a.high, b.high));
}
#endif

Cells plus(Cells a, Cells b) {
  return Cells(a.low + b.low, a.middle + b.middle, a.high + b.high);
}

mat3 marksOf(uint bits, uvec3 x, uvec3 y) {
  return mat3(isAt(x & uvec3(y.x & bits)), isAt(x & uvec3(y.y & bits)), isAt(x & uvec3(y.z & bits)));
}

// 1 for some cells, 0 for the others.
Cells marks(uvec2 some, uvec3 parity) {
  uvec3 x = around(ALONG_X, parity.x), y = around(ALONG_Y, parity.y), z = around(ALONG_Z & some.xxyy, parity.z);
  return Cells(marksOf(z.x, x, y), marksOf(z.y, x, y), marksOf(z.z, x, y));
}

// The children of a block's nodes.
uvec2 childrenOf(Block block) {
  uvec4 low = (block.first.low | block.second.low) & uvec4(255u), high = (block.first.high | block.second.high) & uvec4(255u);
  return uvec2(joined(uvec4(notEqual(low, uvec4(0u))) * 255u), joined(uvec4(notEqual(high, uvec4(0u))) * 255u));
}

#if defined(KEPT) || defined(LINEAR)
// The children of a block whose parents are among some children of the block above.
uvec2 below(uvec2 some, uvec3 above, uvec3 parity) {
  uvec3 x = around(ALONG_X, above.x), y = around(ALONG_Y, above.y), z = around(ALONG_Z & some.xxyy, above.z);
  uvec2 twoX = x.xy + parity.x * (x.yz - x.xy), twoY = y.xy + parity.y * (y.yz - y.xy), twoZ = z.xy + parity.z * (z.yz - z.xy);
  uvec4 four = twoX.xyxy & twoY.xxyy, none = uvec4(0u);
  return uvec2(joined(uvec4(notEqual(four & twoZ.xxxx, none)) * 255u), joined(uvec4(notEqual(four & twoZ.yyyy, none)) * 255u));
}

// How much of a cell comes from cells that are read, by refinement from the level above.
Cells refinedCover(int level) {
  vec3 odd = vec3(m_blocks[level].parity);
#ifdef LINEAR
  Block above = m_blocks[level - 1];
  Cells cover = marks(masksOf(above.second) | m_kept[level - 1] | m_below[level - 1], above.parity);
#else
  Cells cover = m_cover[level - 1];
#endif
  return transformed(cover, transpose(EVEN + odd.x * ODD), transpose(EVEN + odd.y * ODD), transpose(EVEN + odd.z * ODD));
}

// Find what later levels need to know of a level.
void noteLevel(int level) {
  Block block = m_blocks[level];
  uvec2 nodes = masksOf(block.first), leaves = masksOf(block.second);
  m_kept[level] = m_below[level] = uvec2(0u);
#ifdef KEPT
  const vec3 one = vec3(1.0);
  const mat3 ones = mat3(one, one, one);
  Taps taps = tapsOf(block, Cells(ones, ones, ones), nodes * uint(level >= u_keptLevel && u_kept.y > 0u));
  uint cell;
  float weight;
  while ((taps.pending.x | taps.pending.y) != 0u) {
    uvec2 bit = take(taps, cell, weight);
    g_fetches++;
    m_kept[level] |= bit * uint((FLAGS_AT(texelOf(cell)) & 64u) != 0u);
  }
#endif
#ifdef LINEAR
  if (level > 0) m_below[level] = below(masksOf(m_blocks[level - 1].second) | m_below[level - 1], m_blocks[level - 1].parity, block.parity);
#else
  if (level > 0) m_below[level] = below(m_kept[level - 1], m_blocks[level - 1].parity, block.parity);
  m_cover[level] = marks((leaves | m_kept[level]) & ~m_below[level], block.parity);
  if (level > 0) {
    uvec2 refined = ~childrenOf(block) | m_below[level] & ~(nodes & ~m_kept[level]);
    m_cover[level] = plus(m_cover[level], times(refinedCover(level), marks(refined, block.parity)));
  }
#endif
}
#endif

// Add the cells around a point down to a level, whose nodes are read too.
void addMixedDepths(vec3 point, int last, float share, bool averages) {
  uvec3 place = fixedAt(point);
  Block block = blockOf(aboveRoot(), place, uint(FINEST));
  const bvec3 everywhere = bvec3(true);
  const uvec2 none = uvec2(0u);
  int level = 0, first = LEVELS;  // the first level with cells that are read
  bool goesOn = true;
  while (goesOn) {
    m_blocks[level] = block;
    uvec2 seen = crossing(block.parity, everywhere, everywhere, everywhere), own = masksOf(block.second);
#if defined(KEPT) || defined(LINEAR)
    noteLevel(level);
    own |= m_kept[level];
#endif
    if (any(notEqual(own & seen, none))) first = min(first, level);
    goesOn = level < last && any(notEqual(masksOf(block.first) & seen, none));
    if (goesOn) goDown(block, place, uvec3(uint(FINEST)));
    level += int(goesOn);
  }
  Cells weights = weightsAt(point * float(1 << uint(level)) - vec3(cellOf(place, level)));
  goesOn = true;
  while (goesOn) {
    block = m_blocks[level];
    uvec2 nodes = masksOf(block.first), own = masksOf(block.second) | nodes * uint(level == last), refined = ~childrenOf(block);
    Cells shares = weights;
#if defined(KEPT) && !defined(LINEAR)
    refined |= m_below[level] & ~(masksOf(block.first) | masksOf(block.second));
    shares = times(shares, plus(marks(~m_below[level], block.parity), times(refinedCover(level), marks(m_below[level], block.parity))));
#endif
    gather(block, shares, share, averages, own);
#ifdef KEPT
    Taps taps = tapsOf(block, shares, m_kept[level] & ~own);
    uint cell;
    float weight;
    while ((taps.pending.x | taps.pending.y) != 0u) {
      take(taps, cell, weight);
      addCell(cell, u_kept.z + tableRow(cell, u_kept.x, u_kept.y), weight * share);
    }
#endif
#ifdef LINEAR
    refined = m_below[level];
    if (level > 0) weights = over(weights, refinedCover(level));
#endif
    weights = times(weights, marks(refined, block.parity));
    goesOn = level > first && totalOf(weights.low + weights.middle + weights.high) > 0.0;
    if (goesOn) {
      vec3 odd = vec3(block.parity);
      weights = transformed(weights, EVEN + odd.x * ODD, EVEN + odd.y * ODD, EVEN + odd.z * ODD);
      level--;
    }
  }
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
    addCell(cell.x, cell.x, shares[n] * averageWeight(cell.x, averages && cell.z == 1u));
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
