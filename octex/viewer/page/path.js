// The path of a brush: a smooth curve through the places of pointer events, and a string that smooths a pen's moves.

const CORNER = Math.PI * 0.4; // radians: sharper turns of the pen stay corners
const STEP = Math.PI / 36; // radians between the lines of the curve

const wrapped = (angle) => angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));

// A curve that ends at the last place: it does not wait for the next one.
export class Path {
  // A place is x, y and other numbers, which are interpolated linearly.
  constructor(place) {
    this.place = place;
    this.direction = null; // radians, at the end of the last line
  }

  // Continue to a place; returns the lines of the curve, each a pair of places.
  to(next) {
    const from = this.place, across = next[0] - from[0], down = next[1] - from[1], length = Math.hypot(across, down);
    this.place = next;
    if (!length) return [[from, next]];
    const straight = Math.atan2(down, across), turn = this.direction === null ? 0 : wrapped(this.direction - straight);
    const begin = Math.abs(turn) < CORNER ? turn : 0, end = -begin / 2; // an arc would end at −begin, but then curves oscillate
    const count = Math.ceil((Math.abs(begin - end) + 1e-9) / STEP), lines = [];
    this.direction = straight + end;
    const [x0, y0, x1, y1] = [straight + begin, this.direction].flatMap((angle) => [length * Math.cos(angle), length * Math.sin(angle)]);
    for (let n = 1, last = from; n <= count; n++) {
      const t = n / count, out = t * (1 - t) * (1 - t), into = t * t * (t - 1), share = t * t * (3 - 2 * t); // Hermite basis
      const place = from.map((number, k) => number + t * (next[k] - number));
      place[0] = from[0] + share * across + out * x0 + into * x1;
      place[1] = from[1] + share * down + out * y0 + into * y1;
      lines.push([last, place]);
      last = place;
    }
    return lines;
  }
}

// The place of a brush that the pen at `pen` pulls by a string of a length in pixels.
export function pulled(brush, pen, length) {
  if (!length) return pen;
  const [x, y] = [0, 1].map((k) => brush[k] - pen[k]), distance = Math.hypot(x, y);
  if (distance <= length) return brush;
  return [pen[0] + (x * length) / distance, pen[1] + (y * length) / distance, ...pen.slice(2)];
}
