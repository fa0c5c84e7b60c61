// What lies under the cursor: which part of the model, where, in which cell, with which values.

import { element, make, swatch } from "./elements.js";

function pointedCube({ gpu, look, camera }, pixel, size) {
  const found = gpu.probeCubes(look, camera, pixel, size);
  return found && { ...found, point: found.index.map((n) => (n + 0.5) * found.edge), valuesOf: () => null };
}

function pointedSurface({ gpu, look, camera, parts }, pixel, [width, height]) {
  const ask = (plane) => gpu.probe(look, camera, { width, height, pixel, plane }), { positions, values, normals } = ask(-1);
  if (values[3] === 0) return null;
  const point = Array.from(positions.subarray(0, 3)), part = normals[3], { octree } = parts[part];
  const looked = {}, at = (plane) => (looked[plane] ??= ask(plane).values);
  const valuesOf = ({ name, at: [plane, slot], components }) =>
    name === "alpha" ? [values[0]] : Array.from(at(plane).slice(slot, slot + components));
  return { ...octree.cellAt(point, Math.min(look.level, octree.depth)), part, point, fetches: values[1], valuesOf };
}

// What lies at a place of the picture, in CSS pixels: the part, the position at rest, the cell, values; or null. Of a cube
// it is its middle, and what is stored there.
export function pointed(viewer, pixel) {
  const { canvas, gpu, look, parts } = viewer, size = [canvas.clientWidth, canvas.clientHeight];
  const found = (gpu.showsCubes(look) ? pointedCube : pointedSurface)(viewer, pixel, size);
  if (!found) return null;
  const { header: { name, origin, size: edge, channels }, octree } = parts[found.part];
  const known = channels.map((channel) => {
    const codes = octree.codes(channel, found.cell), values = found.valuesOf(channel) ?? codes.map((code) => code / 255);
    return { name: channel.name, space: channel.space, range: channel.range, codes, values };
  });
  const rest = found.point.map((p, axis) => origin[axis] + edge * p);
  return { ...found, valuesOf: undefined, name, rest, channels: known };
}

// Say what was found; null for nothing.
export function describePoint(found) {
  const rows = [];
  if (found) {
    if (found.name) rows.push(["part", found.name]);
    rows.push(["position", found.rest.map((p) => p.toPrecision(5)).join(", ")]);
    rows.push(["cell", `${found.cell.toLocaleString("en")}, level ${found.level}`]);
    rows.push(["index", found.index.join(", ")]);
    for (const { name, codes, values, range } of found.channels) {
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
