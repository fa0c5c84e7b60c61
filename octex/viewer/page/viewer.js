// The page: what is shown, when it is drawn, and what its controls do.

import { Camera } from "./camera.js";
import { control } from "./controls.js";
import { isServed, readChange, readFile, readHeader, readStream } from "./data.js";
import { Divider } from "./divider.js";
import { download, element } from "./elements.js";
import { Gpu } from "./gpu.js";
import { keep, kept, reload, restoreControls } from "./kept.js";
import { tellLegend } from "./legend.js";
import { unpackedMesh } from "./mesh.js";
import { Motion } from "./motion.js";
import { Part } from "./part.js";
import { describePoint, pointed } from "./pointed.js";
import { Player } from "./player.js";
import { readPrograms } from "./programs.js";
import { Source } from "./source.js";
import { watch } from "./connection.js";

const STILL = 120; // milliseconds without a change, after which a sharp picture is drawn
const HELD = 500; // and while a pointer is down, as it would hold up what moves on
const FRAME = 80; // milliseconds that a picture may take while it moves, and a part of a sharp one
const LEAST_TILE = 48, FIRST_TILE = 256; // pixels along the sides of such parts, and while nothing is measured
const TURN = 0.35; // radians a second, of the turntable
const NOWHERE = [1e9, -1e9].map((n) => Array(5).fill(n)); // the corners of a box of the root cell and of a part of the picture

class Viewer {
  constructor() {
    this.canvas = element("picture");
    this.look = { shown: "lit", channel: "base_color", filter: "quadratic", level: 0 };
    Object.assign(this.look, { footprints: true, facing: true, cubes: false, marked: null, moved: null, divider: 0, relief: 0.02 });
    this.cost = 0; // milliseconds a pixel, as measured
    this.pictures = 0;
    this.isBegun = false; // the sharp picture; its parts that are still to be drawn, and near what, are in `jobs`
    this.jobs = [];
    this.finest = 2; // drawn pixels a pixel, at most, along both axes
  }

  async open() {
    const [header, shaders] = await Promise.all([readHeader(), readPrograms()]), studio = await readStream("studio");
    this.header = header;
    this.version = header.version;
    this.parts = header.parts.map((part) => new Part(part));
    this.gpu = new Gpu(this.canvas, shaders, [header.studio, studio], this.parts);
    this.camera = new Camera(...this.bounds());
    this.look.level = this.gpu.deepest;
    this.offer();
    this.describe();
    element("panel").open = !matchMedia("(max-width: 720px)").matches;
    control(this.canvas, this.camera, (x, y) => this.seen(x, y), (isHeld) => this.move(isHeld), () => this.rest());
    this.listen();
    this.gpu.draw(this.look, this.camera, 1, 1);
    const before = isServed ? kept() : null;
    await this.read(before?.camera);
    this.isComplete = true;
    keep(this.camera);
    if (before) restoreControls(before.controls);
    this.explain();
    if (header.session) this.painting = await (await import("./paint.js")).begin(this, header.session);
    this.move();
    this.follow(this.wanted ?? this.version);
  }

  // Read all data, coarse levels of all parts first. `place` is where the camera stood before.
  async read(place) {
    const { parts } = this;
    const images = parts[0].header.source?.bytes ?? [];
    const all = parts.flatMap(({ header }) => [...header.chunks, header.mesh, header.motion].filter(Boolean));
    const total = [...all.map((each) => each.bytes), ...images].reduce((sum, bytes) => sum + bytes, 0);
    let done = 0;
    const progress = (bytes) => {
      element("progress").value = (done += bytes) / total;
      element("progress-box").hidden = done >= total;
    };
    for (const [number, part] of parts.entries()) {
      const { mesh, source } = part.header;
      if (!mesh) continue;
      part.takeMesh(unpackedMesh(mesh, await readStream(`${number}-mesh`), source));
      progress(mesh.bytes);
    }
    if (parts.some((part) => part.mesh)) {
      this.camera = Object.assign(this.camera, new Camera(...this.bounds()));
      this.camera.aspect = this.canvas.clientWidth / this.canvas.clientHeight;
      this.camera.reset();
    }
    if (place) this.camera.restore(place);
    const most = Math.max(...parts.map(({ header }) => header.chunks.length));
    for (let n = 0; n < most; n++) {
      for (const [number, part] of parts.entries()) {
        const chunk = part.header.chunks[n], { octree } = part;
        if (!chunk) continue;
        const bytes = await readStream(`${number}-levels-${n}`);
        part.upload(chunk.levels ? octree.take(chunk, bytes) : octree.takeTables(bytes));
        progress(chunk.bytes);
        this.move();
      }
      await new Promise((resume) => requestAnimationFrame(resume));
    }
    const [first] = parts, { motion, source } = first.header;
    if (motion) {
      first.takeMotion(new Motion(motion, await readStream("0-motion")));
      this.player = new Player(motion, (moved) => this.play(moved));
      progress(motion.bytes);
    }
    if (source) {
      const options = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
      const read = async (bytes, number) => {
        const image = await createImageBitmap(await readFile(`0-map-${number}`), options);
        progress(bytes);
        return image;
      };
      first.takeSource(new Source(source, await Promise.all(images.map(read))));
      this.divider = new Divider((place) => {
        this.look.divider = place ?? 0;
        this.move();
      });
    }
  }

  // Show a version of the texture, once all of the one before has come: change by change, or all anew.
  async follow(version) {
    this.wanted = version;
    if (!this.isComplete || this.following || version === undefined) return;
    this.following = true;
    try {
      while (this.version !== this.wanted) {
        const change = await readChange(this.version);
        if (!change) {
          await this.painting?.sending.all();
          return reload();
        }
        const read = (name) => Promise.all(change.parts.map((part, number) => (name === "change" || part.isOther ? readStream(`${name}-${number}`) : null)));
        const [streams, added] = await Promise.all([read("change"), read("added")]), [first] = change.parts;
        const shown = this.painting?.strokes.sent ?? [], lookedUp = this.lookedUp;
        for (const [number, bytes] of streams.entries()) {
          const { header, counts } = change.parts[number];
          this.sent = this.parts[number].change(header, counts, bytes, added[number]);
        }
        this.version = change.version;
        if (first.isOther) {
          this.offerChannels();
          this.painting?.takeChannels();
        }
        this.painting?.arrived(change.session);
        this.describe();
        const gone = shown.filter((stroke) => !this.painting.strokes.sent.includes(stroke));
        if (first.touched && lookedUp === this.lookedUp) this.redraw(first.touched, gone);
        else this.move();
      }
    } catch (error) {
      console.warn(error); // the line is lost, which is said; the next version is told when it is there again
    } finally {
      this.following = false;
    }
  }

  // The lowest and the highest corner of what is drawn.
  bounds() {
    const all = this.parts.map((part) => part.bounds), join = (n, pick) => [0, 1, 2].map((axis) => pick(...all.map((each) => each[n][axis])));
    return [join(0, Math.min), join(1, Math.max)];
  }

  // Say what is shown.
  describe() {
    const { title } = this.header, headers = this.parts.map((part) => part.header), { look, gpu } = this;
    const sum = (of) => headers.reduce((total, header) => total + of(header), 0).toLocaleString("en");
    const depth = Math.max(...headers.map((header) => header.depth));
    document.title = `${title} – octex`;
    element("title").textContent = title;
    const lines = [`${sum(({ leaves }) => leaves)} cells, depth ${depth}`];
    if (headers.length > 1) lines.unshift(`${headers.length} parts`);
    const meshes = headers.map(({ mesh }) => mesh).filter(Boolean), without = meshes.some(({ coordinates }) => coordinates) ? "" : ", no texture coordinates";
    if (meshes.length) lines.push(`${sum(({ mesh }) => mesh?.triangles ?? 0)} triangles${without}`);
    const notes = headers.flatMap((header) => header.notes.map((note) => (header.name ? `${header.name}: ${note}` : note)));
    if (gpu.deepest < depth) notes.push(`this GPU's textures hold depth ${gpu.deepest}`);
    element("facts").textContent = [...lines, ...new Set(notes)].join("\n");
    const wasDeepest = look.level >= Number(element("level").max);
    element("level").max = gpu.deepest;
    if (wasDeepest || look.level > gpu.deepest) look.level = gpu.deepest;
    element("level").value = look.level;
    element("level-text").textContent = `${look.level}`;
    this.explain();
  }

  // Say what its colours stand for, and which cubes are too many.
  explain() {
    const { look, gpu, parts } = this, drawn = gpu.showsCubes(look) ? gpu.cubesLevel(look) : look.level;
    tellLegend(parts, { ...look, level: drawn });
    element("cubes-note").textContent = drawn < look.level ? `Level ${drawn} is drawn: level ${drawn + 1} has too many cubes.` : "";
  }

  // Offer what can be shown of the channels that there are.
  offerChannels() {
    const headers = this.parts.map((part) => part.header), { look } = this, before = element("shown").value;
    const channels = new Map(headers.flatMap((header) => header.channels).map((channel) => [channel.name, channel]));
    const choices = [["lit", "colours in studio light"], ["unlit", "colours without light"]];
    if (!channels.has("base_color")) choices.length = 0;
    for (const name of channels.keys()) choices.push([`channel ${name}`, name.replaceAll("_", " ")]);
    for (const { name, space } of channels.values()) {
      if (space === "direction") choices.push([`spread ${name}`, `how much ${name.replaceAll("_", " ")}s in a cell differ`]);
    }
    choices.push(["depth", "size of cells (levels)"], ["facing", "directions that cells face"]);
    element("shown").replaceChildren(...choices.map(([value, text]) => new Option(text, value)));
    const values = choices.map(([value]) => value);
    if (values.includes(before)) element("shown").value = before;
    else if (before || !channels.has("base_color")) this.choose(values[0]);
    element("relief-label").hidden = element("relief").hidden = !channels.has("height");
  }

  offer() {
    const headers = this.parts.map((part) => part.header), { look } = this;
    this.offerChannels();
    const hasMesh = headers.some(({ mesh }) => mesh);
    element("facing").checked = look.facing = headers.some(({ split }) => split[0] > 0);
    element("cubes").checked = !hasMesh;
    element("cubes").disabled = !hasMesh;
    element("level").max = look.level;
  }

  choose(value) {
    const [shown, channel] = value.split(" ");
    this.look.shown = shown;
    if (channel) this.look.channel = channel;
  }

  listen() {
    const { look } = this;
    const on = (id, change) => element(id).addEventListener("input", (event) => {
      change(event.target);
      this.move();
    });
    on("shown", (at) => this.choose(at.value));
    on("filter", (at) => (look.filter = at.value));
    on("footprints", (at) => (look.footprints = at.checked));
    on("facing", (at) => (look.facing = at.checked));
    on("cubes", (at) => (look.cubes = at.checked));
    on("relief", (at) => (look.relief = Number(at.value)));
    on("turntable", (at) => this.turn(at.checked));
    on("level", (at) => {
      look.level = Number(at.value);
      element("level-text").textContent = at.value;
    });
    for (const id of ["shown", "cubes", "level"]) element(id).addEventListener("input", () => this.explain());
    element("controls").addEventListener("submit", (event) => event.preventDefault());
    element("reset").addEventListener("click", () => {
      this.camera.reset();
      this.move();
    });
    element("save").addEventListener("click", () => this.save());
    element("save-camera").addEventListener("click", () => this.saveCamera());
    document.addEventListener("keydown", (event) => {
      const isTyping = event.target.matches("select, input") || event.ctrlKey || event.metaKey || event.altKey;
      const id = { b: "beside", c: "cubes", t: "turntable", s: "save", k: "save-camera", " ": "play" }[event.key];
      const isPressed = event.key === " " && event.target.matches("button, summary");
      if (!id || isTyping || isPressed || !element(id).checkVisibility()) return;
      event.preventDefault();
      if (!element(id).disabled) element(id).click();
    });
    new ResizeObserver(() => this.move()).observe(this.canvas);
    this.canvas.addEventListener("pointermove", (event) => event.buttons || this.point(event));
    this.canvas.addEventListener("pointerleave", () => this.point(null));
    this.canvas.addEventListener("keydown", ({ key, target, ctrlKey, metaKey, altKey }) => {
      const isMiddle = key === "p" && !ctrlKey && !metaKey && !altKey;
      if (isMiddle) this.point({ offsetX: target.clientWidth / 2, offsetY: target.clientHeight / 2 });
    });
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.isLost = true;
      element("status").textContent = "The GPU was lost; waiting for it.";
    });
    this.canvas.addEventListener("webglcontextrestored", () => {
      this.isLost = false;
      this.gpu.build();
      this.painting?.restore();
      element("status").textContent = "";
      this.move();
    });
  }

  // Draw the mesh as an animation has it; what the camera may see is then all that it ever reaches.
  play(moved) {
    if (moved?.animation !== this.look.moved?.animation) {
      const [low, high] = this.bounds(), reach = this.parts[0].header.motion.animations[moved?.animation]?.bounds;
      this.camera.low = low.map((x, n) => Math.min(x, reach?.[0][n] ?? x));
      this.camera.high = high.map((x, n) => Math.max(x, reach?.[1][n] ?? x));
    }
    this.look.moved = moved;
    this.move();
  }

  turn(on) {
    this.turning = on ? performance.now() : null;
  }

  // Something has changed: draw soon, and sharply once nothing changes.
  move(isHeld = false) {
    this.due = performance.now() + (isHeld ? HELD : STILL);
    this.isDrawn = this.isBegun = false;
    this.jobs = [];
    this.again();
  }

  // Nothing changes any more: draw sharply at once.
  rest() {
    this.due = 0;
  }

  get isSharp() {
    return this.isBegun && !this.jobs.length && !this.near;
  }

  // Draw what waits for the next frame, for one who asks what is seen now.
  drawNow() {
    if (!this.isDrawn) this.frame();
  }

  again() {
    this.asked ||= requestAnimationFrame(() => this.frame());
  }

  frame() {
    this.asked = 0;
    if (this.isLost || this.parts.every((part) => part.octree.depth < 0) || !this.canvas.clientWidth) return;
    const now = performance.now();
    if (this.turning) {
      this.camera.orbit(((now - this.turning) / 1000) * TURN, 0);
      this.turning = now;
      this.move();
    }
    if (this.player?.step(now)) this.move();
    const isStill = now > this.due && this.isComplete;
    const full = Math.min(window.devicePixelRatio || 1, 2);
    const pixels = this.canvas.clientWidth * this.canvas.clientHeight * full * full;
    const part = this.cost ? Math.sqrt(FRAME / (this.cost * pixels)) : 0.4;
    // Where there is time, a picture that stands still is drawn larger than it is shown: its edges are then smooth.
    const finest = this.cost * pixels * this.finest ** 2 < 2 * FRAME ? this.finest : Math.min(this.finest, 1);
    try {
      if (isStill && !this.isBegun && !this.painting?.pen) this.sharpen(full * finest);
      else if (!this.isDrawn) this.draw(full * Math.min(Math.max(part, 0.08), 1));
      if (this.near) this.jobs.push(...this.tiles(this.near));
      this.near = null;
      if (!this.painting?.pen) {
        this.painting?.flat.refresh();
        this.work();
      }
    } catch (error) {
      return fail(error);
    }
    if (!this.isDrawn) { this.isDrawn = true; this.painting?.drawn(); }
    if (this.gpu.makesCubes) this.move();
    else if (!this.isSharp || this.turning) this.again();
  }

  // Begin the sharp picture: what was drawn last, until part after part is drawn. No change waits for more than one of them.
  sharpen(scale) {
    const { gpu, look, camera, parts } = this, [width, height] = this.begin(scale);
    this.isBegun = true;
    if (gpu.showsCubes(look) || parts.some((part) => part.hasAlpha)) return gpu.draw(look, camera, width, height);
    gpu.resize(look, camera, width, height);
    this.jobs = this.tiles(null);
    this.spent = this.area = 0;
  }

  // Parts of the picture (left, bottom, width, height) that take less than a frame each, those in the middle first.
  tiles(near) {
    const { width, height } = this.canvas, jobs = [];
    const side = (near ? 2 : 1) * Math.max(this.cost ? Math.sqrt(FRAME / this.cost) : FIRST_TILE, LEAST_TILE); // little is near
    const [across, down] = [width, height].map((pixels) => Math.ceil(pixels / side)), at = (n, count, pixels) => Math.round((n * pixels) / count);
    for (let row = 0; row < down; row++) {
      for (let column = 0; column < across; column++) {
        const [left, right] = [column, column + 1].map((n) => at(n, across, width)), [bottom, top] = [row, row + 1].map((n) => at(n, down, height));
        jobs.push({ near, part: [left, bottom, right - left, top - bottom], far: Math.hypot(left + right - width, bottom + top - height) });
      }
    }
    return jobs.sort((a, b) => a.far - b.far);
  }

  // Draw parts that are to be drawn, as many as a frame has time for.
  work() {
    const { gpu, look, camera, canvas: { width, height } } = this, began = performance.now();
    while (this.jobs.length && performance.now() - began < FRAME) {
      const { near, part } = this.jobs.shift(), before = performance.now();
      gpu.draw(look, camera, width, height, part, near);
      gpu.finish();
      if (near) continue;
      this.spent += performance.now() - before;
      this.cost = this.spent / (this.area += part[2] * part[3]);
    }
  }

  // Draw a part of the picture anew, in CSS pixels from the upper left, where nothing else has changed.
  drawPart([left, top, right, bottom]) {
    if (!this.isDrawn || this.isLost) return this.move(true);
    const { canvas, gpu } = this, across = canvas.width / canvas.clientWidth, down = canvas.height / canvas.clientHeight;
    const x = Math.max(Math.floor(left * across), 0), y = Math.max(Math.floor(canvas.height - bottom * down), 0);
    const width = Math.min(Math.ceil(right * across), canvas.width) - x;
    const height = Math.min(Math.ceil(canvas.height - top * down), canvas.height) - y;
    if (width > 0 && height > 0) gpu.draw(this.look, this.camera, canvas.width, canvas.height, [x, y, width, height]);
  }

  // What the picture is of: where the camera stands, and how the model is posed.
  get viewed() {
    const { camera, look } = this;
    return `${camera.view} ${JSON.stringify([look.moved, look.patch])}`;
  }

  // How textures are looked up: where that stays, a picture does so that is not near a change.
  get lookedUp() {
    return JSON.stringify([this.look.level, ...this.parts.map(({ header: { depth, isMixed, kept, split } }) => [depth, isMixed, kept > 0, split[0] > 0])]);
  }

  // Draw anew what is near a box of the root cell, if one is touched, and where strokes were that are now in the texture.
  redraw(touched, strokes) {
    const { gpu, parts, painting, view } = this, [far] = NOWHERE[0];
    const isSame = this.isDrawn && !this.isLost && view === this.viewed && strokes.every(() => painting.strokes.view === view);
    if (!isSame || gpu.showsCubes(this.look) || parts.some((part) => part.hasAlpha)) return this.move();
    const boxes = touched.length ? [[[...touched[0], far, far], [...touched[1], -far, -far]]] : [];
    for (const { box: [left, top, right, bottom] } of strokes) {
      const [width, height] = painting.strokes.size, place = (x, y) => [x / width, 1 - y / height];
      boxes.push([[far, far, far, ...place(left - 2, bottom + 2)], [-far, -far, -far, ...place(right + 2, top - 2)]]);
    }
    for (const [low, high] of boxes) {
      const [least, most] = this.near ?? NOWHERE;
      this.near = [least.map((x, n) => Math.min(x, low[n])), most.map((x, n) => Math.max(x, high[n]))];
    }
    this.again();
  }

  // Make ready for a picture of so many pixels a CSS pixel; returns its size.
  begin(scale) {
    const { canvas, camera } = this;
    this.near = null;
    this.jobs = [];
    this.view = this.viewed;
    camera.aspect = canvas.clientWidth / canvas.clientHeight;
    this.pictures++;
    return [canvas.clientWidth, canvas.clientHeight].map((pixels) => Math.max(Math.round(pixels * scale), 1));
  }

  draw(scale) {
    const [width, height] = this.begin(scale), began = performance.now(), programs = this.gpu.programs.size;
    this.gpu.draw(this.look, this.camera, width, height);
    this.gpu.finish();
    if (programs === this.gpu.programs.size) this.cost = (performance.now() - began) / (width * height);
  }

  // The size of pictures that are saved, in pixels, and their names without ending.
  get film() {
    const times = Math.min(window.devicePixelRatio || 1, 2), of = (pixels) => Math.max(Math.round(pixels * times), 1);
    const name = this.header.title.replace(/\.[^.]*$/, "");
    return { times, name, width: of(this.canvas.clientWidth), height: of(this.canvas.clientHeight) };
  }

  save() {
    const { times, name } = this.film;
    this.draw(times);
    this.canvas.toBlob((blob) => download(`${name}.png`, blob));
  }

  saveCamera() {
    const { name, width, height } = this.film, file = this.camera.file(`${name}.png`, width, height);
    download(`${name}-camera.json`, new Blob([JSON.stringify(file)], { type: "application/json" }));
  }

  // Say what lies under the cursor, once it rests.
  point(event) {
    clearTimeout(this.pointing);
    if (!event || !this.isComplete || this.isLost) return this.tell(null);
    const at = [event.offsetX, event.offsetY];
    this.pointing = setTimeout(() => this.tell(this.pick(...at)), 60);
  }

  // The point of the model that is seen at a place of the picture, in CSS pixels; or null.
  seen(x, y) {
    if (!this.isComplete || this.isLost) return null;
    const size = [this.canvas.clientWidth, this.canvas.clientHeight], away = this.gpu.awayAt(this.look, this.camera, [x, y], size);
    return away && this.camera.pointAt([x + 0.5, y + 0.5], size, away);
  }

  // What lies at a point of the picture, in CSS pixels, see pointed.js; or null.
  pick(x, y) {
    return pointed(this, [x, y]);
  }

  tell(found) {
    const { marked } = this.look, isNew = marked?.cell !== found?.cell || marked?.part !== found?.part;
    if (this.cost * this.canvas.width * this.canvas.height < FRAME && isNew) {
      this.look.marked = found;
      this.move();
    }
    describePoint(found);
  }
}

function fail(error) {
  element("progress-box").hidden = true;
  element("message").hidden = false;
  element("message").textContent = `Nothing can be shown: ${error.message}.`;
  console.error(error);
}

const viewer = new Viewer();
globalThis.viewer = viewer;
viewer.open().catch(fail);
watch(element("status"), (version) => viewer.follow(version));
