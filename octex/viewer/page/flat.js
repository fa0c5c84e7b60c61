// A piece of the model, laid flat and seen from the front, beside the model: both are painted on. The GPU draws the view
// that the pointer is over; of the other one the page has a picture, drawn anew after each change. See poses.py.

import { inflated } from "./octree.js";
import { element, make } from "./elements.js";
import { unpackedMesh } from "./mesh.js";
import { act } from "./panel.js";

const SHARE = 0.25; // the radius that is laid flat, of the height of what is seen
const STEP = 1.4; // between one radius and the next
const PATIENCE = 160; // milliseconds that a picture of the other view may take

export class Flat {
  constructor(painting) {
    this.painting = painting;
    this.views = null; // while it is open: of the model, and of the piece
    this.asked = null; // the patch that was asked for last
    this.isStale = false; // the picture of the other view
  }

  get isOpen() {
    return this.views !== null;
  }

  // The bar over the picture.
  get bar() {
    return make("div", { id: "flat", hidden: true },
      make("span", { id: "flat-note", role: "status" }),
      act("flat-narrower", "less", "Lay less of the model flat", () => this.widen(1 / STEP)),
      act("flat-wider", "more", "Lay more of the model flat", () => this.widen(STEP)),
      act("flat-back", "back", "Close (V, Esc)", () => this.close()));
  }

  // The picture of the other view: over it the pointer makes that the one which is painted.
  get picture() {
    const isMoved = ({ buttons, movementX, movementY }) => !buttons && (movementX || movementY); // not the page under it
    return (this.other = make("canvas", { id: "other-view", hidden: true, onpointermove: (event) => isMoved(event) && this.turn(),
      onpointerdown: ({ pointerType }) => pointerType === "touch" && this.turn() }));
  }

  // Lay flat what is around a place of the picture.
  async open(event) {
    const { viewer } = this.painting, [x, y] = this.painting.place(event), center = viewer.seen(x, y);
    if (!center || this.isOpen) return;
    const { camera } = viewer, away = Math.hypot(...camera.position.map((p, n) => p - center[n]));
    viewer.player?.stop();
    const spot = { center, radius: SHARE * 2 * away * Math.tan(camera.fov / 2), up: camera.axes[1] };
    if (await this.show(spot, viewer.look.moved)) this.painting.choose("brush");
  }

  widen(times) {
    const { spot, moved } = this.asked;
    return this.show({ ...spot, radius: spot.radius * times }, moved);
  }

  // Show a patch; says whether there is one.
  async show(spot, moved) {
    const { viewer } = this.painting, asked = (this.asked = { spot, moved });
    const answer = await fetch(`patch?${encodeURIComponent(JSON.stringify({ patch: spot, moved }))}`).catch(() => null);
    if (!answer?.ok) {
      this.asked = this.views?.flat.patch ?? null;
      this.painting.say(`This cannot be laid flat: ${answer ? (await answer.text()).trim() : "the connection is lost"}`);
      return false;
    }
    const bytes = new Uint8Array(await answer.arrayBuffer()), end = bytes.indexOf(10);
    const { mesh: header, faults } = JSON.parse(new TextDecoder().decode(bytes.subarray(0, end)));
    const mesh = unpackedMesh(header, await inflated(new Blob([bytes.subarray(end + 1)]).stream()), null);
    if (this.asked !== asked) return false;
    viewer.turn(false);
    element("turntable").checked = false;
    if (element("beside").checked) element("beside").click();
    if (!this.isOpen) this.split();
    else if (this.isFlat) this.turn();
    const { flat } = this.views;
    viewer.parts[0].freeMesh(flat.surface);
    Object.assign(flat, { mesh, header, surface: null, patch: asked, camera: null });
    this.turn();
    element("flat-note").textContent = element("flat-note").title = ["Laid flat", ...faults].join("; ");
    return true;
  }

  get isFlat() {
    return this.isOpen && this.painting.viewer.look.patch !== null && this.painting.viewer.look.patch !== undefined;
  }

  // Make room for both.
  split() {
    const { viewer } = this.painting;
    this.views = { model: { bounds: viewer.bounds() }, flat: {} };
    this.mark(true);
  }

  mark(isOpen) {
    const { main } = this.painting;
    main.classList.toggle("split", isOpen);
    main.classList.toggle("flat", this.isFlat);
    this.other.hidden = element("flat").hidden = !isOpen;
    element("player").hidden = isOpen || !this.painting.viewer.player;
  }

  // Keep a view as it is; show one as it was.
  keep(view) {
    const { camera, parts: [part], look } = this.painting.viewer;
    Object.assign(view, { mesh: part.mesh, header: part.header.mesh, surface: part.surface, patch: look.patch, moved: look.moved, camera: camera.state });
  }

  put(view) {
    const { viewer } = this.painting, { camera, parts: [part], look } = viewer, { mesh, header, surface, patch = null, moved = null } = view;
    part.header.mesh = header;
    if (surface) Object.assign(part, { mesh, surface });
    else part.takeMesh(mesh);
    if (!surface && part.motion && !patch) part.takeMotion(part.motion);
    viewer.choose(element("shown").value);
    Object.assign(look, { patch, moved, marked: null });
    if (patch && look.shown === "lit") look.shown = "unlit";
    camera.isFlat = patch !== null;
    camera.aspect = viewer.canvas.clientWidth / viewer.canvas.clientHeight;
    if (view.camera) return Object.assign(camera, view.camera);
    [camera.low, camera.high] = part.bounds;
    camera.reset();
  }

  // Paint on the other view.
  turn() {
    const { viewer } = this.painting, { views: { model, flat }, isFlat, other } = this, { gpu, canvas } = viewer, { picture } = gpu.pictures;
    const [last, next] = isFlat ? [flat, model] : [model, flat];
    this.keep(last);
    if (picture) this.copy(picture);
    this.put(next);
    this.mark(true);
    this.painting.outline(null);
    this.isStale ||= other.clientWidth !== canvas.clientWidth;
    viewer.move();
  }

  // Give the other view's canvas what the GPU has drawn.
  copy(picture) {
    const { gpu, canvas } = this.painting.viewer;
    gpu.present(picture);
    [this.other.width, this.other.height] = [canvas.width, canvas.height];
    this.other.getContext("2d").drawImage(canvas, 0, 0);
  }

  // Draw the other view anew, if something has changed: as sharply as there is time for.
  refresh() {
    if (!this.isOpen || !this.isStale) return;
    const { viewer } = this.painting, { gpu, camera, canvas, cost } = viewer, { pictures } = gpu, { clientWidth, clientHeight } = this.other;
    const [own, other] = this.isFlat ? [this.views.flat, this.views.model] : [this.views.model, this.views.flat], size = [canvas.width, canvas.height];
    const times = Math.min(Math.sqrt(PATIENCE / (cost * clientWidth * clientHeight || 1)), window.devicePixelRatio || 1, 2);
    this.isStale = false;
    this.keep(own);
    this.put(other);
    camera.aspect = clientWidth / clientHeight;
    gpu.pictures = this.pictures ??= {};
    gpu.draw(viewer.look, camera, ...[clientWidth, clientHeight].map((pixels) => Math.max(Math.round(pixels * times), 1)));
    this.copy(gpu.pictures.picture);
    gpu.pictures = pictures;
    this.put(own);
    [canvas.width, canvas.height] = size;
    gpu.present(pictures.picture);
  }

  // Show the model alone again; says whether a piece was laid flat.
  close() {
    const { viewer } = this.painting;
    if (!this.isOpen) return false;
    if (this.isFlat) this.turn();
    viewer.parts[0].freeMesh(this.views.flat.surface);
    this.views = this.asked = this.pictures = null;
    this.mark(false);
    viewer.player?.seek(viewer.player.time);
    viewer.move();
    return true;
  }

  // The GPU is there again, with nothing of the other view.
  restore() {
    this.pictures = null;
    for (const view of Object.values(this.views ?? {})) view.surface = null;
    this.isStale = true;
  }
}
