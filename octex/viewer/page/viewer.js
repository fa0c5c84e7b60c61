// The page: loads a texture and its mesh, shows them, and follows changes of the texture.

import { Camera } from "./camera.js";
import { addControls } from "./controls.js";
import { ReloadError, isServed, readChange, readFile, readHeader, readStream } from "./data.js";
import { Divider } from "./divider.js";
import { download, element } from "./elements.js";
import { Frames } from "./frames.js";
import { Gpu } from "./gpu.js";
import { reload, rememberCamera, restoreControls, savedState } from "./reload.js";
import { showLegend } from "./legend.js";
import { unpackedMesh } from "./mesh.js";
import { Motion } from "./motion.js";
import { Part } from "./part.js";
import { listPicked, pickAt } from "./pick.js";
import { Player } from "./player.js";
import { readViewerShaders } from "./programs.js";
import { Source } from "./source.js";
import { watch } from "./connection.js";

const HIGHLIGHT_TIME = 80; // milliseconds: cells are highlighted only if an image takes less
const PICK_DELAY = 60; // milliseconds for which the pointer must rest
const TURNTABLE_SPEED = 0.35; // radians a second

class Viewer extends Frames {
  constructor() {
    super();
    this.canvas = element("image");
    // How the model is displayed; passed to the GPU for each image.
    this.display = {
      mode: "lit", // or "unlit", "channel", "spread" of directions, "depth" of cells, "facing"
      channel: "base_color",
      filter: "quadratic", // or "nearest", "linear"
      level: 0, // the finest level
      footprints: true, // average over pixels; else sample leaves
      facing: true, // split cells show the side that the camera sees
      cubes: false,
      highlight: null, // the picked cell
      moment: null, // { animation, time }; null: the model as loaded
      patch: null, // the patch that is laid flat, see flat.js
      divider: 0, // share of the view that shows the model's images
      relief: 0.02, // displacement of height 1, in root cells
      strokes: null, // that the texture does not have yet
    };
  }

  async open() {
    const [header, shaders] = await Promise.all([readHeader(), readViewerShaders()]), studio = await readStream("studio");
    this.header = header;
    this.version = header.version;
    this.parts = header.parts.map((part) => new Part(part));
    this.gpu = new Gpu(this.canvas, shaders, [header.studio, studio], this.parts);
    this.camera = new Camera(...this.bounds());
    this.display.level = this.gpu.deepest;
    this.initControls();
    this.showFacts();
    element("panel").open = !matchMedia("(max-width: 720px)").matches;
    addControls(this.canvas, this.camera, {
      surfaceAt: (x, y) => this.surfaceAt(x, y), changed: (isHeld) => this.invalidate(isHeld), released: () => this.sharpenNow(),
    });
    this.listen();
    this.gpu.draw(this.display, this.camera, 1, 1); // compiles the programs while data loads
    const saved = isServed ? savedState() : null;
    await this.load(saved?.camera);
    this.isLoaded = true;
    rememberCamera(this.camera);
    if (saved) restoreControls(saved.controls);
    this.showLegend();
    if (header.session) this.painting = await (await import("./paint.js")).startPainting(this, header.session);
    this.invalidate();
    this.canUpdate = true;
    this.update(this.latestVersion ?? this.version);
  }

  // Load all data: meshes, then the coarse levels of all parts, then finer ones. `savedCamera` is its state before a reload.
  async load(savedCamera) {
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
      part.setMesh(unpackedMesh(mesh, await readStream(`${number}-mesh`), source));
      progress(mesh.bytes);
    }
    if (parts.some((part) => part.mesh)) {
      Object.assign(this.camera, new Camera(...this.bounds()));
      this.camera.aspect = this.canvas.clientWidth / this.canvas.clientHeight;
      this.camera.reset();
    }
    if (savedCamera) this.camera.restore(savedCamera);
    const chunkCount = Math.max(...parts.map(({ header }) => header.chunks.length));
    for (let n = 0; n < chunkCount; n++) {
      for (const [number, part] of parts.entries()) {
        const chunk = part.header.chunks[n];
        if (!chunk) continue;
        part.upload(part.octree.readChunk(chunk, await readStream(`${number}-levels-${n}`)));
        progress(chunk.bytes);
        this.invalidate();
      }
      await new Promise((resume) => requestAnimationFrame(resume));
    }
    const [first] = parts, { motion, source } = first.header;
    if (motion) {
      first.setMotion(new Motion(motion, await readStream("0-motion")));
      this.player = new Player(motion, (moment) => this.setMoment(moment));
      progress(motion.bytes);
    }
    if (source) {
      const options = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
      const read = async (bytes, number) => {
        const image = await createImageBitmap(await readFile(`0-map-${number}`), options);
        progress(bytes);
        return image;
      };
      first.setSource(new Source(source, await Promise.all(images.map(read))));
      this.divider = new Divider((position) => {
        this.display.divider = position ?? 0;
        this.invalidate();
      });
    }
  }

  // Show a version of the texture: apply change after change, or reload the page if the server has not all of them. Versions
  // that arrive meanwhile are shown next.
  async update(version) {
    this.latestVersion = version;
    if (!this.canUpdate || this.isUpdating || version === undefined) return;
    this.isUpdating = true;
    try {
      while (this.version !== this.latestVersion) this.applyChange(...(await this.readChange()));
    } catch (error) {
      if (!(error instanceof ReloadError)) return console.warn(error); // the connection is lost; the next one announces the version again
      await this.painting?.commands.flush();
      reload();
    } finally {
      this.isUpdating = false;
    }
  }

  async readChange() {
    const change = await readChange(this.version);
    const read = (name) => Promise.all(change.parts.map((part, number) => (name === "change" || part.hasNewChannels ? readStream(`${name}-${number}`) : null)));
    return [change, ...(await Promise.all([read("change"), read("added")]))];
  }

  applyChange(change, streams, added) {
    const [{ touched, hasNewChannels }] = change.parts, sentBefore = this.painting?.strokes.sent ?? [], { lookupKey } = this;
    try {
      for (const [number, bytes] of streams.entries()) {
        const { header, counts } = change.parts[number];
        this.uploadedRows = this.parts[number].change(header, counts, bytes, added[number]);
      }
    } catch (error) {
      throw new ReloadError(error.message); // the octree may be changed in part
    }
    this.version = change.version;
    if (hasNewChannels) {
      this.showModes();
      this.painting?.channelsChanged();
    }
    this.painting?.setStatus(change.session);
    this.showFacts();
    const finished = sentBefore.filter((stroke) => !this.painting.strokes.sent.includes(stroke));
    if (touched && lookupKey === this.lookupKey) this.redraw(touched, finished);
    else this.invalidate();
  }

  // The lowest and the highest corner of all parts.
  bounds() {
    const all = this.parts.map((part) => part.bounds), join = (n, pick) => [0, 1, 2].map((axis) => pick(...all.map((each) => each[n][axis])));
    return [join(0, Math.min), join(1, Math.max)];
  }

  // Show the title, sizes, notes, and the range of levels.
  showFacts() {
    const { title } = this.header, headers = this.parts.map((part) => part.header), { display, gpu } = this;
    const sum = (of) => headers.reduce((total, header) => total + of(header), 0).toLocaleString("en");
    const depth = Math.max(...headers.map((header) => header.depth));
    document.title = `${title} – octex`;
    element("title").textContent = title;
    const lines = [`${sum(({ leaves }) => leaves)} cells, depth ${depth}`];
    if (headers.length > 1) lines.unshift(`${headers.length} parts`);
    const meshes = headers.map(({ mesh }) => mesh).filter(Boolean), missing = meshes.some(({ coordinates }) => coordinates) ? "" : ", no texture coordinates";
    if (meshes.length) lines.push(`${sum(({ mesh }) => mesh?.triangles ?? 0)} triangles${missing}`);
    const notes = headers.flatMap((header) => header.notes.map((note) => (header.name ? `${header.name}: ${note}` : note)));
    if (gpu.deepest < depth) notes.push(`this GPU's textures hold depth ${gpu.deepest}`);
    element("facts").textContent = [...lines, ...new Set(notes)].join("\n");
    const wasFinest = display.level >= Number(element("level").max);
    element("level").max = gpu.deepest;
    if (wasFinest || display.level > gpu.deepest) display.level = gpu.deepest;
    element("level").value = display.level;
    element("level-text").textContent = `${display.level}`;
    this.showLegend();
  }

  showLegend() {
    const { display, gpu, parts } = this, drawn = gpu.showsCubes(display) ? gpu.cubesLevel(display) : display.level;
    showLegend(parts, display.mode, drawn);
    element("cubes-note").textContent = drawn < display.level ? `Level ${drawn} is drawn: level ${drawn + 1} has too many cubes.` : "";
  }

  // Fill the list of display modes for the texture's channels; the chosen one stays if it can.
  showModes() {
    const headers = this.parts.map((part) => part.header), before = element("mode").value;
    const channels = new Map(headers.flatMap((header) => header.channels).map((channel) => [channel.name, channel]));
    const hasColor = channels.has("base_color"), choices = hasColor ? [["lit", "colours in studio light"], ["unlit", "colours without light"]] : [];
    for (const name of channels.keys()) choices.push([`channel ${name}`, name.replaceAll("_", " ")]);
    for (const { name, space } of channels.values()) {
      if (space === "direction") choices.push([`spread ${name}`, `variation of ${name.replaceAll("_", " ")}s in a cell`]);
    }
    choices.push(["depth", "size of cells (levels)"], ["facing", "facings of cells"]);
    element("mode").replaceChildren(...choices.map(([value, text]) => new Option(text, value)));
    const values = choices.map(([value]) => value);
    if (values.includes(before)) element("mode").value = before;
    else if (before || !hasColor) this.setMode(values[0]);
    element("relief-label").hidden = element("relief").hidden = !channels.has("height");
  }

  initControls() {
    const headers = this.parts.map((part) => part.header), { display } = this;
    this.showModes();
    const hasMesh = headers.some(({ mesh }) => mesh);
    element("facing").checked = display.facing = headers.some(({ split }) => split[0] > 0);
    element("cubes").checked = !hasMesh;
    element("cubes").disabled = !hasMesh;
    element("level").max = display.level;
  }

  // Set the display mode, with a channel after it if the mode needs one.
  setMode(value) {
    const [mode, channel] = value.split(" ");
    this.display.mode = mode;
    if (channel) this.display.channel = channel;
  }

  listen() {
    const { display } = this;
    const on = (id, change) => element(id).addEventListener("input", (event) => {
      change(event.target);
      this.invalidate();
    });
    on("mode", (control) => this.setMode(control.value));
    on("filter", (control) => (display.filter = control.value));
    on("footprints", (control) => (display.footprints = control.checked));
    on("facing", (control) => (display.facing = control.checked));
    on("cubes", (control) => (display.cubes = control.checked));
    on("relief", (control) => (display.relief = Number(control.value)));
    on("turntable", (control) => this.setTurntable(control.checked));
    on("level", (control) => {
      display.level = Number(control.value);
      element("level-text").textContent = control.value;
    });
    for (const id of ["mode", "cubes", "level"]) element(id).addEventListener("input", () => this.showLegend());
    element("controls").addEventListener("submit", (event) => event.preventDefault());
    element("reset").addEventListener("click", () => {
      this.camera.reset();
      this.invalidate();
    });
    element("save").addEventListener("click", () => this.saveImage());
    element("save-camera").addEventListener("click", () => this.saveCamera());
    document.addEventListener("keydown", (event) => {
      const isTyping = event.target.matches("select, input") || event.ctrlKey || event.metaKey || event.altKey;
      const id = { b: "compare", c: "cubes", t: "turntable", s: "save", k: "save-camera", " ": "play" }[event.key];
      const isPress = event.key === " " && event.target.matches("button, summary");
      if (!id || isTyping || isPress || !element(id).checkVisibility()) return;
      event.preventDefault();
      if (!element(id).disabled) element(id).click();
    });
    new ResizeObserver(() => this.invalidate()).observe(this.canvas);
    this.canvas.addEventListener("pointermove", (event) => event.buttons || this.pickSoon(event));
    this.canvas.addEventListener("pointerleave", () => this.pickSoon(null));
    this.canvas.addEventListener("keydown", ({ key, target, ctrlKey, metaKey, altKey }) => {
      const picksMiddle = key === "p" && !ctrlKey && !metaKey && !altKey;
      if (picksMiddle) this.pickSoon({ offsetX: target.clientWidth / 2, offsetY: target.clientHeight / 2 });
    });
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault(); // else the browser does not restore it
      this.isContextLost = true;
      element("status").textContent = "The browser lost the GPU; waiting for it.";
    });
    this.canvas.addEventListener("webglcontextrestored", () => {
      this.isContextLost = false;
      this.gpu.build();
      this.painting?.restoreContext();
      element("status").textContent = "";
      this.invalidate();
    });
  }

  // Pose the mesh; the camera's bounds then hold the whole animation.
  setMoment(moment) {
    if (moment?.animation !== this.display.moment?.animation) {
      const [low, high] = this.bounds(), reach = this.parts[0].header.motion.animations[moment?.animation]?.bounds;
      this.camera.low = low.map((x, n) => Math.min(x, reach?.[0][n] ?? x));
      this.camera.high = high.map((x, n) => Math.max(x, reach?.[1][n] ?? x));
    }
    this.display.moment = moment;
    this.invalidate();
  }

  setTurntable(isOn) {
    element("turntable").checked = isOn;
    this.turnedAt = isOn ? performance.now() : null;
  }

  get isTurning() {
    return this.turnedAt > 0;
  }

  // Advance the turntable and the animation.
  animate(now) {
    if (this.isTurning) {
      this.camera.orbit(((now - this.turnedAt) / 1000) * TURNTABLE_SPEED, 0);
      this.turnedAt = now;
      this.invalidate();
    }
    if (this.player?.step(now)) this.invalidate();
  }

  // The size of saved images and of strokes, in pixels of the screen.
  get screenSize() {
    const { pixelRatio, canvas } = this, pixels = (length) => Math.max(Math.round(length * pixelRatio), 1);
    return { pixelRatio, width: pixels(canvas.clientWidth), height: pixels(canvas.clientHeight) };
  }

  // The name of downloads, without ending.
  get fileName() {
    return this.header.title.replace(/\.[^.]*$/, "");
  }

  saveImage() {
    this.draw(this.pixelRatio);
    this.canvas.toBlob((blob) => download(`${this.fileName}.png`, blob));
  }

  saveCamera() {
    const { fileName, screenSize: { width, height } } = this, file = this.camera.file(`${fileName}.png`, width, height);
    download(`${fileName}-camera.json`, new Blob([JSON.stringify(file)], { type: "application/json" }));
  }

  // Show the cell under the pointer, once it rests; null if the pointer is elsewhere.
  pickSoon(event) {
    clearTimeout(this.pickTimer);
    if (!event || !this.isLoaded || this.isContextLost) return this.showPicked(null);
    const { offsetX, offsetY } = event;
    this.pickTimer = setTimeout(() => this.showPicked(this.pick(offsetX, offsetY)), PICK_DELAY);
  }

  // The point of the model at a position of the image, in CSS pixels; null for the background.
  surfaceAt(x, y) {
    if (!this.isLoaded || this.isContextLost) return null;
    const size = [this.canvas.clientWidth, this.canvas.clientHeight], depth = this.gpu.depthAt(this.display, this.camera, [x, y], size);
    return depth && this.camera.pointAt([x + 0.5, y + 0.5], size, depth);
  }

  // Pick at a position of the image, in CSS pixels; see pick.js.
  pick(x, y) {
    return this.isContextLost ? null : pickAt(this, [x, y]);
  }

  showPicked(picked) {
    const { highlight } = this.display, isNew = highlight?.cell !== picked?.cell || highlight?.part !== picked?.part;
    if (this.pixelTime * this.canvas.width * this.canvas.height < HIGHLIGHT_TIME && isNew) {
      this.display.highlight = picked;
      this.invalidate();
    }
    listPicked(picked);
  }

  fail(error) {
    element("progress-box").hidden = true;
    element("message").hidden = false;
    element("message").textContent = `Nothing can be shown: ${error.message}.`;
    console.error(error);
  }
}

const viewer = new Viewer();
globalThis.viewer = viewer;
viewer.open().catch((error) => (error instanceof ReloadError ? reload() : viewer.fail(error)));
watch(element("status"), (version) => viewer.update(version));
