// What strokes lead to, by which they are shown until they are painted: what lies below an eraser, and paint as it is seen
// through the layers above. The server knows it of the cells with other paint; elsewhere strokes look as their colour says.
// See beneath.py.

import { inflated } from "./octree.js";
import { Part } from "./part.js";
import { Made, Seen, prepare } from "./retouch.js";

const PAINT = 3; // as retouch.frag names it
const VEIL = [128, 128, 128], VEILED = 0.6; // is laid where nothing is known of what an eraser leads to, and how strongly

// What an eraser or a mask's brush leads to.
class Bare {
  constructor(painting, part) {
    this.seen = new Seen(painting, undefined, part);
    [this.texture] = this.seen.target.textures;
    this.buffer = this.seen.target.buffer;
  }

  ready(box) {
    this.seen.need(box);
  }
}

// What paint leads to, of a colour or of a picture.
class Led extends Made {
  constructor(painting, part, { color = [0, 0, 0], picture }, strength) {
    super(painting, part);
    this.white = new Seen(painting, undefined, part, "white");
    this.paint = picture?.texture ?? null;
    this.options = picture ? { share: strength } : { share: -1, disc: [...color.map((code) => code / 255), 1] };
  }

  ready(box) {
    for (const seen of [this.seen, this.white]) seen.need(box);
    this.run(PAINT, this.seen.target, this.made, box, { ...this.options, before: this.white.target, paint: this.paint });
  }
}

export class Beneath {
  constructor(painting) {
    this.painting = painting;
    this.changes = 0; // after which what is known is no longer so
    this.known = { key: "", part: null };
    this.opened = null; // of the texture without layers
  }

  // What strokes lead to where they go now; null if their own colours say that.
  get leads() {
    const { layers, tool, brush } = this.painting, { layer, stack, mask } = layers;
    if (tool?.name === "eraser") return "erased";
    if (mask) return "unmasked";
    const above = stack.slice(stack.indexOf(layer) + 1), isPlain = !layer || (layer.opacity === 1 && layer.blend === "over");
    return brush.blend === "over" && (!isPlain || above.some(({ isVisible, opacity }) => isVisible && opacity > 0)) ? "painted" : null;
  }

  get key() {
    const { leads } = this, { chosen } = this.painting.layers;
    return leads && `${JSON.stringify({ layer: chosen, leads })} ${leads === "erased" && !this.painting.layers.stack.length ? "" : this.changes}`;
  }

  // The server has told of steps: own strokes change what they lead to only in layers that let themselves through.
  arrived(told, before) {
    const { sending: { page }, layers: { layer } } = this.painting, own = (told.baked[page] ?? 0) - (before.baked?.[page] ?? 0);
    const isOwn = told.done - before.done === own && told.steps.length === told.done && JSON.stringify(told.layers) === JSON.stringify(before.layers);
    const isPlain = this.leads !== "painted" || !layer || (layer.opacity === 1 && layer.blend === "over");
    if (!isOwn || !isPlain) this.changes++;
  }

  // Ask the server for what strokes lead to now, unless that is known.
  async ask() {
    const { key } = this;
    if (!key || this.asking || this.known.key === key) return;
    this.asking = true;
    try {
      const part = await this.read(key.slice(0, key.lastIndexOf(" ")));
      this.release();
      this.known = { key, part };
    } catch (error) {
      console.warn(error); // strokes are shown by their colours
    } finally {
      this.asking = false;
    }
    if (this.known.key === key && this.key !== key) this.ask();
  }

  // An octree of what is asked for; null where there is nothing that a stroke meets.
  async read(asked) {
    const answer = await fetch(`beneath?${encodeURIComponent(asked)}`);
    if (!answer.ok) throw new Error(await answer.text());
    const bytes = new Uint8Array(await answer.arrayBuffer()), end = bytes.indexOf(10), header = JSON.parse(new TextDecoder().decode(bytes.subarray(0, end)));
    if (!header) return null;
    const part = new Part(header), { octree } = part;
    part.build(this.painting.viewer.gpu.gl);
    let at = end + 1;
    for (const chunk of header.chunks) {
      const stream = await inflated(new Blob([bytes.subarray(at, (at += chunk.bytes))]).stream());
      part.upload(chunk.levels ? octree.take(chunk, stream) : octree.takeTables(stream));
    }
    part.keepOnGpu();
    for (const { name } of header.channels) if (name !== "alpha") prepare(this.painting, part, name);
    return part;
  }

  // Forget what is known, as after a lost context.
  release() {
    this.known.part?.free();
    this.known = { key: "", part: null };
  }

  // How a stroke looks until it is painted.
  look(brush) {
    const { leads, painting, known, key } = this, { layer, mask } = painting.layers, strength = layer?.opacity ?? 1, isKnown = known.key === key && !brush.mirror;
    const isCover = brush.erases || mask, blend = layer && layer.blend !== "over" ? layer.blend : brush.blend;
    if (isCover && !isKnown) return { color: VEIL, values: {}, opacity: VEILED * brush.opacity, blend: "over" };
    if (isCover) return { color: undefined, values: {}, picture: known.part && new Bare(painting, known.part), blend: "over" };
    const picture = leads && isKnown && known.part ? new Led(painting, known.part, brush, strength) : null;
    return picture ? { picture, strength, blend: "over", plain: blend } : { strength, blend };
  }
}
