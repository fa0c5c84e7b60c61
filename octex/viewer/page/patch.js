// An octree as it has changed: made of the one before and of the cells that are new. See changes.py.

import { Octree, bitsSet, planes } from "./octree.js";

const KEPT = 64, SPLIT = 128;

// The octree that `header` is of. `counts` are the entries of the change's stream, whose bytes these are.
export function patched(before, header, counts, bytes) {
  const after = new Octree(header), nCells = after.cells.at(-1), { channels, flags } = header;
  const [gaps, begins, lengths] = [0, 1, 2].map((n) => planes(bytes, counts.runs, 4 * n * counts.runs));
  const from = new Int32Array(nCells).fill(-1); // what each cell was
  for (let run = 0, cell = 0; run < counts.runs; run++) {
    cell += gaps[run];
    for (let n = 0; n < lengths[run]; n++) from[cell++] = begins[run] + n;
  }
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
  const copy = (row, old) => now.forEach((plane, n) => (plane[row] = was[n][old]));
  const put = (columns, row, n) => columns.forEach(({ codes, values, slot }) => (values[4 * row + slot] = codes[n]));
  const flagsAt = (cell) => after.planes[flags[0]][4 * cell + flags[1]];
  const { kept } = header, oldRows = before.cells.at(-1);
  let fresh = 0, node = 0, keptRow = 0, splitCell = 0, splitRow = 0, freshKept = 0, freshSide = counts.kept;
  let oldNode = 0, oldKept = 0, oldSplit = before.header.kept;
  for (let cell = 0; cell < nCells; cell++) {
    const old = from[cell];
    let nodes = 0, leaves = 0;
    if (old < 0) {
      [nodes, leaves] = [masks[0][fresh], masks[1][fresh]];
      put(own, cell, fresh++);
    } else {
      copy(cell, old);
      while (before.owners[oldNode] < old) oldNode++;
      if (before.owners[oldNode] === old && oldNode < before.nodes.at(-1)) {
        [nodes, leaves] = [before.words[2 * oldNode] & 255, before.words[2 * oldNode + 1] & 255];
      }
    }
    if (nodes | leaves || (cell === 0 && after.nodes.at(-1) > 0)) {
      after.words.set([(after.nextCell << 8) | nodes, (after.nextNode << 8) | leaves], 2 * node);
      after.owners[node++] = cell;
      after.nextCell += bitsSet[nodes | leaves];
      after.nextNode += bitsSet[nodes];
    }
    const flag = flagsAt(cell);
    if (flag & KEPT && keptRow < kept) {
      if (old < 0) put(ownRows, nCells + keptRow, freshKept++);
      else {
        while (before.entries[2 * oldKept] < old) oldKept++;
        copy(nCells + keptRow, oldRows + before.entries[2 * oldKept + 1]);
      }
      after.entries.set([cell, keptRow], 2 * keptRow++);
    }
    if (flag & SPLIT && splitCell < header.split[0]) {
      const first = nCells + kept + splitRow, sides = bitsSet[flag & 63];
      if (old >= 0) while (before.entries[2 * oldSplit] < old) oldSplit++;
      for (let n = 0; n < sides; n++) {
        if (old < 0) put(ownRows, first + n, freshSide++);
        else copy(first + n, oldRows + before.header.kept + before.entries[2 * oldSplit + 1] + n);
      }
      after.entries.set([cell, splitRow], 2 * (kept + splitCell++));
      splitRow += sides;
    }
  }
  after.depth = header.depth;
  after.tables = { kept, split: header.split[0] };
  return after;
}
