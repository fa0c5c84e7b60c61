// Views that are painted in other programs: saved as PNG, kept by the browser with their cameras, and taken back.

import { send } from "./brush.js";
import { boxOf } from "./dabs.js";
import { download, element, make } from "./elements.js";
import { readImage } from "./images.js";
import { section } from "./panel.js";
import { Seen } from "./retouch.js";

const NAME = /-view-([0-9a-f]{8})/; // of files
const MOST = 20; // views that are kept, the latest ones
const EXACTLY = { premultiplyAlpha: "none", colorSpaceConversion: "none" };

export class External {
  constructor(painting) {
    this.painting = painting;
    element("history").before(section("elsewhere", "Paint in another program",
      make("p", { class: "hint" }, "Save the view and paint on it in any program. Save that as PNG under the same name, and load it here or drop it on the page. octex paints only the pixels that you changed. You may turn the view meanwhile."),
      make("div", { class: "buttons" }, make("button", { type: "button", id: "save-view", onclick: () => this.save() }, "Save the view"),
        make("button", { type: "button", onclick: () => painting.stencil.file.click() }, "Load it …"))));
  }

  // Save the colours of the view without light, transparent beside the model.
  async save() {
    const { painting } = this, { viewer } = painting, { name, width, height } = viewer.film, why = painting.hindrance;
    painting.say(why);
    if (why) return;
    const seen = new Seen(painting), id = crypto.randomUUID().slice(0, 8);
    seen.need([0, 0, width, height]);
    const picture = Object.assign(document.createElement("canvas"), { width, height }), pixels = new ImageData(width, height);
    const rows = viewer.gpu.codes(seen.target);
    for (let row = 0; row < height; row++) pixels.data.set(rows.subarray(4 * width * (height - 1 - row), 4 * width * (height - row)), 4 * width * row);
    picture.getContext("2d").putImageData(pixels, 0, 0);
    const view = { id, title: viewer.header.title, at: Date.now(), ...painting.strokes.seen, seen: viewer.viewed };
    view.png = await new Promise((resolve) => picture.toBlob(resolve));
    try {
      await keep(view);
      download(`${name}-view-${id}.png`, view.png);
    } catch {
      painting.say("This browser cannot keep the view, so it could not be loaded again.");
    }
  }

  // Paint what has changed in a view that comes back; other pictures become stencils.
  async take(file) {
    const { painting } = this, [, id] = NAME.exec(file.name) ?? [];
    try {
      const view = id && (await kept(id));
      if (view) painting.say(await this.paint(file, view));
      else await painting.stencil.read(file);
      if (id && !view) painting.say(`${file.name} is no view that this browser has saved: it lies over the model as a stencil.`);
    } catch (error) {
      painting.say(error.message);
    }
  }

  // Paint what differs from a view; returns why nothing is, or nothing.
  async paint(file, { title, camera, moved, patch, png, seen }) {
    const { viewer, strokes, brush: { angle, backFaces } } = this.painting, { width, height } = camera, { film } = viewer;
    const { kind, bitmap } = await readImage(file, EXACTLY);
    if (title !== viewer.header.title) return `${file.name} is a view of ${title}: open that to paint it.`;
    if (kind !== "png") return `${file.name} is no PNG, and other kinds change every pixel: save it as PNG.`;
    if (bitmap.width !== width || bitmap.height !== height) return `${file.name} has ${bitmap.width} × ${bitmap.height} pixels, the view has ${width} × ${height}: keep its size.`;
    const codes = this.codes(bitmap), stroke = difference(codes, this.codes(await createImageBitmap(png, EXACTLY)), width, height);
    if (!stroke) return `${file.name} is the view as it was saved: nothing is painted.`;
    const isHere = seen === viewer.viewed && film.width === width && film.height === height;
    if (isHere) strokes.fit();
    send(this.painting, { name: "Painted elsewhere", camera, moved, patch, opacity: 1, angle, backFaces, mirror: "", ...stroke }, isHere);
    viewer.move();
    return "";
  }

  // The codes of an image, row by row from above; alpha is not multiplied in.
  codes(bitmap) {
    const { gpu } = this.painting.viewer, { gl } = gpu, target = gpu.target("read", bitmap.width, bitmap.height, [gl.RGBA8]);
    gl.bindTexture(gl.TEXTURE_2D, target.textures[0]);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, bitmap.width, bitmap.height, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
    bitmap.close();
    return gpu.codes(target);
  }
}

// What has changed: the box, its coverage and the planes of its colours; null for nothing.
function difference(after, before, width, height) {
  const [now, was] = [after, before].map(({ buffer }) => new Uint32Array(buffer)), isPainted = (n) => now[n] !== was[n] && after[4 * n + 3] > 0;
  const box = boxOf(width, height, isPainted);
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

// Do something with the views that the browser keeps.
async function views(mode, act) {
  const answer = (asked) => new Promise((resolve, reject) => Object.assign(asked, { onsuccess: () => resolve(asked.result), onerror: () => reject(asked.error) }));
  const asked = indexedDB.open("octex");
  asked.onupgradeneeded = () => asked.result.createObjectStore("views", { keyPath: "id" });
  const database = await answer(asked);
  try {
    return await answer(act(database.transaction("views", mode).objectStore("views")));
  } finally {
    database.close();
  }
}

const kept = (id) => views("readonly", (store) => store.get(id)).catch(() => null);

async function keep(view) {
  await views("readwrite", (store) => store.put(view));
  const all = await views("readonly", (store) => store.getAll()), old = all.sort((a, b) => b.at - a.at).slice(MOST);
  for (const { id } of old) await views("readwrite", (store) => store.delete(id));
}
