// The colours of levels and of facings, and their legend.

import { element, make, swatch } from "./elements.js";

const MAX_LEVEL = 21;

const levelColor = (level) => [0, 0.33, 0.67].map((turn) => 0.5 + 0.45 * Math.cos(2 * Math.PI * (0.381966 * level + turn)));

export const LEVELS = Array.from({ length: MAX_LEVEL + 1 }, (_, level) => levelColor(level));

// Red, green and blue for +x, +y and +z, dark for the opposite facings; grey for none.
export const FACINGS = [0, 0, 1, 1, 2, 2].map((axis, bit) =>
  [0, 1, 2].map((n) => (bit % 2 ? 0.08 + 0.4 * (n === axis) : 0.25 + 0.7 * (n === axis))),
);
FACINGS.push([0.5, 0.5, 0.5]);

const NAMES = ["+x", "−x", "+y", "−y", "+z", "−z"];

const cellCount = (cells) => `${cells.toLocaleString("en")} cell${cells === 1 ? "" : "s"}`;

function levelRows(parts, finest) {
  const sums = new Map(); // of each level that has leaves, their number
  for (const { octree } of parts) {
    octree.leafCounts(finest).forEach((leaves, level) => leaves && sums.set(level, (sums.get(level) ?? 0) + leaves));
  }
  const width = (level) => (parts.length > 1 ? "" : `, ${(parts[0].header.size / 2 ** level).toPrecision(3)} wide`);
  return [...sums].sort(([a], [b]) => a - b).map(([level, cells]) => [LEVELS[level], `level ${level}: ${cellCount(cells)}${width(level)}`]);
}

function facingRows() {
  const mixed = FACINGS[0].map((x, n) => (x + FACINGS[2][n]) / 2);
  const rows = NAMES.map((name, n) => [FACINGS[n], `toward ${name}`]);
  return [...rows, [mixed, "several: their average, as of +x and +y"], [FACINGS[6], "unknown"]];
}

// Show the legend of a display mode, if it has one. `level` is the finest level that is drawn.
export function showLegend(parts, mode, level) {
  const rows = mode === "depth" ? levelRows(parts, level) : mode === "facing" ? facingRows() : [];
  const items = rows.map(([color, text]) => make("li", {}, swatch(`rgb(${color.map((x) => Math.round(255 * x))})`), text));
  element("legend").replaceChildren(...items);
  element("legend").hidden = !items.length;
}
