// Applies a change to the octree in place. octex/viewer/changes.py describes the stream: runs of cells that both versions
// have, and new cells between them.

import { ROW, BIT_COUNTS, fromBytePlanes } from "./octree.js";

const KEPT = 64, SPLIT = 128; // flags of a cell

// Change an octree to the version of `header`. `counts` are the sizes of the stream's parts. Returns, for nodes, entries and
// cells, an array that marks the texture rows that differ.
export function applyChange(octree, header, counts, bytes) {
  const { channels, flags, kept, split } = header, nCells = header.levelCells.at(-1), nNodes = header.levelNodes.at(-1);
  const oldCells = octree.cells.at(-1), oldNodes = octree.nodes.at(-1), { kept: oldKept, split: [oldSplit, oldSides] } = octree.header;
  const [gaps, begins, lengths] = [0, 1, 2].map((n) => fromBytePlanes(bytes, counts.runs, 4 * n * counts.runs));
  const stored = [header.area, flags, ...channels.flatMap(({ at: [plane, slot], components }) =>
    Array.from({ length: components }, (_, k) => [plane, slot + k]))];
  const rows = counts.kept + counts.sides;
  if (12 * counts.runs + (2 + stored.length) * counts.cells + (stored.length - 2) * rows !== bytes.length) {
    throw new Error("the change's data is damaged");
  }
  let first = 0; // the first cell whose number may change
  for (let run = 0; run < counts.runs && begins[run] === first + gaps[run]; run++) first = begins[run] + lengths[run];
  first = Math.min(first, oldCells);
  const withRoom = (array) => new Uint32Array(array.buffer); // the array and the spare room behind it
  const oldValues = octree.planes.map((plane) => withRoom(plane).slice(first, oldCells + oldKept + oldSides));
  const oldEntries = octree.entries.slice(0, 2 * (oldKept + oldSplit));
  octree.resize(header);
  const words = withRoom(octree.words), owners = withRoom(octree.owners), entries = withRoom(octree.entries), values = octree.planes.map(withRoom);
  const dirty = { nodes: rowMarks(octree.words, 2), entries: rowMarks(octree.entries, 2), cells: rowMarks(octree.planes[0], 4) };

  let at = 12 * counts.runs;
  const next = (length) => bytes.subarray(at, (at += length));
  const masks = [next(counts.cells), next(counts.cells)];
  const columns = (places, count) => places.map(([plane, slot]) => ({ codes: next(count), bytes: octree.planes[plane], slot }));
  const newCells = columns(stored, counts.cells), newRows = columns(stored.slice(2), rows);
  const put = (columns, row, n) => {
    for (const plane of values) plane[row] = 0;
    for (const { codes, bytes, slot } of columns) bytes[4 * row + slot] = codes[n];
    dirty.cells[Math.floor(row / ROW)] = 1;
  };
  const copy = (row, old, count) => {
    if (row === old || !count) return;
    values.forEach((plane, n) => plane.set(oldValues[n].subarray(old - first, old - first + count), row));
    mark(dirty.cells, row, count);
  };

  // Nodes stay in place until the number of one or of its children changes; from there on they are read from a copy.
  let node = 0, nextCell = 1, nextNode = 1, oldNode = 0, oldWords = words, oldOwners = owners, base = 0, isCopied = false;
  const copyOldNodes = (cell) => {
    if (isCopied || (cell < first && node < oldNodes && owners[node] === cell && words[2 * node] >>> 8 === nextCell && words[2 * node + 1] >>> 8 === nextNode)) return;
    [isCopied, base] = [true, Math.min(node, oldNodes)];
    oldWords = words.slice(2 * base, 2 * oldNodes);
    oldOwners = owners.slice(base, oldNodes);
  };
  const countChildren = () => {
    const [nodes, leaves] = [words[2 * node - 2], words[2 * node - 1]];
    nextCell = (nodes >>> 8) + BIT_COUNTS[(nodes | leaves) & 255];
    nextNode = (leaves >>> 8) + BIT_COUNTS[nodes & 255];
  };
  const addNode = (cell, nodes, leaves) => {
    copyOldNodes(cell);
    mark(dirty.nodes, node, 1);
    owners[node] = cell;
    words[2 * node] = (nextCell << 8) | nodes;
    words[2 * node + 1] = (nextNode << 8) | leaves;
    node++;
    countChildren();
  };
  const moveNodes = (cell, old, count) => {
    const begin = firstFrom(old, Math.max(oldNode, base), oldNodes, (n) => oldOwners[n - base]);
    oldNode = firstFrom(old + count, begin, oldNodes, (n) => oldOwners[n - base]);
    if (begin === oldNode) return;
    copyOldNodes(oldOwners[begin - base] + cell - old);
    if (!isCopied) node = oldNode;
    else {
      const shifts = [nextCell, nextNode].map((next, k) => (next - (oldWords[2 * (begin - base) + k] >>> 8)) << 8);
      mark(dirty.nodes, node, oldNode - begin);
      for (let n = begin - base; n < oldNode - base; n++, node++) {
        owners[node] = oldOwners[n] + cell - old;
        words[2 * node] = oldWords[2 * n] + shifts[0];
        words[2 * node + 1] = oldWords[2 * n + 1] + shifts[1];
      }
    }
    countChildren();
  };

  // Entries of kept nodes and of split cells.
  let keptRow = 0, splitCell = 0, splitRow = 0, oldKeptRow = 0, oldSplitCell = 0, newKept = 0, newSide = counts.kept;
  const putEntry = (n, cell, row) => {
    entries[2 * n] = cell;
    entries[2 * n + 1] = row;
    mark(dirty.entries, n, 1);
  };
  const moveKept = (cell, old, count) => {
    const begin = firstFrom(old, oldKeptRow, oldKept, (n) => oldEntries[2 * n]);
    oldKeptRow = firstFrom(old + count, begin, oldKept, (n) => oldEntries[2 * n]);
    copy(nCells + keptRow, oldCells + begin, oldKeptRow - begin);
    if (cell === old && keptRow === begin) keptRow = oldKeptRow;
    else for (let n = begin; n < oldKeptRow; n++) putEntry(keptRow, oldEntries[2 * n] + cell - old, keptRow++);
  };
  const splitEntry = (n, k) => (n < oldSplit ? oldEntries[2 * (oldKept + n) + k] : oldSides);
  const moveSplit = (cell, old, count) => {
    const begin = firstFrom(old, oldSplitCell, oldSplit, (n) => splitEntry(n, 0)), row = splitEntry(begin, 1);
    oldSplitCell = firstFrom(old + count, begin, oldSplit, (n) => splitEntry(n, 0));
    const sides = splitEntry(oldSplitCell, 1) - row, isMoved = cell !== old || kept !== oldKept || splitCell !== begin || splitRow !== row;
    copy(nCells + kept + splitRow, oldCells + oldKept + row, sides);
    for (let n = begin; n < oldSplitCell; n++, splitCell++) {
      if (isMoved) putEntry(kept + splitCell, splitEntry(n, 0) + cell - old, splitEntry(n, 1) + splitRow - row);
    }
    splitRow += sides;
  };

  const addCell = (cell, n) => {
    put(newCells, cell, n);
    const [nodes, leaves, flag] = [masks[0][n], masks[1][n], newCells[1].codes[n]];
    if (nodes | leaves || (cell === 0 && nNodes > 0)) addNode(cell, nodes, leaves);
    if (flag & KEPT && keptRow < kept) {
      put(newRows, nCells + keptRow, newKept++);
      putEntry(keptRow, cell, keptRow++);
    }
    if (flag & SPLIT && splitCell < split[0]) {
      putEntry(kept + splitCell++, cell, splitRow);
      for (let side = BIT_COUNTS[flag & 63]; side > 0; side--) put(newRows, nCells + kept + splitRow++, newSide++);
    }
  };
  let cell = 0, added = 0;
  for (let run = 0; run < counts.runs; run++) {
    for (const end = cell + gaps[run]; cell < end; cell++) addCell(cell, added++);
    for (const move of [copy, moveNodes, moveKept, moveSplit]) move(cell, begins[run], lengths[run]);
    cell += lengths[run];
  }
  for (; cell < nCells; cell++) addCell(cell, added++);
  // Clear the old content behind the new end.
  const clear = (array, end, oldEnd) => end < oldEnd && array.fill(0, end, oldEnd);
  clear(words, 2 * nNodes, 2 * oldNodes);
  clear(entries, 2 * (kept + split[0]), 2 * (oldKept + oldSplit));
  for (const plane of values) clear(plane, nCells + kept + split[1], oldCells + oldKept + oldSides);
  octree.depth = header.depth;
  octree.tables = { kept, split: split[0] };
  return dirty;
}

// One mark for each texture row of an array, whose texels have `size` elements.
const rowMarks = (array, size) => new Uint8Array(array.length / (size * ROW));

function mark(rows, first, count) {
  rows.fill(1, Math.floor(first / ROW), Math.ceil((first + count) / ROW));
}

// Search ascending numbers `at(begin)` … `at(end - 1)`: the first that is not below a bound.
function firstFrom(bound, begin, end, at) {
  while (begin < end) {
    const middle = (begin + end) >> 1;
    if (at(middle) < bound) begin = middle + 1;
    else end = middle;
  }
  return begin;
}
