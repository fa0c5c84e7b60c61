// Painting: the panel, what pointers and keys do, and what has been done. See tools.js, stroke.js and sending.js.

import { Beneath } from "./beneath.js";
import { element, make } from "./elements.js";
import { External } from "./external.js";
import { Exporting } from "./exporting.js";
import { Flat } from "./flat.js";
import { SizeDrag } from "./hand.js";
import { onDrop } from "./images.js";
import { Layers } from "./layers.js";
import { Material } from "./material.js";
import { Outline } from "./outline.js";
import { Palette } from "./palette.js";
import { BLENDS, Settings, act, icon, section, slider } from "./panel.js";
import { Retouch } from "./retouch.js";
import { Sending } from "./sending.js";
import { Stencil } from "./stencil.js";
import { MOST_ANGLE, Strokes } from "./stroke.js";
import { TOOLS, pick } from "./tools.js";
import { under } from "./under.js";

const LEAST_SIZE = 1, MOST_SIZE = 400;
const STEP = 1.15; // of the size, by a key
const LONG = 1000; // milliseconds after which a command takes long
const LEAST_PRESSURE = 0.15; // what part of the size a pen has that barely touches
const THOUSANDTH = 0.001; // of the root cell’s edge: sizes in the model’s units are counted in these

const KEPT = "octex-brush"; // of this tab, when the page loads anew

const KEYS = TOOLS.map(({ key, text }) => `${key.toUpperCase()} ${text.toLowerCase()}`).join(", ");
const HELP = [
  "Drag on the model to paint, beside it or with the middle button to turn, with the right button to move; wheel or pinch zooms.",
  "Shift draws straight lines, Ctrl changes the brush’s size and hardness, Alt picks a colour.",
  `Keys: ${KEYS}, X the other colour, [ and ] size, Ctrl+Z undo, Ctrl+S save; 0 shows all, 1 to 6 look along the axes, C cubes, T turns automatically.`,
].join(" ");

export async function begin(viewer, told) {
  const painting = new Painting(viewer);
  await painting.open();
  painting.arrived(told);
  return painting;
}

class Painting {
  constructor(viewer) {
    this.viewer = viewer;
    this.brush = { color: [200, 60, 40], size: 40, unit: "pixels", hardness: 0.7, opacity: 1, flow: 1, spacing: 0.1, smoothing: 0, pressure: "size", blend: "over" };
    Object.assign(this.brush, { angle: MOST_ANGLE, backFaces: false, hidden: false, onePart: false, mirror: "", mirrorAt: 0, filled: "part", tolerance: 12 });
    Object.assign(this.brush, { ticked: ["base_color"], values: {}, used: [] }, JSON.parse(sessionStorage.getItem(KEPT)));
    this.other = [245, 245, 245]; // the colour that X changes to
    this.layers = new Layers(this);
    this.sending = new Sending((text) => this.say(text), () => this.layers.target, () => this.showSaved());
    this.strokes = new Strokes(viewer);
    this.beneath = new Beneath(this);
    this.exporting = new Exporting(this);
    this.flat = new Flat(this);
    this.outlined = new Outline(viewer);
    this.palette = new Palette(this);
    this.pen = null; // which pointer draws, and its drag
    this.end = null; // where the last stroke has ended, and how the model was posed
    this.hindered = ""; // why nothing could be painted last
    this.last = { steps: [], done: 0, baked: {} }; // what the server told last
  }

  async open() {
    const { viewer } = this, { gpu } = viewer;
    for (const name of ["stroke.frag", "dabs.frag", "retouch.frag", "outline.frag"]) gpu.programs.shaders[name] = await (await fetch(`shaders/${name}`)).text();
    await new Promise((go) => document.head.append(make("link", { rel: "stylesheet", href: "paint.css", onload: go, onerror: go })));
    document.documentElement.classList.add("paints");
    this.main = document.querySelector("main");
    this.build();
    this.stencil = new Stencil(this);
    this.retouch = new Retouch(this);
    this.external = new External(this);
    onDrop((file) => this.external.take(file), (text) => this.say(text));
    viewer.look.paint = this.strokes;
    this.strokes.build();
    const usual = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
    this.theme(localStorage.getItem("octex-theme") ?? usual);
    this.listen();
  }

  // Tools beside the picture, and in the panel what they are set to and what was done.
  build() {
    const button = ({ name, text, key, shownKey = key.toUpperCase() }) =>
      make("button", { type: "button", id: `tool-${name}`, title: `${text} (${shownKey})`, "aria-pressed": "false", onclick: () => this.choose(name) }, icon(name), make("span", {}, text));
    this.tools = make("nav", { id: "tools", "aria-label": "Tools" }, ...TOOLS.map(button));
    this.stage = element("stage");
    this.stage.append(this.outlined.ring, this.outlined.string);
    this.main.before(this.tools, this.flat.bar);
    this.main.append(this.flat.picture);
    const [least, most] = [LEAST_SIZE, MOST_SIZE].map(Math.log);
    const part = { min: 0, max: 1, step: 0.01 }, settings = (this.settings = new Settings("", () => this.brush, (change) => this.set(change)));
    this.material = new Material(this);
    const painting = make("section", { id: "painting", "aria-label": "Painting" },
      make("div", { class: "bar" },
        act("undo", "undo", "Undo (Ctrl+Z)", () => this.undo()),
        act("redo", "redo", "Redo (Ctrl+Shift+Z)", () => this.redo()),
        act("store", "save", "Save (Ctrl+S)", () => this.save()),
        act("theme", "theme", "Dark or light", () => this.theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark")),
        act("fold", "fold", "Panel", ({ currentTarget }) => (currentTarget.ariaExpanded = !document.querySelector("aside").classList.toggle("folded")))),
      make("p", { id: "saved", role: "status" }),
      make("div", { id: "question", role: "alert", hidden: true }),
      ...this.palette.parts,
      ...slider("size", "Size", { min: least, max: most, step: 0.01 }, (x) => this.set({ size: Math.round(Math.exp(x)) })),
      ...settings.slider("hardness", "Hardness", part),
      ...settings.slider("opacity", "Opacity", { ...part, min: 0.01 }),
      ...settings.choice("blend", "Blend mode", BLENDS),
      section("tip", "Brush",
        ...settings.choice("unit", "Size in", [["pixels", "pixels of the screen"], ["model", "the model’s units"]], (unit) => this.measure(unit)),
        ...settings.slider("flow", "Flow", { ...part, min: 0.01 }),
        ...settings.slider("spacing", "Spacing", { min: 0.05, max: 2, step: 0.05 }),
        ...settings.slider("smoothing", "Smoothing", { min: 0, max: 100, step: 1 }, (pixels) => (pixels ? `${pixels} px behind` : "off")),
        ...settings.choice("pressure", "A pen’s pressure changes", [["size", "the size"], ["opacity", "the opacity"], ["both", "both"], ["", "nothing"]])),
      this.material.section,
      section("where", "Where to paint",
        ...settings.slider("angle", "Largest angle to the view", { min: 5, max: 90, step: 1 }, (angle) => (angle === 90 ? "any" : `${angle}°`)),
        settings.check("backFaces", "back faces too"),
        settings.check("hidden", "hidden surface too"),
        settings.check("onePart", "only the part where a stroke starts"),
        ...settings.choice("mirror", "Mirror", [["", "off"], ...["x", "y", "z"].map((axis) => [axis, `along ${axis}`])]),
        ...settings.slider("mirrorAt", "Mirror plane", { min: -50, max: 50, step: 0.5 }, (at) => (at ? `${at} % from the middle` : "middle"), ({ mirror }) => mirror)),
      section("filling", "Fill",
        ...settings.choice("filled", "A click fills", [["part", "the part"], ["color", "the connected colour"], ["colors", "the colour everywhere"], ["all", "the whole model"]]),
        ...settings.slider("tolerance", "Tolerance", { min: 0, max: 100, step: 1 }, (codes) => `${codes} of 255`, ({ filled }) => filled.startsWith("color"))),
      this.layers.build(),
      section("history", "Steps", make("ol", { id: "steps", onclick: (event) => this.goTo(event.target.closest("li")) })),
      this.exporting.section,
      make("p", { id: "paint-note", role: "status" }));
    document.querySelector("aside").prepend(painting);
    element("help").textContent = HELP;
    element("history").open = true;
    element("panel").open = false;
    element("fold").ariaExpanded = true;
    this.layers.show();
    this.choose("brush");
    this.set({});
  }

  choose(name) {
    const tool = TOOLS.find((each) => each.name === name);
    if (tool.chosen?.(this)) return;
    this.tool?.left?.(this);
    this.showSettings(tool.settings);
    this.tool = tool;
    for (const button of this.tools.children) button.setAttribute("aria-pressed", String(button.id === `tool-${name}`));
    this.main.dataset.tool = name;
    this.main.classList.toggle("hasRing", Boolean(this.tool.hasRing));
    this.beneath.ask();
  }

  // Opens a tool’s section and scrolls to it; closes the one that the last tool opened.
  showSettings(name) {
    const section = name && element(name);
    if (this.opened && this.opened !== section) this.opened.open = false;
    if (!section?.open) this.opened = section;
    if (section) section.open = true;
    section?.scrollIntoView({ block: "nearest" });
  }

  set(change) {
    const { brush } = this;
    Object.assign(brush, change);
    brush.size = Math.min(Math.max(brush.size, LEAST_SIZE), MOST_SIZE);
    brush.hardness = Math.min(Math.max(brush.hardness, 0), 1);
    this.palette.show();
    element("size").value = Math.log(brush.size);
    element("size-text").textContent = this.sizeText;
    this.settings.show();
    this.material.show();
    if (this.at) this.outline(this.at);
  }

  // How far the mirror is from the model’s middle.
  get offset() {
    const { mirror, mirrorAt } = this.brush, axis = "xyz".indexOf(mirror);
    if (!mirror || !mirrorAt) return 0;
    const [low, high] = this.flat.views?.model.bounds ?? this.viewer.bounds();
    return (mirrorAt / 100) * (high[axis] - low[axis]);
  }

  get sizeText() {
    const { size, unit } = this.brush;
    return unit === "pixels" ? `${size} px` : `${Number((size * this.thousandth).toPrecision(2))}`;
  }

  get thousandth() {
    return THOUSANDTH * this.viewer.parts[0].header.size;
  }

  // How many pixels of the page the brush’s size is where the pointer is.
  get width() {
    const { brush: { size, unit }, viewer: { canvas, camera } } = this, away = this.below?.away ?? camera.distance;
    return unit === "pixels" ? size : (size * this.thousandth * canvas.clientHeight) / (2 * Math.tan(camera.fov / 2) * away);
  }

  // Give the size in another unit; it stays as large.
  measure(unit) {
    const before = this.width, { brush } = this;
    Object.assign(brush, { unit, size: 1 });
    this.set({ size: Math.round(before / this.width) });
  }

  swap() {
    const { color } = this.brush, { other } = this;
    this.other = color;
    this.set({ color: other });
  }

  theme(name) {
    document.documentElement.dataset.theme = name;
    localStorage.setItem("octex-theme", name);
    this.viewer.gpu.background = name === "dark" ? [0.155, 0.165, 0.18, 1] : [0.925, 0.93, 0.94, 1];
    this.viewer.move();
  }

  say(text) {
    element("paint-note").textContent = text;
  }

  listen() {
    const { main } = this, { canvas } = this.viewer, on = (name, run) => main.addEventListener(name, run, true);
    on("pointerdown", (event) => event.target === canvas && this.down(event));
    on("pointermove", (event) => this.moved(event));
    on("pointerup", (event) => this.up(event));
    on("pointercancel", (event) => this.up(event));
    on("pointerleave", (event) => event.target === canvas && this.outline(null));
    main.addEventListener("wheel", (event) => {
      if (!this.pen) return; // the view stays while a stroke is drawn on it
      event.preventDefault();
      event.stopPropagation();
    }, { capture: true, passive: false });
    on("dblclick", (event) => event.target === canvas && this.isOnModel && event.stopPropagation());
    document.addEventListener("keydown", (event) => this.key(event), true);
    window.addEventListener("pagehide", () => sessionStorage.setItem(KEPT, JSON.stringify(this.brush)));
    window.addEventListener("beforeunload", (event) => {
      if (this.sending.waiting.length) event.preventDefault();
    });
  }

  place({ clientX, clientY, pressure, pointerType }) {
    const frame = this.viewer.canvas.getBoundingClientRect(), by = pointerType === "pen" ? this.brush.pressure : "";
    const share = by === "size" || by === "both" ? LEAST_PRESSURE + (1 - LEAST_PRESSURE) * pressure : 1;
    return [clientX - frame.left, clientY - frame.top, (share * this.width) / 2, by === "opacity" || by === "both" ? pressure : 1];
  }

  // See what is under the pointer; beside the model a stroke keeps what it was on last.
  look([x, y]) {
    this.below = under(this.viewer, x, y) ?? (this.pen ? this.below : null);
  }

  // How the model is posed, or laid flat.
  get posed() {
    const { moved, patch } = this.viewer.look;
    return JSON.stringify([moved, patch?.spot]);
  }

  // A stroke has ended at a place: with Shift the next one goes on from that point of the model.
  ended([x, y]) {
    const { camera, canvas } = this.viewer;
    this.end = { point: camera.pointAt([x, y], [canvas.clientWidth, canvas.clientHeight], this.below?.away), posed: this.posed };
  }

  // Where a straight line to a place begins; at that place if no stroke was drawn before.
  lineTo(place) {
    const { end, viewer: { camera, canvas } } = this;
    const at = end?.posed === this.posed ? camera.placeOf(end.point, [canvas.clientWidth, canvas.clientHeight]) : null;
    return at ? [...at, ...place.slice(2)] : place;
  }

  // Whether a pointer is for the tool; else it turns or moves the view. Beside the model it turns.
  isForTool(event) {
    if (this.tool.turns || event.button !== 0 || event.ctrlKey || event.metaKey || (event.shiftKey && !this.tool.hasRing)) return false;
    this.look(this.place(event));
    this.isOnModel = this.below !== null || this.viewer.seen(...this.place(event)) !== null; // which draws all of the model
    return this.isOnModel;
  }

  // Why nothing can be painted on what is shown; or nothing.
  get hindrance() {
    return this.material.hindrance || this.layers.hindrance;
  }

  down(event) {
    if (this.pen) {
      if (event.pointerType === "touch" && this.pen.type === "touch") this.giveUp(event);
      return;
    }
    if (event.isPasses || !this.viewer.isComplete) return;
    this.viewer.drawNow(); // or nothing is known under the pen
    const isSized = (event.ctrlKey || event.metaKey) && event.button !== 1 && this.tool.hasRing;
    if (!isSized && !this.isForTool(event)) return;
    event.stopPropagation();
    event.preventDefault();
    document.activeElement?.blur(); // keys are the tools’ now, not a slider’s
    if (isSized) return this.hold(event, new SizeDrag(this, event));
    if (event.altKey) return (this.tool.alt ?? pick)(this, event);
    if (this.tool.isAnywhere) return this.tool.down(this, event);
    const why = this.hindrance;
    if (why !== this.hindered) this.say((this.hindered = why));
    if (why) return;
    this.viewer.look.marked = null;
    this.viewer.turn(false);
    this.viewer.player?.stop();
    element("turntable").checked = false;
    const drag = this.tool.down(this, event);
    if (drag) this.hold(event, drag);
  }

  // A pointer drags until it is up.
  hold(event, drag) {
    this.viewer.canvas.setPointerCapture(event.pointerId);
    this.pen = { id: event.pointerId, type: event.pointerType, first: event, drag };
  }

  moved(event) {
    const place = this.place(event), isHeld = this.pen && event.pointerId === this.pen.id;
    if (!isHeld) {
      if (event.target !== this.viewer.canvas) return;
      this.look(place);
      return this.outline(place, event.shiftKey ? this.lineTo(place) : place);
    }
    event.stopPropagation();
    const { drag } = this.pen; // some have the brush elsewhere than the pointer, at `at`
    if (!drag.at) this.look(place);
    drag.moved(event);
    if (drag.at) this.look(drag.at);
    this.outline(drag.at ?? place, place);
  }

  up(event) {
    if (!this.pen || event.pointerId !== this.pen.id) return;
    event.stopPropagation();
    const { drag } = this.pen;
    this.pen = null;
    drag.up(event);
  }

  // A second finger has come: both move the view, and nothing is painted.
  giveUp() {
    const { first, drag } = this.pen;
    this.pen = null;
    drag.giveUp();
    const again = new PointerEvent("pointerdown", first);
    again.isPasses = true;
    this.viewer.canvas.dispatchEvent(again);
    this.viewer.move(true);
  }

  undo() {
    if (this.last.done > 0 || this.strokes.sent.length) this.sending.send({ kind: "undo" });
  }

  redo() {
    if (this.last.done < this.last.steps.length) this.sending.send({ kind: "redo" });
  }

  save() {
    this.sending.send({ kind: "save" });
  }

  key(event) {
    const isText = event.target.matches?.("input[type=text]"), isTyping = isText || event.target.matches?.("select, input[type=file]");
    const isAltGr = event.getModifierState("AltGraph"), isCommand = (event.ctrlKey || event.metaKey) && !isAltGr; // some keyboards have [ on AltGr
    const { size, hardness } = this.brush, key = event.key.toLowerCase();
    const commands = { z: () => (event.shiftKey ? this.redo() : this.undo()), y: () => this.redo(), s: () => (event.shiftKey ? this.exporting.copy() : this.save()) };
    const tools = {
      ...Object.fromEntries(TOOLS.map((tool) => [tool.key, () => this.choose(tool.name)])),
      x: () => this.swap(),
      ...(this.flat.isOpen && { escape: () => this.flat.close() }),
      "[": () => this.set({ size: Math.min(Math.round(size / STEP), size - 1) }),
      "]": () => this.set({ size: Math.max(Math.round(size * STEP), size + 1) }),
      "{": () => this.set({ hardness: hardness - 0.1 }),
      "}": () => this.set({ hardness: hardness + 0.1 }),
      ...this.tool.keys?.(this, event),
    };
    if (isCommand && isText && key !== "s") return; // of the text
    const run = isCommand ? commands[key] : isTyping || (event.altKey && !isAltGr) ? null : tools[key];
    if (run || this.pen) event.stopImmediatePropagation(); // with the pen down no key turns the view
    if (!run) return;
    event.preventDefault();
    run();
  }

  // A picture is drawn anew: something else may lie under a pointer that rests.
  drawn() {
    if (!this.at || this.pen) return;
    this.below = under(this.viewer, ...this.at);
    this.outline(this.at);
  }

  // The outline of the brush at a place, or none, and a string from there to another one.
  outline(at, end = at) {
    this.at = at;
    this.tool.hovered?.(this, at);
    if (at === null || !this.tool.hasRing) return this.outlined.hide();
    this.outlined.show(at, this.width, this.below, this.brush);
    this.outlined.tie(at, end);
  }

  // A version of the texture is shown, of which this is told.
  arrived(told) {
    this.beneath.arrived(told, this.last);
    this.flat.isStale = true;
    const before = this.last;
    this.last = told;
    this.layers.arrived(told.layers);
    this.beneath.ask();
    this.strokes.painted(told.baked[this.sending.page] ?? 0);
    element("undo").disabled = told.done === 0;
    element("redo").disabled = told.done === told.steps.length;
    this.showSaved();
    this.exporting.ask(told.question);
    if (told.fault || this.hadFault) this.say(told.fault);
    this.hadFault = told.fault;
    this.showSteps(before);
  }

  // Whether the server still has commands of this page to run.
  get isBusy() {
    return (this.last.baked[this.sending.page] ?? 0) < this.sending.number;
  }

  // Tell whether all is saved, or that commands take long.
  showSaved(isLong = false) {
    const { isBusy, last: { output, isSaved } } = this, finished = isSaved ? "all is saved" : "not saved";
    element("saved").textContent = `${output}: ${!isBusy ? finished : isLong ? "working …" : "not saved"}`;
    clearTimeout(this.slow);
    if (isBusy) this.slow = setTimeout(() => this.showSaved(true), LONG);
  }

  // List the steps, of which these were listed before. Rows that stay the same are not touched: there may be thousands.
  showSteps(before) {
    const list = element("steps"), { steps, done } = this.last;
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
    const { offsetTop: top, offsetHeight: height } = list.children[done]; // the panel itself stays as it is scrolled
    list.scrollTop = Math.min(Math.max(list.scrollTop, top + height - list.clientHeight), top);
  }

  // Undo or redo up to a step, of which this is the row.
  goTo(row) {
    const { done } = this.last, n = row ? [...row.parentNode.children].indexOf(row) : done;
    for (let step = done; step > n; step--) this.sending.send({ kind: "undo" });
    for (let step = done; step < n; step++) this.sending.send({ kind: "redo" });
  }

  // The texture has other channels.
  takeChannels() {
    const { section: before } = this.material;
    this.material = new Material(this);
    this.material.section.open = before.open;
    before.replaceWith(this.material.section);
    this.strokes.layer([]);
    this.strokes.compose();
    this.set({});
  }

  // The GPU is there again: make all anew.
  restore() {
    this.beneath.known = { key: "", part: null };
    this.flat.restore();
    this.strokes.build();
  }
}
