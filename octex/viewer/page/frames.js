// Draws frames when something has changed: a coarse image at once, and a sharp one when nothing changes any more. The sharp
// image is drawn tile by tile, so that the next change waits for one tile at most.

const SHARP_DELAY = 120; // milliseconds without a change before the sharp image begins
const HELD_DELAY = 500; // the same while a pointer is down: a tile would delay its next move
const FRAME_TIME = 80; // milliseconds that a coarse image or a few tiles may take
const MIN_TILE = 48, FIRST_TILE = 256; // pixels along the sides of tiles: at least, and before any time is measured
const MIN_SCALE = 0.08, FIRST_SCALE = 0.4; // of coarse images
const MAX_PIXEL_RATIO = 2;
const EMPTY_REGION = [1e9, -1e9].map((n) => Array(5).fill(n)); // lowest and highest corner: rest position, place in the image

export class Frames {
  constructor() {
    this.pixelTime = 0; // measured milliseconds a pixel
    this.imageCount = 0;
    this.maxScale = 2; // of sharp images: drawn pixels for each pixel of the screen, along each axis
    this.isDrawn = false; // the image shows the last change
    this.isSharpBegun = false;
    this.waitingTiles = []; // of the sharp image, or of a region that is drawn again
    this.changedRegion = null; // where the texture has changed since the image was drawn
  }

  // Draw soon, and sharply once nothing changes. `isHeld`: a pointer is down.
  invalidate(isHeld = false) {
    this.sharpAt = performance.now() + (isHeld ? HELD_DELAY : SHARP_DELAY);
    this.isDrawn = this.isSharpBegun = false;
    this.waitingTiles = [];
    this.requestFrame();
  }

  // Draw sharply without delay.
  sharpenNow() {
    this.sharpAt = 0;
  }

  get isSharp() {
    return this.isSharpBegun && !this.waitingTiles.length && !this.changedRegion;
  }

  // Draw a pending change at once, before the G-buffer is read.
  drawNow() {
    if (!this.isDrawn) this.frame();
  }

  requestFrame() {
    this.frameRequest ||= requestAnimationFrame(() => this.frame());
  }

  get pixelRatio() {
    return Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO);
  }

  frame() {
    this.frameRequest = 0;
    if (this.isContextLost || this.parts.every((part) => part.octree.depth < 0) || !this.canvas.clientWidth) return;
    this.animate(performance.now());
    const isStill = performance.now() > this.sharpAt && this.isLoaded, isPainting = Boolean(this.painting?.pen);
    const pixels = this.canvas.clientWidth * this.canvas.clientHeight * this.pixelRatio ** 2;
    const coarse = this.pixelTime ? Math.sqrt(FRAME_TIME / (this.pixelTime * pixels)) : FIRST_SCALE;
    // Supersample, which smooths edges, only where that is fast.
    const sharp = this.pixelTime * pixels * this.maxScale ** 2 < 2 * FRAME_TIME ? this.maxScale : Math.min(this.maxScale, 1);
    try {
      if (isStill && !this.isSharpBegun && !isPainting) this.beginSharp(this.pixelRatio * sharp);
      else if (!this.isDrawn) this.draw(this.pixelRatio * Math.min(Math.max(coarse, MIN_SCALE), this.maxScale, 1));
      if (this.changedRegion) this.waitingTiles.push(...this.tiles(this.changedRegion));
      this.changedRegion = null;
      if (!isPainting) {
        this.painting?.flat.refresh();
        this.drawTiles();
      }
    } catch (error) {
      return this.fail(error);
    }
    if (!this.isDrawn) {
      this.isDrawn = true;
      this.painting?.imageDrawn();
    }
    if (!this.isSharp || this.isTurning) this.requestFrame();
  }

  // Begin the sharp image: it is the last one, scaled, until its tiles are drawn.
  beginSharp(scale) {
    const { gpu, display, camera, parts } = this, [width, height] = this.beginImage(scale);
    this.isSharpBegun = true;
    if (gpu.showsCubes(display) || parts.some((part) => part.hasAlpha)) return gpu.draw(display, camera, width, height);
    gpu.resize(display, camera, width, height);
    this.waitingTiles = this.tiles(null);
    this.tileTime = this.tileArea = 0;
  }

  // Cut the image, or what a region reaches, into boxes (left, bottom, width, height) that take less than a frame each; the
  // middle ones come first.
  tiles(region) {
    const { width, height } = this.canvas, tiles = [];
    const regionScale = region ? 2 : 1; // most pixels of a tile lie outside the region
    const side = regionScale * Math.max(this.pixelTime ? Math.sqrt(FRAME_TIME / this.pixelTime) : FIRST_TILE, MIN_TILE);
    const [columns, rows] = [width, height].map((pixels) => Math.ceil(pixels / side)), edge = (n, count, pixels) => Math.round((n * pixels) / count);
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const [left, right] = [column, column + 1].map((n) => edge(n, columns, width)), [bottom, top] = [row, row + 1].map((n) => edge(n, rows, height));
        const distance = Math.hypot(left + right - width, bottom + top - height);
        tiles.push({ region, box: [left, bottom, right - left, top - bottom], distance });
      }
    }
    return tiles.sort((a, b) => a.distance - b.distance);
  }

  // Draw waiting tiles, as many as a frame has time for.
  drawTiles() {
    const { gpu, display, camera, canvas: { width, height } } = this, began = performance.now();
    while (this.waitingTiles.length && performance.now() - began < FRAME_TIME) {
      const { region, box } = this.waitingTiles.shift(), before = performance.now();
      gpu.draw(display, camera, width, height, box, region);
      gpu.finish();
      if (region) continue;
      this.tileTime += performance.now() - before;
      this.pixelTime = this.tileTime / (this.tileArea += box[2] * box[3]);
    }
  }

  // Draw a box of the image again (CSS pixels from the upper left), where nothing else has changed.
  drawBox([left, top, right, bottom]) {
    if (!this.isDrawn || this.isContextLost) return this.invalidate(true);
    const { canvas, gpu } = this, across = canvas.width / canvas.clientWidth, down = canvas.height / canvas.clientHeight;
    const x = Math.max(Math.floor(left * across), 0), y = Math.max(Math.floor(canvas.height - bottom * down), 0);
    const width = Math.min(Math.ceil(right * across), canvas.width) - x;
    const height = Math.min(Math.ceil(canvas.height - top * down), canvas.height) - y;
    if (width > 0 && height > 0) gpu.draw(this.display, this.camera, canvas.width, canvas.height, [x, y, width, height]);
  }

  // Draw again what lookups in a box of the root cell reach, and where strokes were that the texture now has. `box` is empty
  // if no cell has changed.
  redraw(box, strokes) {
    const { gpu, parts, painting } = this, [far] = EMPTY_REGION[0];
    const isSameView = this.isDrawn && !this.isContextLost && this.drawnViewKey === this.viewKey && strokes.every(() => painting.strokes.viewKey === this.viewKey);
    if (!isSameView || gpu.showsCubes(this.display) || parts.some((part) => part.hasAlpha)) return this.invalidate();
    const regions = box.length ? [[[...box[0], far, far], [...box[1], -far, -far]]] : [];
    for (const { box: [left, top, right, bottom] } of strokes) {
      const [width, height] = painting.strokes.size, place = (x, y) => [x / width, 1 - y / height];
      regions.push([[far, far, far, ...place(left - 2, bottom + 2)], [-far, -far, -far, ...place(right + 2, top - 2)]]);
    }
    for (const [low, high] of regions) {
      const [lowest, highest] = this.changedRegion ?? EMPTY_REGION;
      this.changedRegion = [lowest.map((x, n) => Math.min(x, low[n])), highest.map((x, n) => Math.max(x, high[n]))];
    }
    this.requestFrame();
  }

  // Begin an image with a scale in pixels for each CSS pixel; returns its size.
  beginImage(scale) {
    const { canvas, camera } = this;
    this.changedRegion = null;
    this.waitingTiles = [];
    this.drawnViewKey = this.viewKey;
    camera.aspect = canvas.clientWidth / canvas.clientHeight;
    this.imageCount++;
    return [canvas.clientWidth, canvas.clientHeight].map((pixels) => Math.max(Math.round(pixels * scale), 1));
  }

  draw(scale) {
    const [width, height] = this.beginImage(scale), began = performance.now(), programs = this.gpu.programs.size;
    this.gpu.draw(this.display, this.camera, width, height);
    this.gpu.finish();
    const hasCompiled = this.gpu.programs.size > programs;
    if (!hasCompiled) this.pixelTime = (performance.now() - began) / (width * height);
  }

  // A key of the view: the camera, the pose of the model, and the patch that is laid flat.
  get viewKey() {
    const { camera, display } = this;
    return `${camera.view} ${JSON.stringify([display.moment, display.patch])}`;
  }

  // A key of how textures are looked up. While it stays, a change of cells affects only pixels near it.
  get lookupKey() {
    return JSON.stringify([this.display.level, ...this.parts.map(({ header: { depth, isMixed, kept, split } }) => [depth, isMixed, kept > 0, split[0] > 0])]);
  }
}
