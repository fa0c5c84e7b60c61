// The way of a pen through the places that its events tell, as a smooth curve. It ends at the pen: it needs no place
// that is still to come.

const CORNER = Math.PI * 0.4; // the pen has turned by so much, in radians, at a corner, which stays one
const STEP = Math.PI / 36; // that lines of the curve turn by

const wrapped = (angle) => angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));

export class Path {
  // A place is x, y and numbers that go evenly from one place to the next.
  constructor(at) {
    this.at = at;
    this.way = null; // the direction, in radians, that it has come in
  }

  // Go on to a place; returns lines of the curve, each from one place to another.
  to(next) {
    const from = this.at, across = next[0] - from[0], down = next[1] - from[1], length = Math.hypot(across, down);
    this.at = next;
    if (!length) return [[from, next]];
    const straight = Math.atan2(down, across), turn = this.way === null ? 0 : wrapped(this.way - straight);
    const begin = Math.abs(turn) < CORNER ? turn : 0, end = -begin / 2; // of an arc it were −begin, which sways
    const count = Math.ceil((Math.abs(begin - end) + 1e-9) / STEP), lines = [];
    this.way = straight + end;
    const [x0, y0, x1, y1] = [straight + begin, this.way].flatMap((way) => [length * Math.cos(way), length * Math.sin(way)]);
    for (let n = 1, last = from; n <= count; n++) {
      const t = n / count, out = t * (1 - t) * (1 - t), into = t * t * (t - 1), share = t * t * (3 - 2 * t); // Hermite's
      const at = from.map((number, k) => number + t * (next[k] - number));
      at[0] = from[0] + share * across + out * x0 + into * x1;
      at[1] = from[1] + share * down + out * y0 + into * y1;
      lines.push([last, at]);
      last = at;
    }
    return lines;
  }
}
