// Previews strokes that plain blending cannot show: the eraser, and paint in a layer that others cover or blend. The server
// computes the composite that full strokes lead to, of cells with paint of layers; the page blends it over by the stroke's
// coverage. Elsewhere, strokes look by their own colour. See octex/painting/composites.py.

import { query } from "./data.js";
import { inflate } from "./octree.js";
import { Part } from "./part.js";
import { BrushImage, ViewColors, compilePrograms } from "./retouch.js";

const PAINT = 3; // as u_action of retouch.frag has it
const VEIL = { color: [128, 128, 128], opacity: 0.6 }; // an eraser's preview while the composite is unknown
const NOTHING = { key: "", part: null };

// The preview of an eraser, or of a mask's brush.
class ErasedImage {
  constructor(painting, composite) {
    this.colors = new ViewColors(painting, { composite });
    [this.texture] = this.colors.target.textures;
    this.buffer = this.colors.target.buffer;
  }

  prepare(box) {
    this.colors.require(box);
  }
}

// The preview of a colour or an image through the layers above, from the composites of black and of white paint.
class PaintedImage extends BrushImage {
  constructor(painting, composite, { color = [0, 0, 0], image }, strength) {
    super(painting, composite);
    this.white = new ViewColors(painting, { composite, channel: "white" });
    this.paint = image?.texture ?? null;
    this.options = image ? { share: strength } : { share: -1, disc: [...color.map((code) => code / 255), 1] };
  }

  prepare(box) {
    for (const colors of [this.colors, this.white]) colors.require(box);
    this.run(PAINT, this.colors.target, this.target, box, { ...this.options, before: this.white.target, paint: this.paint });
  }
}

const isPlain = (layer) => !layer || (layer.opacity === 1 && layer.blend === "over");

export class Preview {
  constructor(painting) {
    this.painting = painting;
    this.changes = 0; // of the layers, each of which makes composites stale
    this.composite = NOTHING; // the last answer of the server, and what it is of
    this.request = null; // the one under way
    this.retired = []; // composites that the current stroke may still use
  }

  // The kind of composite that strokes need now: with the layer erased, unmasked or painted; null for none.
  get kind() {
    const { layers, tool, brush } = this.painting, { layer, stack, mask } = layers;
    if (tool?.name === "eraser") return "erased";
    if (mask) return "unmasked";
    const isCovered = stack.slice(stack.indexOf(layer) + 1).some(({ isVisible, opacity }) => isVisible && opacity > 0);
    return brush.blend === "over" && (isCovered || !isPlain(layer)) ? "painted" : null;
  }

  // A key of that composite. The texture without layers, to which the eraser restores, never changes.
  get key() {
    const { kind } = this, { active, stack } = this.painting.layers, isOpened = kind === "erased" && !stack.length;
    return kind && JSON.stringify([active, kind, isOpened ? null : this.changes]);
  }

  // The server reports the steps. A stroke of this page changes its own composite only in layers that blend.
  statusChanged(status, before) {
    const { commands: { page }, layers: { layer } } = this.painting, ownStrokes = (status.finished[page] ?? 0) - (before.finished?.[page] ?? 0);
    const isOwn = status.done - before.done === ownStrokes && status.steps.length === status.done && JSON.stringify(status.layers) === JSON.stringify(before.layers);
    if (!isOwn || (this.kind === "painted" && !isPlain(layer))) this.changes++;
  }

  // Load the composite that strokes need now, unless it is known.
  async load() {
    const { key, kind, painting: { layers: { active } } } = this;
    if (!key || this.request || this.composite.key === key) return;
    const request = (this.request = { key });
    const part = await this.read({ layer: active, stroke: kind }).catch((error) => console.warn(error)); // without it, strokes look by their colour
    if (this.request !== request) return part?.freeStores(); // the GPU was lost meanwhile
    this.request = null;
    if (part !== undefined) this.replace({ key, part });
    if (this.key !== key) this.load();
  }

  // Read the octree of a composite; null if no cell has paint that matters.
  async read(question) {
    const { header, bytes } = await query("composite", question);
    if (!header) return null;
    const part = new Part(header);
    part.build(this.painting.viewer.gpu.gl);
    let at = 0;
    for (const chunk of header.chunks) {
      part.upload(part.octree.readChunk(chunk, await inflate(new Blob([bytes.subarray(at, (at += chunk.bytes))]))));
    }
    part.freeArrays();
    for (const { name } of header.channels) if (name !== "alpha") compilePrograms(this.painting, part, name);
    return part;
  }

  // Use another composite. The current stroke may go on with the old one.
  replace(composite) {
    if (this.composite.part) this.retired.push(this.composite.part);
    this.composite = composite;
    if (!this.painting.strokes.current) this.freeRetired();
  }

  freeRetired() {
    for (const part of this.retired.splice(0)) part.freeStores();
  }

  // Forget all composites, after a lost context.
  restoreContext() {
    this.composite = NOTHING;
    this.request = null;
    this.retired = [];
    this.load();
  }

  // How a stroke that begins looks until the texture has it: settings that replace the brush's.
  styleOf(brush) {
    this.freeRetired();
    const { kind, painting, composite: { key, part } } = this, { layer, mask } = painting.layers, strength = layer?.opacity ?? 1;
    const isKnown = key === this.key && !brush.mirror, blend = layer && layer.blend !== "over" ? layer.blend : brush.blend;
    if (brush.erases || mask) {
      if (!isKnown) return { ...VEIL, opacity: VEIL.opacity * brush.opacity, values: {}, blend: "over" };
      return { color: undefined, values: {}, image: part && new ErasedImage(painting, part), blend: "over" };
    }
    const image = kind && isKnown && part ? new PaintedImage(painting, part, brush, strength) : null;
    return image ? { image, strength, blend: "over", plainBlend: blend } : { strength, blend };
  }
}
