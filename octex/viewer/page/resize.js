// Drag with Ctrl to change the brush: sideways its size, up its hardness.

const HARDNESS_RANGE = 200; // pixels, up or down, from the softest brush to the hardest

// The brush's edge follows the pointer; its outline stays where the drag began.
export class ResizeDrag {
  constructor(painting, event) {
    const { size, hardness } = painting.brush;
    Object.assign(this, { painting, size, hardness, place: painting.place(event), width: painting.brushWidth });
    this.showNote();
  }

  move(event) {
    const [x, y] = this.painting.place(event), factor = Math.max(1 + (2 * (x - this.place[0])) / this.width, 0);
    this.painting.set({ size: Math.round(this.size * factor), hardness: this.hardness + (this.place[1] - y) / HARDNESS_RANGE });
    this.showNote();
  }

  showNote() {
    const { outline, sizeText, brush } = this.painting;
    outline.note.textContent = `${sizeText}, ${Math.round(100 * brush.hardness)} %`;
  }

  up() {
    this.painting.outline.note.textContent = "";
  }

  cancel() {
    const { size, hardness } = this;
    this.painting.set({ size, hardness });
    this.up();
  }
}
