// The octree of a page: words of nodes, and planes with the values of cells. Levels are appended as they load. The tree is
// laid out as in octex/tree/layout.py, streams as in octex/formats/web.py.

export const ROW = 4096; // texels in a row of the textures

export async function inflate(blob) {
  return new Uint8Array(await new Response(blob.stream().pipeThrough(new DecompressionStream("deflate-raw"))).arrayBuffer());
}

export const BIT_COUNTS = new Uint8Array(256).map((_, n) => n.toString(2).replaceAll("0", "").length);

// Read integers that are stored as planes of bytes, the lowest byte first.
export function fromBytePlanes(bytes, count, offset) {
  const numbers = new Uint32Array(count);
  for (let n = 0; n < count; n++) {
    for (let place = 3; place >= 0; place--) numbers[n] = (numbers[n] << 8) | bytes[offset + place * count + n];
  }
  return numbers;
}

const rowsFor = (count) => Math.max(Math.ceil(count / ROW), 1);

export const GROWTH = 1 / 8; // spare room of an array or a texture that has grown, as a share of its size

// Return an array of another length with the same first elements; it shares the buffer if that is long enough.
function resized(array, length) {
  const Type = array.constructor, { buffer } = array;
  if (length * Type.BYTES_PER_ELEMENT <= buffer.byteLength) return new Type(buffer, 0, length);
  const larger = new Type(Math.ceil(length * (1 + GROWTH)));
  larger.set(array);
  return larger.subarray(0, length);
}

export class Octree {
  constructor(header) {
    this.depth = -1; // the deepest loaded level
    this.words = new Uint32Array(); // two a node: first child cell and node mask, first child node and leaf mask
    this.planes = header.planes.map(() => new Uint8Array()); // four bytes a row
    this.owners = new Uint32Array(); // the cell number of each node
    this.entries = new Uint32Array(); // two a kept node or split cell: its cell and its row, as u_entries has them
    this.tables = { kept: 0, split: 0 }; // loaded entries
    this.nextNode = 1;
    this.nextCell = 1;
    this.resize(header);
  }

  // Make room for the sizes in a header; the content stays.
  resize(header) {
    const { kept, split } = header;
    this.header = header;
    this.cells = header.levelCells;
    this.nodes = header.levelNodes;
    const nNodes = this.nodes.at(-1), nRows = this.cells.at(-1) + kept + split[1];
    this.words = resized(this.words, 2 * ROW * rowsFor(nNodes));
    this.planes = this.planes.map((plane) => resized(plane, 4 * ROW * rowsFor(nRows)));
    this.owners = resized(this.owners, nNodes);
    this.entries = resized(this.entries, 2 * ROW * rowsFor(kept + split[0]));
  }

  // Move channels to their places in a new header. `bytes` has the values of channels that the old header lacks.
  relayout(header, bytes) {
    const { area, flags, channels } = this.header, oldPlanes = this.planes, rows = this.cells.at(-1) + header.kept + header.split[1];
    this.planes = header.planes.map(() => new Uint8Array(oldPlanes[0].length));
    let at = 0;
    const fill = ([plane, slot], old, components = 1) => {
      for (let k = 0; k < components; k++) {
        const values = this.planes[plane], codes = old ? oldPlanes[old[0]] : bytes.subarray(at, (at += rows)), [first, step] = old ? [old[1] + k, 4] : [0, 1];
        for (let n = 0; n < rows; n++) values[4 * n + slot + k] = codes[first + step * n];
      }
    };
    fill(header.area, area);
    fill(header.flags, flags);
    for (const channel of header.channels) fill(channel.at, channels.find(({ name }) => name === channel.name)?.at, channel.components);
    if (at !== bytes.length) throw new Error("the change's data is damaged");
  }

  // Load a chunk: some levels, or the rows of kept nodes and split cells. Returns the ranges of nodes, cells and entries
  // that are new.
  readChunk(chunk, bytes) {
    return chunk.levels ? this.readLevels(chunk.levels, bytes) : this.readTables(bytes);
  }

  readLevels([begin, end], bytes) {
    const reader = { bytes, at: 0 }, firstCell = this.cells[begin], firstNode = this.nodes[Math.max(begin - 1, 0)];
    for (let level = begin; level < end; level++) this.readLevel(level, reader);
    if (reader.at !== bytes.length) throw new Error("the texture's data is damaged");
    this.depth = end - 1;
    return { nodes: [firstNode, this.depth > 0 ? this.nodes[this.depth] : 0], cells: [firstCell, this.cells[end]], entries: [0, 0] };
  }

  readTables(bytes) {
    const { kept, split, channels } = this.header, count = kept + split[0], nCells = this.cells.at(-1);
    const nRows = kept + split[1], owners = new Uint32Array(nRows);
    const steps = fromBytePlanes(bytes, count, 0), facings = bytes.subarray(4 * count, 4 * count + split[0]);
    let cell = 0, row = 0;
    for (let n = 0; n < count; n++) {
      cell = steps[n] + (n === kept ? 0 : cell);
      this.entries.set([cell, n < kept ? n : row - kept], 2 * n);
      const rows = n < kept ? 1 : BIT_COUNTS[facings[n - kept] & 63];
      owners.fill(cell, row, (row += rows));
    }
    let at = 4 * count + split[0];
    for (const { at: [plane, slot], components } of channels) {
      const values = this.planes[plane];
      for (let k = 0; k < components; k++, at += nRows) {
        for (let n = 0; n < nRows; n++) {
          values[4 * (nCells + n) + slot + k] = (bytes[at + n] + values[4 * owners[n] + slot + k]) & 255;
        }
      }
    }
    this.tables = { kept, split: split[0] };
    return { nodes: [0, 0], cells: [nCells, nCells + nRows], entries: [0, count] };
  }

  // Copy the rows of ranges, for `setRows` of another octree with the same header.
  copyRows({ nodes, cells, entries }) {
    const { depth, tables } = this;
    return {
      nodes, cells, entries, depth, tables, words: this.words.slice(2 * nodes[0], 2 * nodes[1]),
      planes: this.planes.map((plane) => plane.slice(4 * cells[0], 4 * cells[1])), pairs: this.entries.slice(2 * entries[0], 2 * entries[1]),
    };
  }

  setRows({ nodes, cells, entries, depth, tables, words, planes, pairs }) {
    this.words.set(words, 2 * nodes[0]);
    this.planes.forEach((plane, n) => plane.set(planes[n], 4 * cells[0]));
    this.entries.set(pairs, 2 * entries[0]);
    Object.assign(this, { depth, tables });
  }

  readLevel(level, reader) {
    const first = this.cells[level], count = this.cells[level + 1] - first;
    const parents = new Uint32Array(count), isNode = new Uint8Array(count);
    if (level > 0) this.readMasks(level, reader, first, parents, isNode);
    else isNode[0] = this.nodes.at(-1) > 0 ? 1 : 0;
    const next = (length) => reader.bytes.subarray(reader.at, (reader.at += length));
    const firstNode = this.nodes[level], nNodes = isNode.reduce((sum, is) => sum + is, 0);
    const put = ([plane, slot], codes, cellOf, join) => {
      const values = this.planes[plane];
      for (let n = 0; n < codes.length; n++) {
        const cell = cellOf(n);
        values[4 * cell + slot] = join(codes[n], values[4 * parents[cell - first] + slot]); // the root is its own parent: 0
      }
    };
    put(this.header.area, next(nNodes), (n) => this.owners[firstNode + n], (a, b) => (a + b) & 255);
    put(this.header.flags, next(count), (n) => first + n, (a, b) => a ^ b);
    for (const channel of this.header.channels) this.readValues(channel, first, count, parents, next);
  }

  readMasks(level, reader, first, parents, isNode) {
    const begin = this.nodes[level - 1], end = this.nodes[level];
    const masks = reader.bytes, nodeMasks = reader.at, leafMasks = reader.at + end - begin;
    reader.at += 2 * (end - begin);
    for (let node = begin; node < end; node++) {
      const nodes = masks[nodeMasks + node - begin], leaves = masks[leafMasks + node - begin];
      this.words[2 * node] = (this.nextCell << 8) | nodes;
      this.words[2 * node + 1] = (this.nextNode << 8) | leaves;
      for (let octant = 0, all = nodes | leaves; octant < 8; octant++) {
        if (!((all >> octant) & 1)) continue;
        const cell = this.nextCell++;
        parents[cell - first] = this.owners[node];
        if ((nodes >> octant) & 1) {
          isNode[cell - first] = 1;
          this.owners[this.nextNode++] = cell;
        }
      }
    }
  }

  // Read a channel of a level: differences from the parent's value; of colours, red and blue minus green.
  readValues(channel, first, count, parents, next) {
    const [plane, slot] = channel.at, values = this.planes[plane], width = channel.components;
    const columns = Array.from({ length: width }, () => next(count));
    for (let n = 0; n < count; n++) {
      const at = 4 * (first + n) + slot, from = 4 * parents[n] + slot;
      if (width === 3) {
        const r = values[from], g = values[from + 1], b = values[from + 2], green = (columns[1][n] + g) & 255;
        values[at] = (columns[0][n] + r - g + green) & 255;
        values[at + 1] = green;
        values[at + 2] = (columns[2][n] + b - g + green) & 255;
      } else {
        for (let k = 0; k < width; k++) values[at + k] = (columns[k][n] + values[from + k]) & 255;
      }
    }
  }

  // Find the cell at a point of the root cell (0 … 1): a leaf, or a node of level `depth`.
  cellAt(point, depth = this.depth) {
    const place = point.map((x) => Math.min(Math.max(Math.floor(x * 2 ** 21), 0), 2 ** 21 - 1));
    let cell = 0, node = 0, level = 0;
    while (level < depth && node < this.nodes.at(-1)) {
      const first = this.words[2 * node], second = this.words[2 * node + 1];
      const shift = 20 - level;
      const octant = ((place[0] >> shift) & 1) | (((place[1] >> shift) & 1) << 1) | (((place[2] >> shift) & 1) << 2);
      const all = (first | second) & 255, below = (1 << octant) - 1;
      if (!((all >> octant) & 1)) break;
      cell = (first >>> 8) + BIT_COUNTS[all & below];
      level++;
      if (!((first >> octant) & 1)) break;
      node = (second >>> 8) + BIT_COUNTS[first & below];
    }
    return { cell, level, index: place.map((x) => x >> (21 - level)), edge: 2 ** -level };
  }

  // The stored codes of a cell's channel.
  codes(channel, cell) {
    const [plane, slot] = channel.at;
    return Array.from(this.planes[plane].subarray(4 * cell + slot, 4 * cell + slot + channel.components));
  }

  // The deepest level whose cells fit into textures of so many rows.
  deepestIn(rows) {
    let level = this.header.depth;
    while (level > 0 && this.cells[level + 1] > rows * ROW) level--;
    return level;
  }

  // Count the leaves of each level down to a last one, whose nodes count as leaves.
  leafCounts(level) {
    const { cells, nodes } = this, last = Math.min(level, this.depth);
    return Array.from({ length: last + 1 }, (_, k) => cells[k + 1] - cells[k] - (k < last ? nodes[k + 1] - nodes[k] : 0));
  }

  cubeCount(level) {
    return this.leafCounts(level).reduce((sum, leaves) => sum + leaves, 0);
  }

  // The x, y, z, level and number of the cells of a level, and of the leaves above it.
  cubes(level) {
    const cells = new Uint32Array(5 * this.cubeCount(level));
    let positions = new Uint32Array(3); // of the nodes one level up; where the root is a leaf, all numbers stay 0
    for (let depth = 1, node = 0, end = 0; depth <= level; depth++) {
      const next = new Uint32Array(3 * (this.nodes[depth + 1] - this.nodes[depth]));
      for (let n = 0, at = 0; n < positions.length && node < this.nodes.at(-1); n += 3, node++) {
        const nodes = this.words[2 * node], all = (nodes | this.words[2 * node + 1]) & 255;
        for (let octant = 0, number = nodes >>> 8; octant < 8; octant++) {
          if (!((all >> octant) & 1)) continue;
          const isNode = (nodes >> octant) & 1;
          const isCube = depth === level || !isNode;
          for (let axis = 0; axis < 3; axis++) {
            const position = 2 * positions[n + axis] + ((octant >> axis) & 1);
            if (isNode) next[at++] = position;
            if (isCube) cells[end++] = position;
          }
          if (isCube) {
            cells[end++] = depth;
            cells[end++] = number;
          }
          number++;
        }
      }
      positions = next;
    }
    return cells;
  }
}
