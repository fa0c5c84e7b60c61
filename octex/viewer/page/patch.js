// An octree as it has changed: made of the one before and of the cells that are new. See changes.py.

import { Octree, bitsSet, planes } from "./octree.js";

const KEPT = 64, SPLIT = 128;

// The octree that `header` is of. `counts` are the entries of the change's stream, whose bytes these are.
export function patched(before, header, counts, bytes) {
  const after = new Octree(header), nCells = after.cells.at(-1), { channels, flags } = header;
  const [gaps, begins, lengths] = [0, 1, 2].map((n) => planes(bytes, counts.runs, 4 * n * counts.runs));
  let at = 12 * counts.runs;
  const next = (length) => bytes.subarray(at, (at += length));
  const stored = [header.area, flags, ...channels.flatMap(({ at: [plane, slot], components }) =>
    Array.from({ length: components }, (_, k) => [plane, slot + k]))];
  const masks = [next(counts.cells), next(counts.cells)];
  const own = stored.map(([plane, slot]) => ({ codes: next(counts.cells), values: after.planes[plane], slot }));
  const rows = counts.kept + counts.sides;
  const ownRows = stored.slice(2).map(([plane, slot]) => ({ codes: next(rows), values: after.planes[plane], slot }));
  if (at !== bytes.length) throw new Error("the change's data is damaged");

  const words = (array) => new Uint32Array(array.buffer);
  const was = before.planes.map(words), now = after.planes.map(words);
  const copy = (row, old, count) => now.forEach((plane, n) => plane.set(was[n].subarray(old, old + count), row));
  const put = (columns, row, n) => columns.forEach(({ codes, values, slot }) => (values[4 * row + slot] = codes[n]));
  const { kept } = header, oldRows = before.cells.at(-1), oldKeptRows = before.header.kept, oldNodes = before.nodes.at(-1);
  let node = 0, keptRow = 0, splitCell = 0, splitRow = 0, freshKept = 0, freshSide = counts.kept;
  const putNode = (cell, nodes, leaves) => {
    after.words[2 * node] = (after.nextCell << 8) | nodes;
    after.words[2 * node + 1] = (after.nextNode << 8) | leaves;
    after.owners[node++] = cell;
    after.nextCell += bitsSet[nodes | leaves];
    after.nextNode += bitsSet[nodes];
  };
  const putKept = (cell) => after.entries.set([cell, keptRow], 2 * keptRow++);
  const putSplit = (cell, sides) => {
    after.entries.set([cell, splitRow], 2 * (kept + splitCell++));
    splitRow += sides;
  };
  // A cell that is new.
  const add = (cell, n) => {
    put(own, cell, n);
    const [nodes, leaves, flag] = [masks[0][n], masks[1][n], own[1].codes[n]];
    if (nodes | leaves || (cell === 0 && after.nodes.at(-1) > 0)) putNode(cell, nodes, leaves);
    if (flag & KEPT && keptRow < kept) {
      put(ownRows, nCells + keptRow, freshKept++);
      putKept(cell);
    }
    if (flag & SPLIT && splitCell < header.split[0]) {
      const sides = bitsSet[flag & 63];
      for (let side = 0; side < sides; side++) put(ownRows, nCells + kept + splitRow + side, freshSide++);
      putSplit(cell, sides);
    }
  };
  // A run of cells that are as they were, with what they have in the tables.
  let oldNode = 0, oldKept = 0, oldSplit = 0;
  const keptCell = (n) => before.entries[2 * n], splitEntry = (n) => 2 * (oldKeptRows + n);
  const keep = (cell, old, count) => {
    copy(cell, old, count);
    const shift = cell - old, end = old + count;
    oldNode = firstFrom(old, oldNode, oldNodes, (n) => before.owners[n]);
    for (; oldNode < oldNodes && before.owners[oldNode] < end; oldNode++) {
      putNode(before.owners[oldNode] + shift, before.words[2 * oldNode] & 255, before.words[2 * oldNode + 1] & 255);
    }
    oldKept = firstFrom(old, oldKept, oldKeptRows, keptCell);
    for (; oldKept < oldKeptRows && keptCell(oldKept) < end; oldKept++) {
      copy(nCells + keptRow, oldRows + before.entries[2 * oldKept + 1], 1);
      putKept(keptCell(oldKept) + shift);
    }
    oldSplit = firstFrom(old, oldSplit, before.header.split[0], (n) => before.entries[splitEntry(n)]);
    for (; oldSplit < before.header.split[0] && before.entries[splitEntry(oldSplit)] < end; oldSplit++) {
      const own = before.entries[splitEntry(oldSplit)] + shift, [plane, slot] = flags, sides = bitsSet[after.planes[plane][4 * own + slot] & 63];
      copy(nCells + kept + splitRow, oldRows + oldKeptRows + before.entries[splitEntry(oldSplit) + 1], sides);
      putSplit(own, sides);
    }
  };
  let cell = 0, fresh = 0;
  for (let run = 0; run < counts.runs; run++) {
    for (const end = cell + gaps[run]; cell < end; cell++) add(cell, fresh++);
    keep(cell, begins[run], lengths[run]);
    cell += lengths[run];
  }
  for (; cell < nCells; cell++) add(cell, fresh++);
  after.depth = header.depth;
  after.tables = { kept, split: header.split[0] };
  return after;
}

// The first of ascending numbers, from one on, that is not below a bound.
function firstFrom(bound, begin, end, at) {
  while (begin < end) {
    const middle = (begin + end) >> 1;
    if (at(middle) < bound) begin = middle + 1;
    else end = middle;
  }
  return begin;
}
