// An octree is changed in place: what stands where it stood is not touched. See changes.py.

import { ROW, bitsSet, planes } from "./octree.js";

const KEPT = 64, SPLIT = 128;

// Change an octree to the one that `header` is of. `counts` are the entries of the change's stream, whose bytes these
// are. Returns which rows of nodes, entries and cells differ, a mark for each.
export function patch(octree, header, counts, bytes) {
  const { channels, flags, kept, split } = header, nCells = header.levelCells.at(-1), nNodes = header.levelNodes.at(-1);
  const oldCells = octree.cells.at(-1), oldNodes = octree.nodes.at(-1), { kept: oldKept, split: [oldSplit, oldSides] } = octree.header;
  const [gaps, begins, lengths] = [0, 1, 2].map((n) => planes(bytes, counts.runs, 4 * n * counts.runs));
  const stored = [header.area, flags, ...channels.flatMap(({ at: [plane, slot], components }) =>
    Array.from({ length: components }, (_, k) => [plane, slot + k]))];
  const rows = counts.kept + counts.sides;
  if (12 * counts.runs + (2 + stored.length) * counts.cells + (stored.length - 2) * rows !== bytes.length) {
    throw new Error("the change's data is damaged");
  }
  let first = 0; // the first cell that may stand elsewhere now
  for (let run = 0; run < counts.runs && begins[run] === first + gaps[run]; run++) first = begins[run] + lengths[run];
  first = Math.min(first, oldCells);
  const all = (array) => new Uint32Array(array.buffer); // with the room behind it
  const was = octree.planes.map((plane) => all(plane).slice(first, oldCells + oldKept + oldSides));
  const wasEntries = octree.entries.slice(0, 2 * (oldKept + oldSplit));
  octree.resize(header);
  const words = all(octree.words), owners = all(octree.owners), entries = all(octree.entries), now = octree.planes.map(all);
  const dirty = { nodes: marks(octree.words, 2), entries: marks(octree.entries, 2), cells: marks(octree.planes[0], 4) };

  let at = 12 * counts.runs;
  const next = (length) => bytes.subarray(at, (at += length));
  const masks = [next(counts.cells), next(counts.cells)];
  const columns = (places, count) => places.map(([plane, slot]) => ({ codes: next(count), values: octree.planes[plane], slot }));
  const own = columns(stored, counts.cells), ownRows = columns(stored.slice(2), rows);
  const put = (columns, row, n) => {
    for (const plane of now) plane[row] = 0;
    for (const { codes, values, slot } of columns) values[4 * row + slot] = codes[n];
    dirty.cells[Math.floor(row / ROW)] = 1;
  };
  const copy = (row, old, count) => {
    if (row === old || !count) return;
    now.forEach((plane, n) => plane.set(was[n].subarray(old - first, old - first + count), row));
    mark(dirty.cells, row, count);
  };

  // Nodes are as they were until one has another number, or its children have: from then on they are read from a copy.
  let node = 0, nextCell = 1, nextNode = 1, oldNode = 0, oldWords = words, oldOwners = owners, base = 0, isCopied = false;
  const readAhead = (cell) => {
    if (isCopied || (cell < first && node < oldNodes && owners[node] === cell && words[2 * node] >>> 8 === nextCell && words[2 * node + 1] >>> 8 === nextNode)) return;
    [isCopied, base] = [true, Math.min(node, oldNodes)];
    oldWords = words.slice(2 * base, 2 * oldNodes);
    oldOwners = owners.slice(base, oldNodes);
  };
  const passNode = () => {
    const [nodes, leaves] = [words[2 * node - 2], words[2 * node - 1]];
    nextCell = (nodes >>> 8) + bitsSet[(nodes | leaves) & 255];
    nextNode = (leaves >>> 8) + bitsSet[nodes & 255];
  };
  const addNode = (cell, nodes, leaves) => {
    readAhead(cell);
    mark(dirty.nodes, node, 1);
    owners[node] = cell;
    words[2 * node] = (nextCell << 8) | nodes;
    words[2 * node + 1] = (nextNode << 8) | leaves;
    node++;
    passNode();
  };
  const keepNodes = (cell, old, count) => {
    const begin = firstFrom(old, Math.max(oldNode, base), oldNodes, (n) => oldOwners[n - base]);
    oldNode = firstFrom(old + count, begin, oldNodes, (n) => oldOwners[n - base]);
    if (begin === oldNode) return;
    readAhead(oldOwners[begin - base] + cell - old);
    if (!isCopied) node = oldNode;
    else {
      const moves = [nextCell, nextNode].map((next, k) => (next - (oldWords[2 * (begin - base) + k] >>> 8)) << 8);
      mark(dirty.nodes, node, oldNode - begin);
      for (let n = begin - base; n < oldNode - base; n++, node++) {
        owners[node] = oldOwners[n] + cell - old;
        words[2 * node] = oldWords[2 * n] + moves[0];
        words[2 * node + 1] = oldWords[2 * n + 1] + moves[1];
      }
    }
    passNode();
  };

  // Entries of kept nodes and of split cells.
  let keptRow = 0, splitCell = 0, splitRow = 0, oldKeptRow = 0, oldSplitCell = 0, freshKept = 0, freshSide = counts.kept;
  const putEntry = (n, cell, row) => {
    entries[2 * n] = cell;
    entries[2 * n + 1] = row;
    mark(dirty.entries, n, 1);
  };
  const keepKept = (cell, old, count) => {
    const begin = firstFrom(old, oldKeptRow, oldKept, (n) => wasEntries[2 * n]);
    oldKeptRow = firstFrom(old + count, begin, oldKept, (n) => wasEntries[2 * n]);
    copy(nCells + keptRow, oldCells + begin, oldKeptRow - begin);
    if (cell === old && keptRow === begin) keptRow = oldKeptRow;
    else for (let n = begin; n < oldKeptRow; n++) putEntry(keptRow, wasEntries[2 * n] + cell - old, keptRow++);
  };
  const splitEntry = (n, k) => (n < oldSplit ? wasEntries[2 * (oldKept + n) + k] : oldSides);
  const keepSplit = (cell, old, count) => {
    const begin = firstFrom(old, oldSplitCell, oldSplit, (n) => splitEntry(n, 0)), row = splitEntry(begin, 1);
    oldSplitCell = firstFrom(old + count, begin, oldSplit, (n) => splitEntry(n, 0));
    const sides = splitEntry(oldSplitCell, 1) - row, isMoved = cell !== old || kept !== oldKept || splitCell !== begin || splitRow !== row;
    copy(nCells + kept + splitRow, oldCells + oldKept + row, sides);
    for (let n = begin; n < oldSplitCell; n++, splitCell++) {
      if (isMoved) putEntry(kept + splitCell, splitEntry(n, 0) + cell - old, splitEntry(n, 1) + splitRow - row);
    }
    splitRow += sides;
  };

  // A cell that is new.
  const add = (cell, n) => {
    put(own, cell, n);
    const [nodes, leaves, flag] = [masks[0][n], masks[1][n], own[1].codes[n]];
    if (nodes | leaves || (cell === 0 && nNodes > 0)) addNode(cell, nodes, leaves);
    if (flag & KEPT && keptRow < kept) {
      put(ownRows, nCells + keptRow, freshKept++);
      putEntry(keptRow, cell, keptRow++);
    }
    if (flag & SPLIT && splitCell < split[0]) {
      putEntry(kept + splitCell++, cell, splitRow);
      for (let side = bitsSet[flag & 63]; side > 0; side--) put(ownRows, nCells + kept + splitRow++, freshSide++);
    }
  };
  let cell = 0, fresh = 0;
  for (let run = 0; run < counts.runs; run++) {
    for (const end = cell + gaps[run]; cell < end; cell++) add(cell, fresh++);
    for (const keep of [copy, keepNodes, keepKept, keepSplit]) keep(cell, begins[run], lengths[run]);
    cell += lengths[run];
  }
  for (; cell < nCells; cell++) add(cell, fresh++);
  // What is no longer there.
  const clear = (array, end, oldEnd) => end < oldEnd && array.fill(0, end, oldEnd);
  clear(words, 2 * nNodes, 2 * oldNodes);
  clear(entries, 2 * (kept + split[0]), 2 * (oldKept + oldSplit));
  for (const plane of now) clear(plane, nCells + kept + split[1], oldCells + oldKept + oldSides);
  octree.depth = header.depth;
  octree.tables = { kept, split: split[0] };
  return dirty;
}

// A mark for each row of an array, of texels of so many numbers.
const marks = (array, size) => new Uint8Array(array.length / (size * ROW));

function mark(rows, first, count) {
  rows.fill(1, Math.floor(first / ROW), Math.ceil((first + count) / ROW));
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
