// Pointer, wheel and keys of the image: orbit, pan and zoom.

const ORBIT_STEP = 0.09; // radians that an arrow key turns

// The zoom factor of a wheel event.
export function wheelFactor({ deltaY, deltaMode }) {
  const pixels = deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 * deltaY : deltaY;
  return Math.exp(-Math.max(-200, Math.min(200, pixels)) * 0.0015);
}

// Let a canvas control a camera. `surfaceAt(x, y)` returns the point of the model there, or null. `changed` is called after
// each change of the camera, with true while a pointer is down; `released` when the last pointer is up.
export function addControls(canvas, camera, { surfaceAt, changed, released }) {
  const pointers = new Map();
  let spread = 0; // distance of two pointers
  let anchor = null; // the last point that was zoomed to, its position in the image, and the view after that

  const center = () => [canvas.clientWidth / 2, canvas.clientHeight / 2];

  const zoomAt = (position, factor) => {
    if (String(anchor?.position) !== String(position) || anchor.view !== String(camera.view)) {
      const point = surfaceAt(...position) ?? camera.pointAt(position, [canvas.clientWidth, canvas.clientHeight]);
      anchor = { position, point };
    }
    camera.zoom(factor, anchor.point);
    anchor.view = String(camera.view);
  };

  const distance = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) spread = distance();
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before.x, dy = event.clientY - before.y, height = canvas.clientHeight;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) {
      const now = distance(), [a, b] = [...pointers.values()], frame = canvas.getBoundingClientRect();
      camera.pan(dx / height / 2, -dy / height / 2);
      if (spread > 0 && now > 0) zoomAt([(a.x + b.x) / 2 - frame.left, (a.y + b.y) / 2 - frame.top], now / spread);
      spread = now;
    } else if (event.buttons & 2 || event.shiftKey) {
      camera.pan(dx / height, -dy / height);
    } else {
      camera.orbit((-dx / height) * 4, (dy / height) * 4);
    }
    changed(true);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      spread = 0;
      if (!pointers.size) released();
    });
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomAt([event.offsetX, event.offsetY], wheelFactor(event));
    changed();
  }, { passive: false });
  canvas.addEventListener("dblclick", ({ offsetX, offsetY }) => {
    const point = surfaceAt(offsetX, offsetY);
    if (point) camera.focus(point);
    else camera.reset();
    changed();
  });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const move = (x, y) => (event.shiftKey ? camera.pan(-x / 2, -y / 2) : camera.orbit(x, y));
    const actions = {
      ArrowLeft: () => move(-ORBIT_STEP, 0),
      ArrowRight: () => move(ORBIT_STEP, 0),
      ArrowUp: () => move(0, ORBIT_STEP),
      ArrowDown: () => move(0, -ORBIT_STEP),
      "+": () => zoomAt(center(), 1.1),
      "=": () => zoomAt(center(), 1.1),
      "-": () => zoomAt(center(), 1 / 1.1),
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
    changed();
  });
}
