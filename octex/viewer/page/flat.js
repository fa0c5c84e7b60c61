// A piece of the model, laid flat and seen from the front, to be painted on as the model is. See poses.py.

import { inflated } from "./data.js";
import { element } from "./elements.js";
import { unpackedMesh } from "./mesh.js";
import { act, make } from "./panel.js";

const SHARE = 0.25; // the radius that is laid flat, of the height of what is seen
const STEP = 1.4; // between one radius and the next

export class Flat {
  constructor(painting) {
    this.painting = painting;
    this.before = null; // while it is open: how the model was shown
    this.asked = null; // the patch that was asked for last
  }

  // The bar over the picture.
  get bar() {
    return make("div", { id: "flat", hidden: true },
      make("span", { id: "flat-note", role: "status" }),
      act("flat-narrower", "less", "Lay less of the model flat", () => this.widen(1 / STEP)),
      act("flat-wider", "more", "Lay more of the model flat", () => this.widen(STEP)),
      act("flat-back", "back", "Back to the model (U, Esc)", () => this.close()));
  }

  // Lay flat what is around a place of the picture.
  async open(event) {
    const { viewer } = this.painting, [x, y] = this.painting.place(event), center = viewer.seen(x, y);
    if (!center || this.before) return;
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
    const { viewer } = this.painting, { look, camera, parts: [part] } = viewer, asked = (this.asked = { spot, moved });
    const answer = await fetch(`patch?${encodeURIComponent(JSON.stringify({ patch: spot, moved }))}`).catch(() => null);
    if (!answer?.ok) {
      this.asked = look.patch;
      this.painting.say(`This cannot be laid flat: ${answer ? (await answer.text()).trim() : "the connection is lost"}`);
      return false;
    }
    const bytes = new Uint8Array(await answer.arrayBuffer()), end = bytes.indexOf(10);
    const { mesh, faults } = JSON.parse(new TextDecoder().decode(bytes.subarray(0, end)));
    const unpacked = unpackedMesh(mesh, await inflated(new Blob([bytes.subarray(end + 1)]).stream()), null);
    if (this.asked !== asked) return false;
    viewer.turn(false);
    element("turntable").checked = false;
    if (element("beside").checked) element("beside").click();
    this.before ??= { mesh: part.mesh, header: part.header.mesh, camera: camera.state, bounds: viewer.bounds() };
    part.header.mesh = mesh;
    part.takeMesh(unpacked);
    Object.assign(look, { patch: asked, moved: null, marked: null });
    if (look.shown === "lit") look.shown = "unlit";
    camera.isFlat = true;
    [camera.low, camera.high] = part.bounds;
    camera.reset();
    element("player").hidden = true;
    element("flat-note").textContent = element("flat-note").title = ["Laid flat", ...faults].join("; ");
    element("flat").hidden = false;
    viewer.move();
    return true;
  }

  // Show the model again; says whether it was laid flat.
  close() {
    const { viewer } = this.painting, { camera, parts: [part], player } = viewer;
    if (!this.before) return false;
    const { mesh, header, camera: state } = this.before;
    this.before = this.asked = null;
    part.header.mesh = header;
    part.takeMesh(mesh);
    if (part.motion) part.takeMotion(part.motion);
    viewer.look.patch = null;
    viewer.choose(element("shown").value);
    camera.isFlat = false;
    Object.assign(camera, state);
    element("flat").hidden = true;
    element("player").hidden = !player;
    player?.seek(player.time);
    viewer.move();
    return true;
  }
}
