// Unpacks animations: bones and morph targets by frame, and their weights on vertices. octex/viewer/moves.py describes the
// stream.

import { fromBytePlanes } from "./octree.js";
import { fromZigzag } from "./mesh.js";

export class Motion {
  constructor(header, bytes) {
    this.header = header;
    const { vertices, entries: [nBones, nTargets], bones, targets, edge, middle } = header, scale = 2 ** -header.bits;
    let at = 0;
    const column = (count) => fromBytePlanes(bytes, count, (at += 4 * count) - 4 * count);
    const [boneCounts, boneNumbers, weights] = [column(vertices), column(nBones), column(nBones)];
    const [targetCounts, targetNumbers] = [column(vertices), column(nTargets)];
    const three = () => [0, 1, 2].map(() => column(nTargets)), offsets = three(), turns = header.turns ? three() : null;
    // Of each vertex: the first of its bones in `links` and their count, then the same of its morph targets.
    this.ranges = new Uint32Array(4 * vertices);
    // A bone and its weight; a morph target and its offset; if any target turns normals, the offsets of normals.
    this.links = new Float32Array(4 * (nBones + (turns ? 2 : 1) * nTargets));
    for (let v = 0, bone = 0, target = nBones; v < vertices; bone += boneCounts[v], target += targetCounts[v], v++) {
      this.ranges.set([bone, boneCounts[v], target, targetCounts[v]], 4 * v);
      let sum = 0;
      for (let n = bone; n < bone + boneCounts[v]; n++) sum += weights[n];
      for (let n = bone; n < bone + boneCounts[v]; n++) this.links.set([boneNumbers[n], weights[n] / sum], 4 * n);
    }
    for (let n = 0; n < nTargets; n++) {
      this.links.set([targetNumbers[n], ...offsets.map((column) => fromZigzag(column[n]) * scale * edge)], 4 * (nBones + n));
    }
    for (let n = 0; turns && n < nTargets; n++) {
      this.links.set(turns.map((column) => fromZigzag(column[n]) * scale), 4 * (nBones + nTargets + n));
    }
    this.stride = 3 * bones + targets; // texels of a frame
    this.animations = header.animations.map((animation) => {
      const texels = new Float32Array(4 * this.stride * animation.frames);
      const series = column((12 * bones + targets) * animation.frames);
      for (let k = 0, n = 0; k < 12 * bones + targets; k++) {
        const place = k < 12 * bones ? k : 12 * bones + 4 * (k - 12 * bones);
        for (let frame = 0, sum = 0; frame < animation.frames; frame++, n++) {
          texels[4 * this.stride * frame + place] = (sum += fromZigzag(series[n])) * scale;
        }
      }
      // Bones are stored relative to the model's middle; make their translations absolute.
      for (let row = 0; row < animation.frames * this.stride; row++) {
        if (row % this.stride >= 3 * bones) continue;
        const [x, y, z, w] = texels.subarray(4 * row, 4 * row + 4);
        texels[4 * row + 3] = w * edge - x * middle[0] - y * middle[1] - z * middle[2];
      }
      return { ...animation, texels };
    });
  }

  // The ranges of a mesh's vertices, given the surface's vertex of each.
  rangesOf(owners) {
    const found = new Uint32Array(4 * owners.length);
    owners.forEach((owner, n) => found.set(this.ranges.subarray(4 * owner, 4 * owner + 4), 4 * n));
    return found;
  }

  // The first texels of the frames before and after a time, and the share of the latter.
  framesAt(number, time) {
    const { length, frames } = this.animations[number];
    const place = length > 0 ? Math.min(Math.max(time / length, 0), 1) * (frames - 1) : 0;
    const before = Math.min(Math.floor(place), Math.max(frames - 2, 0)), after = Math.min(before + 1, frames - 1);
    return { before: before * this.stride, after: after * this.stride, share: place - before };
  }
}
