// Boxes of pixels: [left, bottom, right, top], or top before bottom where rows count from above.

// The box around discs, each [x, y, radius, …].
export function boxOfDiscs(discs) {
  const ends = (k, sign) => discs.map((disc) => disc[k] + sign * disc[2]);
  return [0, 1].map((k) => Math.floor(Math.min(...ends(k, -1))) - 1).concat([0, 1].map((k) => Math.ceil(Math.max(...ends(k, 1))) + 1));
}

// The part of a box in an image of a size; null if there is none.
export function clippedBox([left, bottom, right, top], [width, height]) {
  const box = [Math.max(left, 0), Math.max(bottom, 0), Math.min(right, width), Math.min(top, height)];
  return box[0] < box[2] && box[1] < box[3] ? box : null;
}

// The box around the pixels of an image for whose number `isInside` holds; null if there are none.
export function boxOfPixels(width, height, isInside) {
  let [left, low, right, high] = [width, height, 0, 0];
  for (let row = 0, n = 0; row < height; row++) {
    for (let column = 0; column < width; column++, n++) {
      if (!isInside(n)) continue;
      left = Math.min(left, column);
      right = Math.max(right, column + 1);
      low = Math.min(low, row);
      high = row + 1;
    }
  }
  return left < right ? [left, low, right, high] : null;
}

// The box around two boxes, each of which may be null.
export function unionOf(one, other) {
  if (!one || !other) return one ?? other;
  return one.map((edge, n) => (n < 2 ? Math.min(edge, other[n]) : Math.max(edge, other[n])));
}

export const grownBox = ([left, bottom, right, top], x, y) => [left - x, bottom - y, right + x, top + y];

export const movedBox = ([left, bottom, right, top], [x, y]) => [left + x, bottom + y, right + x, top + y];
