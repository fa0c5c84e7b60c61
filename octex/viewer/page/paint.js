// Painting: the panel, pointers and keys, and the status of the server's session. See tools.js, stroke.js and commands.js.

import { CommandQueue } from "./commands.js";
import { readShaders } from "./data.js";
import { element, make } from "./elements.js";
import { External } from "./external.js";
import { Exporting } from "./exporting.js";
import { Flat } from "./flat.js";
import { hitAt, isHitIn } from "./hit.js";
import { onDrop } from "./images.js";
import { Layers } from "./layers.js";
import { Material } from "./material.js";
import { Outline } from "./outline.js";
import { Palette } from "./palette.js";
import { BLENDS, Settings, icon, iconButton, section, slider } from "./panel.js";
import { Preview } from "./preview.js";
import { ResizeDrag } from "./resize.js";
import { Retouch } from "./retouch.js";
import { Stencil } from "./stencil.js";
import { DEFAULT_ANGLE, Strokes } from "./stroke.js";
import { TOOLS, pickPaint, pressMiddle } from "./tools.js";

const MIN_SIZE = 1, MAX_SIZE = 400; // of the brush
const SIZE_STEP = 1.15; // by a key
const LONG = 1000; // milliseconds after which a command is said to take long
const MIN_PRESSURE = 0.15; // share of the size at the lightest touch of a pen
const MODEL_UNIT = 0.001; // of the root cell's edge: the unit of sizes on the model
const BRUSH_KEY = "octex-brush"; // in the session storage: the brush survives a reload
const THEME_KEY = "octex-theme"; // in the local storage
const SHADERS = ["stroke.frag", "dabs.frag", "retouch.frag", "outline.frag"];
const BACKGROUNDS = { dark: [0.155, 0.165, 0.18, 1], light: [0.925, 0.93, 0.94, 1] };

const KEYS = TOOLS.map(({ key, text }) => `${key.toUpperCase()} ${text.toLowerCase()}`).join(", ");
const HELP = [
  "Drag where the brush touches the model to paint, elsewhere or with the middle button to turn, with the right button to move; wheel or pinch zooms.",
  "Shift draws straight lines, Ctrl changes the brush’s size and hardness, Alt picks a colour.",
  `Keys: ${KEYS}, X swaps the two colours, [ and ] size, Enter presses in the middle of the view, Ctrl+Z undo, Ctrl+S save; 0 shows all, 1 to 6 look along the axes, C cubes, T turns automatically.`,
].join(" ");

export async function startPainting(viewer, status) {
  const painting = new Painting(viewer);
  await painting.open();
  painting.setStatus(status);
  return painting;
}

class Painting {
  constructor(viewer) {
    this.viewer = viewer;
    this.brush = { color: [200, 60, 40], size: 40, unit: "pixels", hardness: 0.7, opacity: 1, flow: 1, spacing: 0.1, smoothing: 0, pressure: "size", blend: "over" };
    Object.assign(this.brush, { angle: DEFAULT_ANGLE, backFaces: false, hidden: false, onePart: false, mirror: "", mirrorPosition: 0, fills: "part", tolerance: 12 });
    Object.assign(this.brush, { channels: ["base_color"], values: {}, recent: [] }, JSON.parse(sessionStorage.getItem(BRUSH_KEY)));
    this.secondColor = [245, 245, 245];
    this.layers = new Layers(this);
    this.commands = new CommandQueue((text) => this.showMessage(text), () => this.layers.target, () => this.showSaved());
    this.strokes = new Strokes(viewer);
    this.preview = new Preview(this);
    this.exporting = new Exporting(this);
    this.flat = new Flat(this);
    this.outline = new Outline(viewer);
    this.palette = new Palette(this);
    this.pen = null; // the pointer that drags: its id and type, its first event, and the drag
    this.hit = null; // the surface under the pointer, see hit.js
    this.lastEnd = null; // the end of the last stroke: a point of the model, and its pose
    this.shownReason = ""; // the last reason why nothing could be painted
    this.status = { steps: [], done: 0, finished: {} }; // of the server's session, see _shown in octex/session/painting.py
  }

  async open() {
    const { viewer } = this, { shaders } = viewer.gpu.programs;
    Object.assign(shaders, await readShaders(SHADERS));
    await new Promise((go) => document.head.append(make("link", { rel: "stylesheet", href: "paint.css", onload: go, onerror: go })));
    document.documentElement.classList.add("paints");
    this.main = document.querySelector("main");
    this.build();
    this.stencil = new Stencil(this);
    this.retouch = new Retouch(this);
    this.external = new External(this);
    onDrop((file) => this.external.take(file), (text) => this.showMessage(text));
    viewer.display.strokes = this.strokes;
    this.strokes.build();
    const preferred = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
    this.setTheme(localStorage.getItem(THEME_KEY) ?? preferred);
    this.listen();
  }

  // Build the tools beside the image, and the panel.
  build() {
    const toolButton = ({ name, text, key, shownKey = key.toUpperCase() }) => {
      const attributes = { type: "button", id: `tool-${name}`, title: `${text} (${shownKey})`, "aria-pressed": "false", onclick: () => this.selectTool(name) };
      return make("button", attributes, icon(name), make("span", {}, text));
    };
    this.tools = make("nav", { id: "tools", "aria-label": "Tools" }, ...TOOLS.map(toolButton));
    this.stage = element("stage");
    this.stage.append(this.outline.ring, this.outline.string);
    this.main.before(this.tools, this.flat.bar);
    this.main.append(this.flat.canvas, make("p", { id: "paint-note", role: "status" }));
    const [minLog, maxLog] = [MIN_SIZE, MAX_SIZE].map(Math.log);
    const share = { min: 0, max: 1, step: 0.01 }, settings = (this.settings = new Settings("", () => this.brush, (change) => this.set(change)));
    this.material = new Material(this);
    const toggleTheme = () => this.setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
    const toggleFolded = ({ currentTarget }) => (currentTarget.ariaExpanded = !document.querySelector("aside").classList.toggle("folded"));
    const painting = make("section", { id: "painting", "aria-label": "Painting" },
      make("header", {},
        make("div", { class: "bar" },
          iconButton("undo", "undo", "Undo (Ctrl+Z)", () => this.undo()),
          iconButton("redo", "redo", "Redo (Ctrl+Shift+Z)", () => this.redo()),
          iconButton("store", "save", "Save (Ctrl+S)", () => this.save()),
          iconButton("theme", "theme", "Dark or light", toggleTheme),
          iconButton("fold", "fold", "Panel", toggleFolded)),
        make("p", { id: "saved", role: "status" })),
      make("div", { id: "question", role: "alert", hidden: true }),
      ...this.palette.elements,
      ...slider("size", "Size", { min: minLog, max: maxLog, step: 0.01 }, (x) => this.set({ size: Math.round(Math.exp(x)) })),
      ...settings.slider("hardness", "Hardness", share),
      ...settings.slider("opacity", "Opacity", { ...share, min: 0.01 }),
      ...settings.choice("blend", "Blend mode", BLENDS),
      section("brush-section", "Brush",
        ...settings.choice("unit", "Size in", [["pixels", "pixels of the screen"], ["model", "the model’s units"]], (unit) => this.setUnit(unit)),
        ...settings.slider("flow", "Flow", { ...share, min: 0.01 }),
        ...settings.slider("spacing", "Spacing", { min: 0.05, max: 2, step: 0.05 }),
        ...settings.slider("smoothing", "Smoothing", { min: 0, max: 100, step: 1 }, (pixels) => (pixels ? `${pixels} px behind` : "off")),
        ...settings.choice("pressure", "Pen pressure controls", [["size", "the size"], ["opacity", "the opacity"], ["both", "both"], ["", "nothing"]])),
      this.material.section,
      section("where", "Where to paint",
        ...settings.slider("angle", "Largest angle to the view", { min: 5, max: 90, step: 1 }, (angle) => (angle === 90 ? "any" : `${angle}°`)),
        settings.check("backFaces", "back faces too"),
        settings.check("hidden", "hidden surface too"),
        settings.check("onePart", "only the part where a stroke starts"),
        ...settings.choice("mirror", "Mirror", [["", "off"], ...["x", "y", "z"].map((axis) => [axis, `along ${axis}`])]),
        ...settings.slider("mirrorPosition", "Mirror plane", { min: -50, max: 50, step: 0.5 }, (position) => (position ? `${position} % from the middle` : "middle"), ({ mirror }) => mirror)),
      section("filling", "Fill",
        ...settings.choice("fills", "A click fills", [["part", "the part"], ["color", "the connected colour"], ["colors", "the colour everywhere"], ["all", "the whole model"]]),
        ...settings.slider("tolerance", "Tolerance", { min: 0, max: 100, step: 1 }, (codes) => `${codes} of 255`, ({ fills }) => fills.startsWith("color"))),
      this.layers.build(),
      section("history", "Steps", make("ol", { id: "steps", onclick: (event) => this.goToStep(event.target.closest("li")) })),
      this.exporting.section);
    document.querySelector("aside").prepend(painting);
    element("help").textContent = HELP;
    element("history").open = true;
    element("panel").open = false;
    element("fold").ariaExpanded = true;
    this.layers.show();
    this.selectTool("brush");
    this.set({});
  }

  selectTool(name) {
    const tool = TOOLS.find((each) => each.name === name);
    if (tool.selected?.(this)) return;
    this.tool?.left?.(this);
    if (!this.tool?.isMomentary) this.lastTool = this.tool;
    this.openSettings(tool.settings);
    this.tool = tool;
    for (const button of this.tools.children) button.setAttribute("aria-pressed", String(button.id === `tool-${name}`));
    this.main.dataset.tool = name;
    this.main.classList.toggle("hasRing", Boolean(this.tool.hasRing));
    if (this.pointer) this.showOutline(this.pointer);
    this.preview.load();
  }

  // Open a tool's section and scroll to it; close the one that the last tool opened.
  openSettings(name) {
    const section = name && element(name);
    if (this.openedSection && this.openedSection !== section) this.openedSection.open = false;
    if (!section?.open) this.openedSection = section;
    if (section) section.open = true;
    section?.scrollIntoView({ block: "nearest" });
  }

  // Change settings of the brush, and show all of them.
  set(change) {
    const { brush } = this;
    Object.assign(brush, change);
    brush.size = Math.min(Math.max(brush.size, MIN_SIZE), MAX_SIZE);
    brush.hardness = Math.min(Math.max(brush.hardness, 0), 1);
    this.palette.show();
    element("size").value = Math.log(brush.size);
    element("size-text").textContent = this.sizeText;
    this.settings.show();
    this.material.show();
    if (this.pointer) this.showOutline(this.pointer);
  }

  // The distance of the mirror plane from the model's middle.
  get mirrorOffset() {
    const { mirror, mirrorPosition } = this.brush, axis = "xyz".indexOf(mirror);
    if (!mirror || !mirrorPosition) return 0;
    const [low, high] = this.flat.views?.model.bounds ?? this.viewer.bounds();
    return (mirrorPosition / 100) * (high[axis] - low[axis]);
  }

  get sizeText() {
    const { size, unit } = this.brush;
    return unit === "pixels" ? `${size} px` : `${Number((size * this.modelUnit).toPrecision(2))}`;
  }

  get modelUnit() {
    return MODEL_UNIT * this.viewer.parts[0].header.size;
  }

  // The width of the brush under the pointer, in CSS pixels.
  get brushWidth() {
    const { brush: { size, unit }, viewer: { canvas, camera } } = this, depth = this.hit?.depth ?? camera.distance;
    return unit === "pixels" ? size : (size * this.modelUnit * canvas.clientHeight) / (2 * Math.tan(camera.fov / 2) * depth);
  }

  // Change the unit of the size; the brush keeps its width.
  setUnit(unit) {
    const width = this.brushWidth;
    Object.assign(this.brush, { unit, size: 1 });
    this.set({ size: Math.round(width / this.brushWidth) });
  }

  swapColors() {
    const { brush: { color }, secondColor } = this;
    this.secondColor = color;
    this.set({ color: secondColor });
  }

  setTheme(name) {
    document.documentElement.dataset.theme = name;
    localStorage.setItem(THEME_KEY, name);
    this.viewer.gpu.background = BACKGROUNDS[name];
    this.viewer.invalidate();
  }

  showMessage(text) {
    element("paint-note").textContent = text;
  }

  // Handle events before the view's own handlers do.
  listen() {
    const { main } = this, { canvas } = this.viewer, on = (name, run) => main.addEventListener(name, run, true);
    on("pointerdown", (event) => event.target === canvas && this.pointerDown(event));
    on("pointermove", (event) => this.pointerMove(event));
    on("pointerup", (event) => this.pointerUp(event));
    on("pointercancel", (event) => this.pointerUp(event));
    on("pointerleave", (event) => event.target === canvas && this.showOutline(null));
    main.addEventListener("wheel", (event) => {
      if (!this.pen) return; // the view stays during a stroke
      event.preventDefault();
      event.stopPropagation();
    }, { capture: true, passive: false });
    on("dblclick", (event) => event.target === canvas && this.isOnModel && event.stopPropagation());
    document.addEventListener("keydown", (event) => this.keyDown(event), true);
    window.addEventListener("pagehide", () => sessionStorage.setItem(BRUSH_KEY, JSON.stringify(this.brush)));
    window.addEventListener("beforeunload", (event) => {
      if (this.commands.waiting.length) event.preventDefault();
    });
  }

  // The brush's place for a pointer event: x, y, radius in CSS pixels, and strength.
  place({ clientX, clientY, pressure, pointerType }) {
    const frame = this.viewer.canvas.getBoundingClientRect(), controls = pointerType === "pen" ? this.brush.pressure : "";
    const share = controls === "size" || controls === "both" ? MIN_PRESSURE + (1 - MIN_PRESSURE) * pressure : 1;
    return [clientX - frame.left, clientY - frame.top, (share * this.brushWidth) / 2, controls === "opacity" || controls === "both" ? pressure : 1];
  }

  // Find the surface under the brush; beside the model a stroke keeps the last one.
  updateHit([x, y]) {
    this.hit = hitAt(this.viewer, x, y) ?? (this.pen ? this.hit : null);
  }

  // A key of the model's pose, or of the patch that is laid flat.
  get poseKey() {
    const { moment, patch } = this.viewer.display;
    return JSON.stringify([moment, patch?.spot]);
  }

  // Remember the end of a stroke: with Shift the next one continues from that point of the model.
  rememberEnd([x, y]) {
    const { camera, canvas } = this.viewer;
    this.lastEnd = { point: camera.pointAt([x, y], [canvas.clientWidth, canvas.clientHeight], this.hit?.depth), poseKey: this.poseKey };
  }

  // The start of a straight line to a place: the end of the last stroke, or else that place.
  lineStart(place) {
    const { lastEnd, viewer: { camera, canvas } } = this;
    const start = lastEnd?.poseKey === this.poseKey ? camera.project(lastEnd.point, [canvas.clientWidth, canvas.clientHeight]) : null;
    return start ? [...start, ...place.slice(2)] : place;
  }

  // Whether a press is for the tool. Others are for the view: they turn or move it, as a press does where the brush meets no model.
  isForTool(event) {
    if (this.tool.turns || event.button !== 0 || event.ctrlKey || event.metaKey || (event.shiftKey && !this.tool.hasRing)) return false;
    this.updateHit(this.place(event));
    const isWide = this.tool.hasRing && !event.altKey && !this.brush.onePart; // such a stroke may begin beside the model
    const isUnder = this.hit !== null || this.viewer.surfaceAt(...this.place(event)) !== null; // a hit lacks translucent surface
    this.isOnModel = isUnder || (isWide && isHitIn(this.viewer, this.place(event)));
    return this.isOnModel;
  }

  // The reason why nothing can be painted on the current display, or "".
  get blockReason() {
    return this.material.blockReason || this.layers.blockReason;
  }

  pointerDown(event) {
    if (this.pen) {
      if (event.pointerType === "touch" && this.pen.type === "touch") this.cancelForView();
      return;
    }
    if (event.isForView || !this.viewer.isLoaded) return;
    this.viewer.drawNow(); // hits are read from the image
    const isResize = (event.ctrlKey || event.metaKey) && event.button !== 1 && this.tool.hasRing;
    if (!isResize && !this.isForTool(event)) return;
    event.stopPropagation();
    event.preventDefault();
    document.activeElement?.blur(); // keys then go to the tools, not to a slider
    if (isResize) return this.beginDrag(event, new ResizeDrag(this, event));
    if (event.altKey) return (this.tool.alt ?? pickPaint)(this, event);
    if (this.tool.isAnywhere) return this.tool.down(this, event);
    const why = this.blockReason;
    if (why || this.shownReason) this.showMessage((this.shownReason = why));
    if (why) return;
    this.viewer.display.highlight = null;
    this.viewer.setTurntable(false);
    this.viewer.player?.stop();
    const drag = this.tool.down(this, event);
    if (drag) this.beginDrag(event, drag);
  }

  // Give a pointer's events to a drag until it is up.
  beginDrag(event, drag) {
    if (event.isTrusted) this.viewer.canvas.setPointerCapture(event.pointerId);
    this.pen = { id: event.pointerId, type: event.pointerType, first: event, drag };
  }

  pointerMove(event) {
    const place = this.place(event), isDrag = this.pen && event.pointerId === this.pen.id;
    if (!isDrag) {
      if (event.target !== this.viewer.canvas) return;
      if (document.activeElement?.matches("select")) document.activeElement.blur(); // keys then go to the tools
      this.updateHit(place);
      return this.showOutline(place, event.shiftKey ? this.lineStart(place) : place);
    }
    event.stopPropagation();
    const { drag } = this.pen; // `drag.place`: the brush is not under the pointer
    if (!drag.place) this.updateHit(place);
    drag.move(event);
    if (drag.place) this.updateHit(drag.place);
    this.showOutline(drag.place ?? place, place);
  }

  pointerUp(event) {
    if (!this.pen || event.pointerId !== this.pen.id) return;
    event.stopPropagation();
    const { drag } = this.pen;
    this.pen = null;
    drag.up(event);
  }

  cancelDrag() {
    const { drag } = this.pen;
    this.pen = null;
    drag.cancel();
  }

  // A second finger touches: the drag is cancelled, and both fingers move the view.
  cancelForView() {
    const { first } = this.pen;
    this.cancelDrag();
    const press = new PointerEvent("pointerdown", first);
    press.isForView = true;
    this.viewer.canvas.dispatchEvent(press);
    this.viewer.invalidate(true);
  }

  undo() {
    if (this.status.done > 0 || this.isBusy) this.commands.send({ kind: "undo" });
  }

  redo() {
    if (this.status.done < this.status.steps.length || this.isBusy) this.commands.send({ kind: "redo" });
  }

  save() {
    this.commands.send({ kind: "save" });
  }

  keyDown(event) {
    const isText = event.target.matches?.("input[type=text]"), isTyping = isText || event.target.matches?.("select, input[type=file]");
    const isAltGr = event.getModifierState("AltGraph"), isCommand = (event.ctrlKey || event.metaKey) && !isAltGr; // some keyboards have [ on AltGr
    const { size, hardness } = this.brush, key = event.key.toLowerCase();
    const commands = { z: () => (event.shiftKey ? this.redo() : this.undo()), y: () => this.redo(), s: () => (event.shiftKey ? this.exporting.exportCopy() : this.save()) };
    const tools = {
      ...Object.fromEntries(TOOLS.map((tool) => [tool.key, () => this.selectTool(tool.name)])),
      x: () => this.swapColors(),
      ...(this.flat.isOpen && { escape: () => this.flat.close() }),
      "[": () => this.set({ size: Math.min(Math.round(size / SIZE_STEP), size - 1) }),
      "]": () => this.set({ size: Math.max(Math.round(size * SIZE_STEP), size + 1) }),
      "{": () => this.set({ hardness: hardness - 0.1 }),
      "}": () => this.set({ hardness: hardness + 0.1 }),
      ...(event.target === this.viewer.canvas && { enter: () => pressMiddle(this) }),
      ...this.tool.keys?.(this, event),
    };
    if (isText && key === "enter") return event.target.blur(); // keys then go to the tools
    if (isCommand && isText && key !== "s") return; // the text field undoes its own input
    const run = isCommand ? commands[key] : isTyping || (event.altKey && !isAltGr) ? null : tools[key];
    if (run || this.pen) event.stopImmediatePropagation(); // no key turns the view during a stroke
    if (!run) return;
    event.preventDefault();
    run();
  }

  // A new image may show other surface under a pointer that rests.
  imageDrawn() {
    if (!this.pointer || this.pen) return;
    this.hit = hitAt(this.viewer, ...this.pointer);
    this.showOutline(this.pointer);
  }

  // Show the brush's outline at a place, and a string from there to another place; null hides both.
  showOutline(place, end = place) {
    this.pointer = place;
    this.tool.hovered?.(this, place);
    if (place === null || !this.tool.hasRing) return this.outline.hide();
    this.outline.show(place, this.brushWidth, this.hit, this.brush);
    this.outline.showString(place, end);
  }

  // Show the status of the server's session, for the version of the texture that is shown.
  setStatus(status) {
    const before = this.status, finished = status.finished[this.commands.page] ?? 0;
    this.preview.statusChanged(status, before);
    this.flat.isStale = true;
    this.status = status;
    this.layers.setStack(status.layers, finished);
    this.preview.load();
    this.strokes.removeFinished(finished);
    this.showSaved();
    this.exporting.showQuestions(status.questions);
    if (status.error || status.told || before.error || before.told) this.showMessage(status.error || status.told);
    this.showSteps(before);
  }

  // Whether the server still has to run commands of this page.
  get isBusy() {
    return (this.status.finished[this.commands.page] ?? 0) < this.commands.number;
  }

  // Show whether all is saved, or that a command takes long.
  showSaved(isLong = false) {
    const { isBusy, status: { steps, done, output, isSaved } } = this, state = isSaved ? "all is saved" : "not saved";
    element("undo").disabled = done === 0 && !isBusy;
    element("redo").disabled = done === steps.length && !isBusy;
    element("saved").textContent = `${output}: ${!isBusy ? state : isLong ? "working …" : "not saved"}`;
    clearTimeout(this.longTimer);
    if (isBusy) this.longTimer = setTimeout(() => this.showSaved(true), LONG);
  }

  // List the steps. Rows that are the same as `before` are not touched: there may be thousands.
  showSteps(before) {
    const list = element("steps"), { steps, done } = this.status;
    let first = steps.findIndex((name, n) => name !== before.steps[n]) + 1 || steps.length + 1;
    first = Math.min(first, before.done, done, list.children.length);
    while (list.children.length > steps.length + 1) list.lastChild.remove();
    for (let n = first; n <= steps.length; n++) {
      const item = list.children[n] ?? make("li", {}, make("button", { type: "button" })), button = item.firstChild;
      if (!item.parentNode) list.append(item);
      button.textContent = n ? steps[n - 1] : "Opened";
      item.className = n > done ? "undone" : "";
      if (n === done) button.setAttribute("aria-current", "step");
      else button.removeAttribute("aria-current");
    }
    const { offsetTop: top, offsetHeight: height } = list.children[done]; // scroll the list alone, not the panel
    list.scrollTop = Math.min(Math.max(list.scrollTop, top + height - list.clientHeight), top);
  }

  // Undo or redo up to the step of a row.
  goToStep(row) {
    const { done } = this.status, n = row ? [...row.parentNode.children].indexOf(row) : done;
    for (let step = done; step > n; step--) this.commands.send({ kind: "undo" });
    for (let step = done; step < n; step++) this.commands.send({ kind: "redo" });
  }

  // The texture has other channels.
  channelsChanged() {
    const { section: before } = this.material;
    this.material = new Material(this);
    this.material.section.open = before.open;
    before.replaceWith(this.material.section);
    this.strokes.allocateLayers([]);
    this.strokes.compose();
    this.set({});
  }

  // Create all GPU objects again after a lost context. A stroke that was being drawn is lost with it.
  restoreContext() {
    this.hit = null;
    if (this.pen) this.cancelDrag();
    this.flat.restoreContext();
    this.strokes.build();
    this.preview.restoreContext();
  }
}
