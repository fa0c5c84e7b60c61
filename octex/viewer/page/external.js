// Painting on a view in another program: the page saves the view as PNG, stores it in the browser with its camera, and
// paints the pixels that differ when the file comes back.

import { boxOfPixels } from "./boxes.js";
import { sendStroke } from "./brush.js";
import { download, element, make } from "./elements.js";
import { readImage } from "./images.js";
import { button, section } from "./panel.js";
import { ViewColors } from "./retouch.js";

const FILE_NAME = /-view-([0-9a-f]{8})/;
const MAX_VIEWS = 20; // that are stored, the latest ones
const EXACT = { premultiplyAlpha: "none", colorSpaceConversion: "none" };

export class External {
  constructor(painting) {
    this.painting = painting;
    element("history").before(section("external", "Paint in another program",
      make("p", { class: "hint" }, "Save the view and paint on it in any program. Save that as PNG under the same name, and load it here or drop it on the page. octex paints only the pixels that you changed. You may turn the view meanwhile."),
      make("div", { class: "buttons" }, button("save-view", "Save the view", () => this.save()), button("load-view", "Load it …", () => painting.stencil.file.click()))));
  }

  // Save the colours of the view without light; the background is transparent.
  async save() {
    const { painting } = this, { viewer } = painting, { screenSize: { width, height }, fileName } = viewer, why = painting.blockReason;
    painting.showMessage(why);
    if (why) return;
    const colors = new ViewColors(painting), id = crypto.randomUUID().slice(0, 8);
    colors.require([0, 0, width, height]);
    const canvas = Object.assign(document.createElement("canvas"), { width, height }), pixels = new ImageData(width, height);
    const rows = viewer.gpu.readBytes(colors.target); // from below
    for (let row = 0; row < height; row++) pixels.data.set(rows.subarray(4 * width * (height - 1 - row), 4 * width * (height - row)), 4 * width * row);
    canvas.getContext("2d").putImageData(pixels, 0, 0);
    const view = { id, title: viewer.header.title, at: Date.now(), ...painting.strokes.viewFields, viewKey: viewer.viewKey };
    view.png = await new Promise((resolve) => canvas.toBlob(resolve));
    try {
      await storeView(view);
      download(`${fileName}-view-${id}.png`, view.png);
    } catch {
      painting.showMessage("This browser cannot store the view, so it could not be loaded again.");
    }
  }

  // Paint the pixels that differ in a saved view; any other image becomes the stencil.
  async take(file) {
    const { painting } = this, [, id] = FILE_NAME.exec(file.name) ?? [];
    try {
      const view = id && (await storedView(id));
      if (view) painting.showMessage(await this.paint(file, view));
      else await painting.stencil.read(file);
      if (id && !view) painting.showMessage(`${file.name} is no view that this browser has saved: it lies over the model as a stencil.`);
    } catch (error) {
      painting.showMessage(error.message);
    }
  }

  // Paint the pixels that differ from a view; returns the reason if nothing is painted, else "".
  async paint(file, { title, camera, moved, patch, png, viewKey }) {
    const { viewer, strokes, brush: { angle, backFaces } } = this.painting, { width, height } = camera, { screenSize } = viewer;
    const { kind, bitmap } = await readImage(file, EXACT);
    if (title !== viewer.header.title) return `${file.name} is a view of ${title}: open that to paint it.`;
    if (kind !== "png") return `${file.name} is no PNG, and other kinds change every pixel: save it as PNG.`;
    if (bitmap.width !== width || bitmap.height !== height) {
      return `${file.name} has ${bitmap.width} × ${bitmap.height} pixels, the view has ${width} × ${height}: keep its size.`;
    }
    const pixels = this.pixelsOf(bitmap), stroke = difference(pixels, this.pixelsOf(await createImageBitmap(png, EXACT)), width, height);
    if (!stroke) return `${file.name} is the view as it was saved: nothing is painted.`;
    const isSameView = viewKey === viewer.viewKey && screenSize.width === width && screenSize.height === height;
    if (isSameView) strokes.prepareView();
    const settings = { name: "Painted elsewhere", camera, moved, patch, opacity: 1, angle, backFaces, mirror: "" };
    sendStroke(this.painting, { ...settings, ...stroke }, isSameView);
    viewer.invalidate();
    return "";
  }

  // The pixels of an image, row by row from above, without premultiplied alpha: a 2D canvas would premultiply.
  pixelsOf(bitmap) {
    const { gpu } = this.painting.viewer, { gl } = gpu, target = gpu.target("read", bitmap.width, bitmap.height, [gl.RGBA8]);
    gl.bindTexture(gl.TEXTURE_2D, target.textures[0]);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, bitmap.width, bitmap.height, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
    bitmap.close();
    return gpu.readBytes(target);
  }
}

// The stroke of the pixels that differ: box, coverage, and planes of colours; null if all are equal.
function difference(after, before, width, height) {
  const [now, old] = [after, before].map(({ buffer }) => new Uint32Array(buffer)), isPainted = (n) => now[n] !== old[n] && after[4 * n + 3] > 0;
  const box = boxOfPixels(width, height, isPainted);
  if (!box) return null;
  const [left, top, right, bottom] = box;
  const pixels = (right - left) * (bottom - top), coverage = new Uint8Array(pixels), colors = new Uint8Array(3 * pixels);
  for (let row = top, to = 0; row < bottom; row++) {
    for (let n = row * width + left; n < row * width + right; n++, to++) {
      if (!isPainted(n)) continue;
      coverage[to] = after[4 * n + 3];
      for (let k = 0; k < 3; k++) colors[k * pixels + to] = after[4 * n + k];
    }
  }
  return { box, coverage, colors };
}

const resultOf = (request) => new Promise((resolve, reject) => {
  request.onsuccess = () => resolve(request.result);
  request.onerror = () => reject(request.error);
});

// Run a request on the browser's store of views.
async function withViews(mode, run) {
  const opening = indexedDB.open("octex");
  opening.onupgradeneeded = () => opening.result.createObjectStore("views", { keyPath: "id" });
  const database = await resultOf(opening);
  try {
    return await resultOf(run(database.transaction("views", mode).objectStore("views")));
  } finally {
    database.close();
  }
}

const storedView = (id) => withViews("readonly", (store) => store.get(id)).catch(() => null);

async function storeView(view) {
  await withViews("readwrite", (store) => store.put(view));
  const all = await withViews("readonly", (store) => store.getAll()), old = all.sort((a, b) => b.at - a.at).slice(MAX_VIEWS);
  for (const { id } of old) await withViews("readwrite", (store) => store.delete(id));
}
