// How the mesh moves, as it arrives: bones and targets at the frames of animations. See moves.py.

import { planes } from "./octree.js";
import { signed } from "./mesh.js";

export class Motion {
  constructor(header, bytes) {
    this.header = header;
    const { vertices, entries, bones, targets, edge, middle } = header, scale = 2 ** -header.bits;
    let at = 0;
    const column = (count) => planes(bytes, count, (at += 4 * count) - 4 * count);
    const [counts, numbers, shares] = [column(vertices), column(entries[0]), column(entries[0])];
    const [added, targetsOf] = [column(vertices), column(entries[1])];
    const three = () => [0, 1, 2].map(() => column(entries[1])), offsets = three(), turns = header.turns ? three() : null;
    // Of each vertex: its first bone and how many, its first target and how many.
    this.ranges = new Uint32Array(4 * vertices);
    // A bone and its share; a target and what it adds; if any turns normals, what each adds to these.
    this.links = new Float32Array(4 * (entries[0] + (turns ? 2 : 1) * entries[1]));
    for (let v = 0, bone = 0, target = entries[0]; v < vertices; bone += counts[v], target += added[v], v++) {
      this.ranges.set([bone, counts[v], target, added[v]], 4 * v);
      let sum = 0;
      for (let n = bone; n < bone + counts[v]; n++) sum += shares[n];
      for (let n = bone; n < bone + counts[v]; n++) this.links.set([numbers[n], shares[n] / sum], 4 * n);
    }
    for (let n = 0; n < entries[1]; n++) {
      this.links.set([targetsOf[n], ...offsets.map((column) => signed(column[n]) * scale * edge)], 4 * (entries[0] + n));
    }
    for (let n = 0; turns && n < entries[1]; n++) {
      this.links.set(turns.map((column) => signed(column[n]) * scale), 4 * (entries[0] + entries[1] + n));
    }
    this.stride = 3 * bones + targets; // texels of a frame
    this.animations = header.animations.map((animation) => {
      const texels = new Float32Array(4 * this.stride * animation.frames);
      const series = column((12 * bones + targets) * animation.frames);
      for (let k = 0, n = 0; k < 12 * bones + targets; k++) {
        const place = k < 12 * bones ? k : 12 * bones + 4 * (k - 12 * bones);
        for (let frame = 0, sum = 0; frame < animation.frames; frame++, n++) {
          texels[4 * this.stride * frame + place] = (sum += signed(series[n])) * scale;
        }
      }
      for (let row = 0; row < animation.frames * this.stride; row++) {
        if (row % this.stride >= 3 * bones) continue;
        const [x, y, z, w] = texels.subarray(4 * row, 4 * row + 4);
        texels[4 * row + 3] = w * edge - x * middle[0] - y * middle[1] - z * middle[2];
      }
      return { ...animation, texels };
    });
  }

  // The ranges of the vertices that own those of the mesh.
  linksOf(owners) {
    const found = new Uint32Array(4 * owners.length);
    owners.forEach((owner, n) => found.set(this.ranges.subarray(4 * owner, 4 * owner + 4), 4 * n));
    return found;
  }

  // The texels that the frames around a time begin at, and how near it is to the second.
  at(number, time) {
    const { length, frames } = this.animations[number];
    const place = length > 0 ? Math.min(Math.max(time / length, 0), 1) * (frames - 1) : 0;
    const before = Math.min(Math.floor(place), Math.max(frames - 2, 0)), after = Math.min(before + 1, frames - 1);
    return { before: before * this.stride, after: after * this.stride, share: place - before };
  }
}
