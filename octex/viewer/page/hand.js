// What helps a hand: a pen that pulls the brush behind it, and a brush that is dragged to another size.

// Where the brush comes when the pen that pulls it by a string, so many pixels long, has come to a place.
export function pulled(brush, pen, length) {
  if (!length) return pen;
  const [x, y] = [0, 1].map((k) => brush[k] - pen[k]), far = Math.hypot(x, y);
  if (far <= length) return brush;
  return [pen[0] + (x * length) / far, pen[1] + (y * length) / far, ...pen.slice(2)];
}

const SOFTENED = 200; // pixels, up or down, from the hardest brush to the softest

// Sideways the brush's edge follows the pointer; up it gets harder. Its outline stays where the drag began.
export class SizeDrag {
  constructor(painting, event) {
    const { size, hardness } = painting.brush;
    Object.assign(this, { painting, size, hardness, at: painting.place(event), width: painting.width });
    this.tell();
  }

  moved(event) {
    const [x, y] = this.painting.place(event), times = Math.max(1 + (2 * (x - this.at[0])) / this.width, 0);
    this.painting.set({ size: Math.round(this.size * times), hardness: this.hardness + (this.at[1] - y) / SOFTENED });
    this.tell();
  }

  tell() {
    const { outlined, sizeText, brush } = this.painting;
    outlined.note.textContent = `${sizeText}, ${Math.round(100 * brush.hardness)} %`;
  }

  up() {
    this.painting.outlined.note.textContent = "";
  }

  giveUp() {
    const { size, hardness } = this;
    this.painting.set({ size, hardness });
    this.up();
  }
}
