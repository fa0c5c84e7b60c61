// Mouse, touch and keys on the picture: orbit, pan and zoom. `seen` returns the point of the model at a place of the
// picture, or null. `moved` is called after each change, with whether a pointer is down; `rested` once none is any more.

const STEP = 0.09;

// How many times larger a wheel makes what it zooms.
export function wheelTimes({ deltaY, deltaMode }) {
  const lines = deltaMode === 1 ? 16 : 1;
  return Math.exp(-Math.max(-200, Math.min(200, deltaY * lines)) * 0.0015);
}

export function control(canvas, camera, seen, moved, rested) {
  const pointers = new Map();
  let spread = 0;
  let anchor = null; // what was last zoomed to, where, and the camera's view after that

  const middle = () => [canvas.clientWidth / 2, canvas.clientHeight / 2];
  const near = (at) => seen(...at) ?? camera.pointAt(at, [canvas.clientWidth, canvas.clientHeight]);

  const zoomAt = (at, times) => {
    if (String(anchor?.at) !== String(at) || anchor.view !== String(camera.view)) anchor = { at, point: near(at) };
    camera.zoom(times, anchor.point);
    anchor.view = String(camera.view);
  };

  const gap = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) spread = gap();
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before.x, dy = event.clientY - before.y, height = canvas.clientHeight;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) {
      const now = gap(), [a, b] = [...pointers.values()], frame = canvas.getBoundingClientRect();
      camera.pan(dx / height / 2, -dy / height / 2);
      if (spread > 0 && now > 0) zoomAt([(a.x + b.x) / 2 - frame.left, (a.y + b.y) / 2 - frame.top], now / spread);
      spread = now;
    } else if (event.buttons & 2 || event.shiftKey) {
      camera.pan(dx / height, -dy / height);
    } else {
      camera.orbit((-dx / height) * 4, (dy / height) * 4);
    }
    moved(true);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      spread = 0;
      if (!pointers.size) rested();
    });
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomAt([event.offsetX, event.offsetY], wheelTimes(event));
    moved();
  }, { passive: false });
  canvas.addEventListener("dblclick", ({ offsetX, offsetY }) => {
    const point = seen(offsetX, offsetY);
    if (point) camera.focus(point);
    else camera.reset();
    moved();
  });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const pan = event.shiftKey ? 1 : 0;
    const turn = (x, y) => (pan ? camera.pan(-x / 2, -y / 2) : camera.orbit(x, y));
    const actions = {
      ArrowLeft: () => turn(-STEP, 0),
      ArrowRight: () => turn(STEP, 0),
      ArrowUp: () => turn(0, STEP),
      ArrowDown: () => turn(0, -STEP),
      "+": () => zoomAt(middle(), 1.1),
      "=": () => zoomAt(middle(), 1.1),
      "-": () => zoomAt(middle(), 1 / 1.1),
      Home: () => camera.reset(),
      0: () => camera.reset(),
      1: () => camera.reset(0, 0),
      2: () => camera.reset(Math.PI / 2, 0),
      3: () => camera.reset(Math.PI, 0),
      4: () => camera.reset(-Math.PI / 2, 0),
      5: () => camera.reset(0, 1.57),
      6: () => camera.reset(0, -1.57),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
    moved();
  });
}
