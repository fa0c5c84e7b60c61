// Painting: tools, what the pen does, and what has been done. See stroke.js and sending.js.

import { element } from "./elements.js";
import { Sending, deflated } from "./sending.js";
import { MOST_ANGLE, Strokes } from "./stroke.js";

const ICONS = {
  brush: "M20.7 3.3a2 2 0 0 0-2.8 0l-9 9 2.8 2.8 9-9a2 2 0 0 0 0-2.8zM7.5 13.7c-2 0-3.3 1.5-3.3 3.3 0 1.4-.8 2.2-2 2.5.9 1 2.3 1.6 3.8 1.6 2.6 0 4.7-1.8 4.7-4.2 0-1.8-1.4-3.2-3.2-3.2z",
  pick: "M20.5 3.5a2.6 2.6 0 0 0-3.7 0l-2.6 2.6-1.1-1.1-1.6 1.6 1.2 1.2L5 15.4 4 20l4.6-1 7.6-7.7 1.2 1.2 1.6-1.6-1.1-1.1 2.6-2.6a2.6 2.6 0 0 0 0-3.7zM7.7 17.3l-1.5.4.4-1.5 6.9-7 1.2 1.2z",
  fill: "M11 2.6 9.6 4l2 2-7 7a1.5 1.5 0 0 0 0 2.1l5.3 5.3c.6.6 1.5.6 2.1 0l8.1-8.1zm-4.6 11 6.7-6.6 4.6 4.6-2 2zM20.5 15s-2 2.4-2 3.8a2 2 0 0 0 4 0c0-1.4-2-3.8-2-3.8z",
  undo: "M8 5 2.5 10.5 8 16v-4h5.5a3.8 3.8 0 0 1 0 7.5H9V22h4.5a6.2 6.2 0 0 0 0-12.5H8z",
  redo: "m16 5 5.5 5.5L16 16v-4h-5.5a3.8 3.8 0 0 0 0 7.5H15V22h-4.5a6.2 6.2 0 0 1 0-12.5H16z",
  save: "M4 3h12l5 5v13H3V4a1 1 0 0 1 1-1zm3 2v5h8V5zm5 8a3 3 0 1 0 0 6 3 3 0 0 0 0-6z",
  swap: "M8 3 3 8l5 5V9.2h7V6.8H8zm8 8v3.8H9v2.4h7V21l5-5z",
  theme: "M12 2a10 10 0 1 0 0 20 10 10 0 0 0 0-20zm0 2.4v15.2a7.6 7.6 0 0 1 0-15.2z",
};
const LEAST_SIZE = 1, MOST_SIZE = 400;
const STEP = 1.15; // of the size, by a key
const LEAST_PRESSURE = 0.15; // what part of the size a pen has that barely touches

function make(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value !== null) made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

function icon(name) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg"), path = document.createElementNS(svg.namespaceURI, "path");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  path.setAttribute("d", ICONS[name]);
  svg.append(path);
  return svg;
}

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
    this.tool = "brush";
    this.brush = { color: [200, 60, 40], size: 40, hardness: 0.7, opacity: 1, angle: MOST_ANGLE, backFaces: false, mirror: "" };
    this.other = [245, 245, 245]; // the colour that X changes to
    this.sending = new Sending((text) => this.say(text));
    this.strokes = new Strokes(viewer);
    this.pen = null; // which pointer draws, and where it was
    this.hindered = ""; // why nothing could be painted last
    this.last = {}; // what the server told last
  }

  async open() {
    const { viewer } = this, { gpu } = viewer;
    gpu.shaders["stroke.frag"] = await (await fetch("shaders/stroke.frag")).text();
    document.head.append(make("link", { rel: "stylesheet", href: "paint.css" }));
    document.documentElement.classList.add("paints");
    this.main = document.querySelector("main");
    this.build();
    viewer.look.paint = this.strokes;
    this.strokes.build();
    const dark = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
    this.theme(localStorage.getItem("octex-theme") ?? dark);
    this.listen();
  }

  // Tools beside the picture, and in the panel what they are set to and what was done.
  build() {
    const tool = (name, text, key) => make("button", { type: "button", id: `tool-${name}`, title: `${text} (${key})`, "aria-pressed": "false", onclick: () => this.choose(name) }, icon(name), make("span", {}, text));
    const act = (id, name, title, run) => make("button", { type: "button", id, title, "aria-label": title, onclick: run }, icon(name));
    this.tools = make("nav", { id: "tools", "aria-label": "Tools" }, tool("brush", "Brush", "B"), tool("pick", "Pick", "Alt"), tool("fill", "Fill", "F"));
    this.ring = make("div", { id: "ring", hidden: true });
    this.main.append(this.tools, this.ring);
    const color = make("input", { type: "color", id: "color", "aria-label": "Colour", oninput: ({ target }) => this.set({ color: fromHex(target.value) }) });
    const other = make("button", { type: "button", id: "other", title: "Change to the other colour (X)", onclick: () => this.swap() });
    const slider = (id, text, attributes, of) => [
      make("label", { for: id }, text, make("output", { id: `${id}-text`, for: id })),
      make("input", { type: "range", id, ...attributes, oninput: ({ target }) => this.set(of(Number(target.value))) }),
    ];
    const [least, most] = [LEAST_SIZE, MOST_SIZE].map(Math.log);
    const section = make("section", { id: "painting", "aria-label": "Painting" },
      make("div", { class: "bar" },
        act("undo", "undo", "Undo (Ctrl+Z)", () => this.undo()),
        act("redo", "redo", "Redo (Ctrl+Shift+Z)", () => this.redo()),
        act("store", "save", "Save (Ctrl+S)", () => this.save()),
        act("theme", "theme", "Dark or light", () => this.theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"))),
      make("p", { id: "saved", role: "status" }),
      make("div", { class: "colors" }, color, other, make("span", { id: "color-text" })),
      ...slider("size", "Size", { min: least, max: most, step: 0.01 }, (x) => ({ size: Math.round(Math.exp(x)) })),
      ...slider("hardness", "Hardness", { min: 0, max: 1, step: 0.01 }, (hardness) => ({ hardness })),
      ...slider("opacity", "Opacity", { min: 0.01, max: 1, step: 0.01 }, (opacity) => ({ opacity })),
      make("details", { id: "where" }, make("summary", {}, "What is painted"),
        ...slider("angle", "Seen at most at an angle of", { min: 5, max: 90, step: 1 }, (angle) => ({ angle })),
        make("label", { class: "check" }, make("input", { type: "checkbox", id: "back-faces", oninput: ({ target }) => this.set({ backFaces: target.checked }) }), "also what faces away"),
        make("label", { for: "mirror" }, "Mirror"),
        make("select", { id: "mirror", oninput: ({ target }) => this.set({ mirror: target.value }) }, new Option("off", ""), ...["x", "y", "z"].map((axis) => new Option(`left and right along ${axis}`, axis))),
        make("label", { for: "filled" }, "Fill"),
        make("select", { id: "filled" }, new Option("the part that is clicked", "part"), new Option("the whole model", "all"))),
      make("details", { id: "history", open: true }, make("summary", {}, "Steps"), make("ol", { id: "steps" })),
      make("p", { id: "paint-note", role: "status" }));
    document.querySelector("aside").prepend(section);
    element("panel").open = false;
    this.choose("brush");
    this.set({});
  }

  choose(name) {
    this.tool = name;
    for (const button of this.tools.children) button.setAttribute("aria-pressed", String(button.id === `tool-${name}`));
    this.main.dataset.tool = name;
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
    if (event.button !== 0 || event.shiftKey || event.ctrlKey || event.metaKey) return false;
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
    if (event.altKey || this.tool === "pick") return this.pick(event);
    if (this.tool === "fill") return this.fill(event);
    const why = this.hindrance;
    if (why !== this.hindered) this.say((this.hindered = why));
    if (why) return;
    this.viewer.canvas.setPointerCapture(event.pointerId);
    const at = this.place(event);
    this.pen = { id: event.pointerId, type: event.pointerType, at, first: event, dirty: null };
    this.viewer.look.marked = null;
    this.viewer.turn(false);
    element("turntable").checked = false;
    const { width, height } = this.viewer.film, [{ K, pose }] = this.viewer.camera.file("", width, height).cameras;
    this.strokes.begin({ ...this.brush, camera: { width, height, K, pose } });
    this.draw(at, at);
  }

  moved(event) {
    if (!this.pen || event.pointerId !== this.pen.id) {
      if (event.target === this.viewer.canvas) this.outline(this.place(event));
      return;
    }
    event.stopPropagation();
    const events = event.getCoalescedEvents?.() ?? [];
    for (const each of events.length ? events : [event]) {
      const at = this.place(each);
      this.draw(this.pen.at, at);
      this.pen.at = at;
    }
    this.outline(this.pen.at);
  }

  // Draw a part of the stroke; the picture has it in the next frame.
  draw(from, to) {
    const { pen } = this, box = this.strokes.extend(from, to);
    if (!box) return;
    const before = pen.dirty ?? box;
    pen.dirty = { left: Math.min(before.left, box.left), top: Math.min(before.top, box.top), right: Math.max(before.right, box.right), bottom: Math.max(before.bottom, box.bottom) };
    pen.asked ||= requestAnimationFrame(() => {
      pen.asked = 0;
      if (pen.dirty) this.viewer.drawPart(pen.dirty);
      pen.dirty = null;
    });
  }

  up(event) {
    if (!this.pen || event.pointerId !== this.pen.id) return;
    event.stopPropagation();
    this.pen = null;
    const stroke = this.strokes.end();
    if (!stroke) return;
    const { camera, box, color, opacity, coverage, angle: maxAngle, backFaces, mirror } = stroke;
    const name = mirror ? "Brush, mirrored" : "Brush";
    const command = { kind: "stroke", name, camera, box, color, opacity, maxAngle, backFaces, mirror };
    stroke.number = this.sending.send(command, deflated(coverage));
    this.strokes.keep(stroke);
  }

  // A second finger has come: both move the view, and nothing is painted.
  giveUp() {
    const { first } = this.pen;
    this.pen = null;
    this.strokes.current = null;
    const again = new PointerEvent("pointerdown", first);
    again.isPasses = true;
    this.viewer.canvas.dispatchEvent(again);
    this.viewer.move(true);
  }

  pick(event) {
    const [x, y] = this.place(event), found = this.viewer.pick(x, y)?.channels.find(({ name }) => name === this.strokes.channel);
    if (found) this.set({ color: found.values.map((light) => 255 * Math.min(Math.max(light <= 0.0031308 ? 12.92 * light : 1.055 * light ** (1 / 2.4) - 0.055, 0), 1)) });
    if (this.tool === "pick") this.choose("brush");
  }

  fill(event) {
    const { color, opacity, mirror } = this.brush, [x, y] = this.place(event);
    const isPart = element("filled").value === "part", at = isPart ? this.viewer.pick(x, y)?.rest : undefined;
    if (isPart && !at) return;
    this.sending.send({ kind: "fill", name: isPart ? "Fill a part" : "Fill all", color, opacity, mirror, at });
    this.choose("brush");
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
      b: () => this.choose("brush"),
      i: () => this.choose("pick"),
      f: () => this.choose("fill"),
      x: () => this.swap(),
      "[": () => this.set({ size: Math.min(Math.round(size / STEP), size - 1) }),
      "]": () => this.set({ size: Math.max(Math.round(size * STEP), size + 1) }),
      "{": () => this.set({ hardness: hardness - 0.1 }),
      "}": () => this.set({ hardness: hardness + 0.1 }),
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
    ring.hidden = at === null || this.tool !== "brush";
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
