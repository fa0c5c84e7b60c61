// Painting: the panel, what pointers and keys do, and what has been done. See tools.js, stroke.js and sending.js.

import { element } from "./elements.js";
import { Elsewhere } from "./elsewhere.js";
import { onDrop } from "./images.js";
import { act, check, choice, icon, make, section, slider } from "./panel.js";
import { Retouch } from "./retouch.js";
import { Sending } from "./sending.js";
import { Stencil } from "./stencil.js";
import { MOST_ANGLE, Strokes } from "./stroke.js";
import { TOOLS, pick } from "./tools.js";

const LEAST_SIZE = 1, MOST_SIZE = 400;
const STEP = 1.15; // of the size, by a key
const LEAST_PRESSURE = 0.15; // what part of the size a pen has that barely touches

const toHex = (color) => `#${color.map((code) => Math.round(code).toString(16).padStart(2, "0")).join("")}`;
const fromHex = (text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16));

export async function begin(viewer, told) {
  const painting = new Painting(viewer);
  await painting.open();
  painting.arrived(told);
  return painting;
}

class Painting {
  constructor(viewer) {
    this.viewer = viewer;
    this.brush = { color: [200, 60, 40], size: 40, hardness: 0.7, opacity: 1, angle: MOST_ANGLE, backFaces: false, mirror: "", filled: "part" };
    this.other = [245, 245, 245]; // the colour that X changes to
    this.sending = new Sending((text) => this.say(text));
    this.strokes = new Strokes(viewer);
    this.pen = null; // which pointer draws, and its drag
    this.hindered = ""; // why nothing could be painted last
    this.last = {}; // what the server told last
  }

  async open() {
    const { viewer } = this, { gpu } = viewer;
    for (const name of ["stroke.frag", "retouch.frag"]) gpu.shaders[name] = await (await fetch(`shaders/${name}`)).text();
    document.head.append(make("link", { rel: "stylesheet", href: "paint.css" }));
    document.documentElement.classList.add("paints");
    this.main = document.querySelector("main");
    this.build();
    this.stencil = new Stencil(this);
    this.retouch = new Retouch(this);
    this.elsewhere = new Elsewhere(this);
    onDrop((file) => this.elsewhere.take(file), (text) => this.say(text));
    viewer.look.paint = this.strokes;
    this.strokes.build();
    const dark = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
    this.theme(localStorage.getItem("octex-theme") ?? dark);
    this.listen();
  }

  // Tools beside the picture, and in the panel what they are set to and what was done.
  build() {
    const button = ({ name, text, key, shownKey = key.toUpperCase() }) =>
      make("button", { type: "button", id: `tool-${name}`, title: `${text} (${shownKey})`, "aria-pressed": "false", onclick: () => this.choose(name) }, icon(name), make("span", {}, text));
    this.tools = make("nav", { id: "tools", "aria-label": "Tools" }, ...TOOLS.map(button));
    this.ring = make("div", { id: "ring", hidden: true });
    this.main.append(this.tools, this.ring);
    const color = make("input", { type: "color", id: "color", "aria-label": "Colour", oninput: ({ target }) => this.set({ color: fromHex(target.value) }) });
    const other = make("button", { type: "button", id: "other", title: "Change to the other colour (X)", onclick: () => this.swap() });
    const [least, most] = [LEAST_SIZE, MOST_SIZE].map(Math.log);
    const part = { min: 0, max: 1, step: 0.01 };
    const painting = make("section", { id: "painting", "aria-label": "Painting" },
      make("div", { class: "bar" },
        act("undo", "undo", "Undo (Ctrl+Z)", () => this.undo()),
        act("redo", "redo", "Redo (Ctrl+Shift+Z)", () => this.redo()),
        act("store", "save", "Save (Ctrl+S)", () => this.save()),
        act("theme", "theme", "Dark or light", () => this.theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"))),
      make("p", { id: "saved", role: "status" }),
      make("div", { class: "colors" }, color, other, make("span", { id: "color-text" })),
      ...slider("size", "Size", { min: least, max: most, step: 0.01 }, (x) => this.set({ size: Math.round(Math.exp(x)) })),
      ...slider("hardness", "Hardness", part, (hardness) => this.set({ hardness })),
      ...slider("opacity", "Opacity", { ...part, min: 0.01 }, (opacity) => this.set({ opacity })),
      section("where", "What is painted",
        ...slider("angle", "Seen at most at an angle of", { min: 5, max: 90, step: 1 }, (angle) => this.set({ angle })),
        check("back-faces", "also what faces away", (backFaces) => this.set({ backFaces })),
        ...choice("mirror", "Mirror", [["", "off"], ...["x", "y", "z"].map((axis) => [axis, `left and right along ${axis}`])], (mirror) => this.set({ mirror })),
        ...choice("filled", "Fill", [["part", "the part that is clicked"], ["all", "the whole model"]], (filled) => this.set({ filled }))),
      section("history", "Steps", make("ol", { id: "steps" })),
      make("p", { id: "paint-note", role: "status" }));
    document.querySelector("aside").prepend(painting);
    element("history").open = true;
    element("panel").open = false;
    this.choose("brush");
    this.set({});
  }

  choose(name) {
    this.tool?.left?.(this);
    this.tool = TOOLS.find((tool) => tool.name === name);
    for (const button of this.tools.children) button.setAttribute("aria-pressed", String(button.id === `tool-${name}`));
    this.main.dataset.tool = name;
    this.main.classList.toggle("hasRing", Boolean(this.tool.hasRing));
    this.tool.chosen?.(this);
  }

  set(change) {
    const { brush } = this;
    Object.assign(brush, change);
    brush.size = Math.min(Math.max(brush.size, LEAST_SIZE), MOST_SIZE);
    brush.hardness = Math.min(Math.max(brush.hardness, 0), 1);
    element("color").value = toHex(brush.color);
    element("color-text").textContent = toHex(brush.color);
    element("other").style.background = toHex(this.other);
    element("size").value = Math.log(brush.size);
    element("size-text").textContent = `${brush.size} px`;
    element("angle").value = brush.angle;
    element("angle-text").textContent = brush.angle === 90 ? "any" : `${brush.angle}°`;
    for (const name of ["hardness", "opacity"]) {
      element(name).value = brush[name];
      element(`${name}-text`).textContent = `${Math.round(100 * brush[name])} %`;
    }
    if (this.at) this.outline(this.at);
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
    window.addEventListener("beforeunload", (event) => {
      if (this.sending.waiting.length) event.preventDefault();
    });
  }

  place({ clientX, clientY, pressure, pointerType }) {
    const frame = this.viewer.canvas.getBoundingClientRect(), share = pointerType === "pen" ? LEAST_PRESSURE + (1 - LEAST_PRESSURE) * pressure : 1;
    return [clientX - frame.left, clientY - frame.top, (share * this.brush.size) / 2];
  }

  // Whether a pointer is for the tool; else it turns or moves the view. Beside the model it turns.
  isForTool(event) {
    if (this.tool.turns || event.button !== 0 || event.shiftKey || event.ctrlKey || event.metaKey) return false;
    this.isOnModel = this.viewer.seen(...this.place(event)) !== null;
    return this.isOnModel;
  }

  // Why nothing can be painted on what is shown; or nothing.
  get hindrance() {
    const { look } = this.viewer, isColor = ["lit", "unlit"].includes(look.shown) || (look.shown === "channel" && look.channel === this.strokes.channel);
    if (look.moved) return "Choose the model as it rests, without an animation, to paint.";
    if (look.cubes || !isColor) return "Show the colours of the surface to paint.";
    return "";
  }

  down(event) {
    if (this.pen) {
      if (event.pointerType === "touch" && this.pen.type === "touch") this.giveUp(event);
      return;
    }
    if (event.isPasses || !this.viewer.isComplete || !this.isForTool(event)) return;
    event.stopPropagation();
    event.preventDefault();
    document.activeElement?.blur(); // keys are the tools’ now, not a slider’s
    if (event.altKey) return (this.tool.alt ?? pick)(this, event);
    if (this.tool.isAnywhere) return this.tool.down(this, event);
    const why = this.hindrance;
    if (why !== this.hindered) this.say((this.hindered = why));
    if (why) return;
    this.viewer.canvas.setPointerCapture(event.pointerId);
    this.viewer.look.marked = null;
    this.viewer.turn(false);
    element("turntable").checked = false;
    const drag = this.tool.down(this, event);
    if (drag) this.pen = { id: event.pointerId, type: event.pointerType, first: event, drag };
  }

  moved(event) {
    if (!this.pen || event.pointerId !== this.pen.id) {
      if (event.target === this.viewer.canvas) this.outline(this.place(event));
      return;
    }
    event.stopPropagation();
    this.pen.drag.moved(event);
    this.outline(this.place(event));
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
    const isTyping = event.target.matches?.("select, input:not([type=range]):not([type=checkbox]):not([type=color])");
    const { size, hardness } = this.brush, key = event.key.toLowerCase();
    const commands = { z: () => (event.shiftKey ? this.redo() : this.undo()), y: () => this.redo(), s: () => this.save() };
    const tools = {
      ...Object.fromEntries(TOOLS.map((tool) => [tool.key, () => this.choose(tool.name)])),
      x: () => this.swap(),
      "[": () => this.set({ size: Math.min(Math.round(size / STEP), size - 1) }),
      "]": () => this.set({ size: Math.max(Math.round(size * STEP), size + 1) }),
      "{": () => this.set({ hardness: hardness - 0.1 }),
      "}": () => this.set({ hardness: hardness + 0.1 }),
      ...this.tool.keys?.(this, event),
    };
    const run = event.ctrlKey || event.metaKey ? commands[key] : event.altKey || isTyping ? null : tools[key];
    if (run || this.pen) event.stopImmediatePropagation(); // with the pen down no key turns the view
    if (!run) return;
    event.preventDefault();
    run();
  }

  // The outline of the brush under the pointer, or none.
  outline(at) {
    const { ring } = this;
    this.at = at;
    this.tool.hovered?.(this, at);
    ring.hidden = at === null || !this.tool.hasRing;
    if (ring.hidden) return;
    const [x, y, radius] = [at[0], at[1], this.brush.size / 2];
    ring.style.width = ring.style.height = `${2 * radius}px`;
    ring.style.transform = `translate(${x - radius}px, ${y - radius}px)`;
  }

  // A version of the texture is shown, of which this is told.
  arrived(told) {
    this.last = told;
    this.strokes.painted(told.baked[this.sending.page] ?? 0);
    element("undo").disabled = told.done === 0;
    element("redo").disabled = told.done === told.steps.length;
    element("saved").textContent = `${told.output}: ${told.isSaved ? "all is saved" : "not saved"}`;
    if (told.fault || this.hadFault) this.say(told.fault);
    this.hadFault = told.fault;
    const list = element("steps"), rows = ["Opened", ...told.steps];
    list.replaceChildren(...rows.map((name, n) => {
      const go = () => {
        for (let step = told.done; step > n; step--) this.sending.send({ kind: "undo" });
        for (let step = told.done; step < n; step++) this.sending.send({ kind: "redo" });
      };
      return make("li", { class: n > told.done ? "undone" : "" }, make("button", { type: "button", "aria-current": n === told.done ? "step" : false, onclick: go }, name));
    }));
    list.children[told.done].scrollIntoView({ block: "nearest" });
  }

  allSent() {
    return this.sending.all();
  }
}
