// A patch of the model that is laid flat, next to the model: the user paints on both. The GPU draws the view under the
// pointer; of the other view the page has an image in a canvas, drawn again after changes. See octex/session/poses.py.

import { query } from "./data.js";
import { element, make } from "./elements.js";
import { inflate } from "./octree.js";
import { unpackedMesh } from "./mesh.js";
import { iconButton } from "./panel.js";

const RADIUS = 0.25; // of the first patch, as a share of the view's height
const RADIUS_STEP = 1.4;
const REFRESH_TIME = 160; // milliseconds that an image of the other view may take

export class Flat {
  constructor(painting) {
    this.painting = painting;
    this.views = null; // while it is open: the model's view, and the patch's
    this.requested = null; // the last patch that was asked for: { spot, moment }
    this.isStale = false; // the other view's image
  }

  get isOpen() {
    return this.views !== null;
  }

  // The bar above the image.
  get bar() {
    return make("div", { id: "flat", hidden: true },
      make("span", { id: "flat-note", role: "status" }),
      iconButton("flat-narrower", "less", "Lay less of the model flat", () => this.resize(1 / RADIUS_STEP)),
      iconButton("flat-wider", "more", "Lay more of the model flat", () => this.resize(RADIUS_STEP)),
      iconButton("flat-back", "back", "Close (V, Esc)", () => this.close()));
  }

  // The canvas of the other view; a pointer over it swaps the views.
  get canvas() {
    const hasMoved = ({ buttons, movementX, movementY }) => !buttons && (movementX || movementY); // events without: the page has moved
    return (this.other = make("canvas", { id: "other-view", hidden: true, onpointermove: (event) => hasMoved(event) && this.swapViews(),
      onpointerdown: ({ pointerType }) => pointerType === "touch" && this.swapViews() }));
  }

  // Lay the surface around a point of the image flat.
  async open(event) {
    const { viewer } = this.painting, [x, y] = this.painting.place(event), center = viewer.surfaceAt(x, y);
    if (!center || this.isOpen) return;
    const { camera } = viewer, distance = Math.hypot(...camera.position.map((p, n) => p - center[n]));
    viewer.player?.stop();
    const spot = { center, radius: RADIUS * 2 * distance * Math.tan(camera.fov / 2), up: camera.axes[1] };
    if (await this.show(spot, viewer.display.moment)) this.painting.selectTool("brush");
  }

  resize(factor) {
    const { spot, moment } = this.requested;
    return this.show({ ...spot, radius: spot.radius * factor }, moment);
  }

  // Show the patch of a spot; returns whether it is shown.
  async show(spot, moment) {
    const { painting } = this, { viewer } = painting, requested = (this.requested = { spot, moment });
    let answer, mesh;
    try {
      answer = await query("patch", { patch: spot, moved: moment });
      mesh = unpackedMesh(answer.header.mesh, await inflate(new Blob([answer.bytes])), null);
    } catch (error) {
      if (this.requested !== requested) return false;
      this.requested = this.views?.flat.patch ?? null;
      painting.showMessage(`This cannot be laid flat: ${error.message}`);
      return false;
    }
    while (painting.pen) await new Promise(requestAnimationFrame); // the view must not change under a stroke
    if (this.requested !== requested) return false;
    viewer.setTurntable(false);
    if (element("compare").checked) element("compare").click();
    if (!this.isOpen) this.split();
    else if (this.isFlat) this.swapViews();
    const { flat } = this.views;
    viewer.parts[0].freeSurface(flat.surface);
    Object.assign(flat, { mesh, header: answer.header.mesh, surface: null, patch: requested, camera: null });
    this.swapViews();
    element("flat-note").textContent = element("flat-note").title = ["Laid flat", ...answer.header.faults].join("; ");
    return true;
  }

  // Whether the GPU draws the patch.
  get isFlat() {
    return this.painting.viewer.display.patch !== null;
  }

  // Make room for both views.
  split() {
    const { viewer } = this.painting;
    this.views = { model: { bounds: viewer.bounds() }, flat: {} };
    this.showLayout();
  }

  showLayout() {
    const { main, viewer } = this.painting, { isOpen } = this;
    main.classList.toggle("split", isOpen);
    main.classList.toggle("flat", this.isFlat);
    this.other.hidden = element("flat").hidden = !isOpen;
    element("player").hidden = isOpen || !viewer.player;
  }

  // Store the current mesh, pose and camera in a view.
  storeView(view) {
    const { camera, parts: [part], display: { patch, moment } } = this.painting.viewer;
    Object.assign(view, { mesh: part.mesh, header: part.header.mesh, surface: part.surface, patch, moment, camera: camera.state });
  }

  restoreView(view) {
    const { viewer } = this.painting, { camera, parts: [part], display } = viewer, { mesh, header, surface, patch = null, moment = null } = view;
    part.header.mesh = header;
    if (surface) Object.assign(part, { mesh, surface });
    else part.setMesh(mesh);
    if (!surface && part.motion && !patch) part.setMotion(part.motion);
    viewer.setMode(element("mode").value);
    Object.assign(display, { patch, moment, highlight: null });
    if (patch && display.mode === "lit") display.mode = "unlit"; // light on the patch would mislead
    camera.isFlat = patch !== null;
    camera.aspect = viewer.canvas.clientWidth / viewer.canvas.clientHeight;
    if (view.camera) return Object.assign(camera, view.camera);
    [camera.low, camera.high] = part.bounds;
    camera.reset();
  }

  // Let the GPU draw the other view, and put the image of the current one into the canvas.
  swapViews() {
    const { viewer } = this.painting, { views: { model, flat }, isFlat, other } = this, { gpu, canvas } = viewer, { image } = gpu.targets;
    const [last, next] = isFlat ? [flat, model] : [model, flat];
    this.storeView(last);
    if (image) this.copyImage(image);
    this.restoreView(next);
    this.showLayout();
    this.painting.showOutline(null);
    this.isStale ||= other.clientWidth !== canvas.clientWidth;
    viewer.invalidate();
  }

  // Copy an image of the GPU into the other view's canvas.
  copyImage(image) {
    const { gpu, canvas } = this.painting.viewer;
    gpu.present(image);
    [this.other.width, this.other.height] = [canvas.width, canvas.height];
    this.other.getContext("2d").drawImage(canvas, 0, 0);
  }

  // Draw the other view again if it is stale, as sharply as time allows.
  refresh() {
    if (!this.isOpen || !this.isStale) return;
    const { viewer } = this.painting, { gpu, camera, canvas, pixelTime } = viewer, { targets } = gpu, { clientWidth, clientHeight } = this.other;
    const [current, other] = this.isFlat ? [this.views.flat, this.views.model] : [this.views.model, this.views.flat], size = [canvas.width, canvas.height];
    const scale = Math.min(Math.sqrt(REFRESH_TIME / (pixelTime * clientWidth * clientHeight || 1)), viewer.pixelRatio);
    this.isStale = false;
    this.storeView(current);
    this.restoreView(other);
    camera.aspect = clientWidth / clientHeight;
    gpu.targets = this.targets ??= {};
    gpu.draw(viewer.display, camera, ...[clientWidth, clientHeight].map((pixels) => Math.max(Math.round(pixels * scale), 1)));
    this.copyImage(gpu.targets.image);
    gpu.targets = targets;
    this.restoreView(current);
    [canvas.width, canvas.height] = size;
    gpu.present(targets.image);
  }

  // Show the model alone again; returns whether a patch was open.
  close() {
    const { viewer } = this.painting;
    this.requested = null;
    if (!this.isOpen) return false;
    if (this.isFlat) this.swapViews();
    viewer.parts[0].freeSurface(this.views.flat.surface);
    this.views = this.targets = null;
    this.showLayout();
    viewer.player?.seek(viewer.player.time);
    viewer.invalidate();
    return true;
  }

  // The context was lost: the meshes and the image of the other view are gone.
  restoreContext() {
    this.targets = null;
    for (const view of Object.values(this.views ?? {})) view.surface = null;
    this.isStale = true;
  }
}
