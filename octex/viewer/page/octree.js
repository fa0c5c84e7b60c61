// The octree as it arrives, level by level: words for nodes and planes of values for cells. See pack.py.

export const ROW = 4096;
const PIECE = 2048; // nodes whose cells become cubes at a time

export async function inflated(stream) {
  const unpacked = stream.pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(unpacked).arrayBuffer());
}

export const bitsSet = new Uint8Array(256).map((_, n) => n.toString(2).replaceAll("0", "").length);

// Whole numbers from planes of their bytes.
export function planes(bytes, count, at) {
  const numbers = new Uint32Array(count);
  for (let n = 0; n < count; n++) {
    for (let place = 3; place >= 0; place--) numbers[n] = (numbers[n] << 8) | bytes[at + place * count + n];
  }
  return numbers;
}

const rowsFor = (count) => Math.max(Math.ceil(count / ROW), 1);

export const MORE = 1 / 8; // of an array or a texture that has grown: the room behind it for more

// An array of another length that begins with the same numbers; where its buffer has room, the buffer is the same.
function resized(array, length) {
  const Type = array.constructor, { buffer } = array;
  if (length * Type.BYTES_PER_ELEMENT <= buffer.byteLength) return new Type(buffer, 0, length);
  const made = new Type(Math.ceil(length * (1 + MORE)));
  made.set(array);
  return made.subarray(0, length);
}

export class Octree {
  constructor(header) {
    this.depth = -1; // the deepest level that has arrived
    this.words = new Uint32Array();
    this.planes = header.planes.map(() => new Uint8Array());
    this.owners = new Uint32Array(); // the cell that each node is
    this.entries = new Uint32Array(); // see u_entries
    this.tables = { kept: 0, split: 0 }; // entries that have arrived
    this.nextNode = 1;
    this.nextCell = 1;
    this.resize(header);
  }

  // Have room for what a header says; what is there stays.
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

  // Take the places that values of channels have now. Those of channels that it had stay; of others `bytes` are the values.
  relayout(header, bytes) {
    const { area, flags, channels } = this.header, was = this.planes, rows = this.cells.at(-1) + header.kept + header.split[1];
    this.planes = header.planes.map(() => new Uint8Array(was[0].length));
    let at = 0;
    const take = ([plane, slot], from, components = 1) => {
      for (let k = 0; k < components; k++) {
        const to = this.planes[plane], codes = from ? was[from[0]] : bytes.subarray(at, (at += rows)), [first, step] = from ? [from[1] + k, 4] : [0, 1];
        for (let n = 0; n < rows; n++) to[4 * n + slot + k] = codes[first + step * n];
      }
    };
    take(header.area, area);
    take(header.flags, flags);
    for (const channel of header.channels) take(channel.at, channels.find(({ name }) => name === channel.name)?.at, channel.components);
    if (at !== bytes.length) throw new Error("the change's data is damaged");
  }

  // Take a chunk of levels; returns the rows of nodes and of cells that are new.
  take(chunk, bytes) {
    const reader = { bytes, at: 0 };
    const firstCell = this.cells[chunk.levels[0]], firstNode = this.nodes[Math.max(chunk.levels[0] - 1, 0)];
    for (let level = chunk.levels[0]; level < chunk.levels[1]; level++) this.takeLevel(level, reader);
    if (reader.at !== bytes.length) throw new Error("the texture's data is damaged");
    this.depth = chunk.levels[1] - 1;
    const end = this.depth > 0 ? this.nodes[this.depth] : 0;
    return { nodes: [firstNode, end], cells: [firstCell, this.cells[this.depth + 1]] };
  }

  // Take the rows of kept nodes and of split cells; returns what is new.
  takeTables(bytes) {
    const { kept, split, channels } = this.header, count = kept + split[0], nCells = this.cells.at(-1);
    const nRows = kept + split[1], owners = new Uint32Array(nRows);
    const steps = planes(bytes, count, 0), facings = bytes.subarray(4 * count, 4 * count + split[0]);
    let cell = 0, row = 0;
    for (let n = 0; n < count; n++) {
      cell = steps[n] + (n === kept ? 0 : cell);
      this.entries.set([cell, n < kept ? n : row - kept], 2 * n);
      const rows = n < kept ? 1 : bitsSet[facings[n - kept] & 63];
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

  // What `take` or `takeTables` has filled in, for another octree of the same header.
  rows({ nodes, cells, entries = [0, 0] }) {
    const { depth, tables } = this;
    return {
      nodes, cells, entries, depth, tables, words: this.words.slice(2 * nodes[0], 2 * nodes[1]),
      planes: this.planes.map((plane) => plane.slice(4 * cells[0], 4 * cells[1])), found: this.entries.slice(2 * entries[0], 2 * entries[1]),
    };
  }

  takeRows({ nodes, cells, entries, depth, tables, words, planes, found }) {
    this.words.set(words, 2 * nodes[0]);
    this.planes.forEach((plane, n) => plane.set(planes[n], 4 * cells[0]));
    this.entries.set(found, 2 * entries[0]);
    Object.assign(this, { depth, tables });
  }

  takeLevel(level, reader) {
    const first = this.cells[level], count = this.cells[level + 1] - first;
    const parents = new Uint32Array(count), isNode = new Uint8Array(count);
    if (level > 0) this.takeMasks(level, reader, first, parents, isNode);
    else isNode[0] = this.nodes.at(-1) > 0 ? 1 : 0;
    const next = (length) => reader.bytes.subarray(reader.at, (reader.at += length));
    let nNodes = 0;
    for (let n = 0; n < count; n++) nNodes += isNode[n];
    const known = level > 0 ? 1 : 0;
    const put = ([plane, slot], codes, cellOf, join) => {
      const values = this.planes[plane];
      for (let n = 0; n < codes.length; n++) {
        const cell = cellOf(n);
        const before = known ? values[4 * parents[cell - first] + slot] : 0;
        values[4 * cell + slot] = join(codes[n], before);
      }
    };
    const sum = (a, b) => (a + b) & 255;
    const ownNodes = this.nodes[level];
    put(this.header.area, next(nNodes), (n) => this.owners[ownNodes + n], sum);
    put(this.header.flags, next(count), (n) => first + n, (a, b) => a ^ b);
    for (const channel of this.header.channels) this.takeValues(channel, first, count, known, parents, next);
  }

  takeMasks(level, reader, first, parents, isNode) {
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

  takeValues(channel, first, count, known, parents, next) {
    const [plane, slot] = channel.at, values = this.planes[plane], width = channel.components;
    const parts = Array.from({ length: width }, () => next(count));
    for (let n = 0; n < count; n++) {
      const at = 4 * (first + n) + slot, from = 4 * parents[n] + slot;
      if (width === 3) {
        const [r, g, b] = known ? [values[from], values[from + 1], values[from + 2]] : [0, 0, 0];
        const green = (parts[1][n] + g) & 255;
        values[at] = (parts[0][n] + r - g + green) & 255;
        values[at + 1] = green;
        values[at + 2] = (parts[2][n] + b - g + green) & 255;
      } else {
        for (let k = 0; k < width; k++) values[at + k] = (parts[k][n] + (known ? values[from + k] : 0)) & 255;
      }
    }
  }

  // The cell at a point of the root cell: the leaf that holds it, or the deepest cell above `depth`.
  cellAt(point, depth = this.depth) {
    const place = point.map((x) => Math.min(Math.max(Math.floor(x * 2 ** 21), 0), 2 ** 21 - 1));
    let cell = 0, node = 0, level = 0;
    while (level < depth && node < this.nodes.at(-1)) {
      const first = this.words[2 * node], second = this.words[2 * node + 1];
      const shift = 20 - level;
      const octant = ((place[0] >> shift) & 1) | (((place[1] >> shift) & 1) << 1) | (((place[2] >> shift) & 1) << 2);
      const all = (first | second) & 255, below = (1 << octant) - 1;
      if (!((all >> octant) & 1)) break;
      cell = (first >>> 8) + bitsSet[all & below];
      level++;
      if (!((first >> octant) & 1)) break;
      node = (second >>> 8) + bitsSet[first & below];
    }
    return { cell, level, index: place.map((x) => x >> (21 - level)), edge: 2 ** -level };
  }

  // Stored codes of a cell's channel.
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

  // Of each level up to one how many cells are leaves, or are taken for such at the last.
  leavesTo(level) {
    const { cells, nodes } = this, last = Math.min(level, this.depth);
    return Array.from({ length: last + 1 }, (_, k) => cells[k + 1] - cells[k] - (k < last ? nodes[k + 1] - nodes[k] : 0));
  }

  countAt(level) {
    return this.leavesTo(level).reduce((sum, leaves) => sum + leaves, 0);
  }

  // Fill in the cells of a level and the leaves above it: x, y, z, level and number of each. Yields how many there
  // are, piece by piece.
  *cubes(level, found) {
    let count = 0, here = new Uint32Array(3);
    const put = (...cell) => found.set(cell, 5 * count++);
    if (level === 0 || this.nodes.at(-1) === 0) put(0, 0, 0, 0, 0);
    for (let depth = 1, node = 0; depth <= level; depth++) {
      const next = new Uint32Array(3 * (this.nodes[depth + 1] - this.nodes[depth]));
      for (let n = 0, at = 0; n < here.length && node < this.nodes.at(-1); n += 3, node++) {
        const nodes = this.words[2 * node], all = (nodes | this.words[2 * node + 1]) & 255;
        for (let octant = 0, number = nodes >>> 8; octant < 8; octant++) {
          if (!((all >> octant) & 1)) continue;
          const place = [0, 1, 2].map((axis) => 2 * here[n + axis] + ((octant >> axis) & 1));
          if ((nodes >> octant) & 1) next.set(place, 3 * at++);
          if (depth === level || !((nodes >> octant) & 1)) put(...place, depth, number);
          number++;
        }
        if (node % PIECE === 0) yield count;
      }
      here = next;
    }
    yield count;
  }
}
