// Picks the cell under the pointer, and shows its values.

import { element, make, swatch } from "./elements.js";

function pickCube({ gpu, display, camera }, pixel, size) {
  const cube = gpu.probeCubes(display, camera, pixel, size);
  return cube && { ...cube, point: cube.index.map((n) => (n + 0.5) * cube.edge), valuesOf: () => null };
}

function pickSurface({ gpu, display, camera, parts }, pixel, [width, height]) {
  const probe = (plane) => gpu.probe(display, camera, { width, height, pixel, plane }), { positions, values, normals } = probe(-1);
  if (values[3] === 0) return null;
  const point = Array.from(positions.subarray(0, 3)), part = normals[3], { octree } = parts[part];
  const planes = {}, lookUp = (plane) => (planes[plane] ??= probe(plane).values);
  const valuesOf = ({ name, at: [plane, slot], components }) =>
    name === "alpha" ? [values[0]] : Array.from(lookUp(plane).slice(slot, slot + components));
  return { ...octree.cellAt(point, Math.min(display.level, octree.depth)), part, point, valuesOf };
}

// Pick at a position in CSS pixels. Returns the part, the rest position, the cell and its channels; null for the background.
// A cube is picked at its centre, with stored values; a surface has looked-up values (0 … 1).
export function pickAt(viewer, pixel) {
  const { canvas, gpu, display, parts } = viewer, size = [canvas.clientWidth, canvas.clientHeight];
  const picked = (gpu.showsCubes(display) ? pickCube : pickSurface)(viewer, pixel, size);
  if (!picked) return null;
  const { valuesOf, ...cell } = picked, { header: { name, origin, size: edge, channels }, octree } = parts[cell.part];
  const withValues = channels.map((channel) => {
    const codes = octree.codes(channel, cell.cell), values = valuesOf(channel) ?? codes.map((code) => code / 255);
    return { name: channel.name, space: channel.space, range: channel.range, codes, values };
  });
  return { ...cell, name, rest: cell.point.map((p, axis) => origin[axis] + edge * p), channels: withValues };
}

// List what was picked; null for nothing.
export function listPicked(picked) {
  const rows = [];
  if (picked) {
    if (picked.name) rows.push(["part", picked.name]);
    rows.push(["position", picked.rest.map((p) => p.toPrecision(5)).join(", ")]);
    rows.push(["cell", `${picked.cell.toLocaleString("en")}, level ${picked.level}`]);
    rows.push(["index", picked.index.join(", ")]);
    for (const { name, codes, values, range } of picked.channels) {
      const [low, high] = range, isWide = low < 0 || high > 1;
      const text = isWide ? values.map((x) => (low + (high - low) * x).toPrecision(3)) : codes;
      rows.push([name.replaceAll("_", " "), text.join(", "), codes]);
    }
  }
  element("cell").replaceChildren(...rows.flatMap(([name, text, codes]) => {
    const colors = codes?.length === 3 ? [swatch(`rgb(${codes})`)] : [];
    return [make("dt", {}, name), make("dd", {}, ...colors, text)];
  }));
}
