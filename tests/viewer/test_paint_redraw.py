"""After a change the page draws anew only what is near it, and its image is as if it had drawn all."""

import numpy as np

from tests.make.browser import sharp
from tests.make.studio import Studio

#: How many pixels of the image differ from one that is drawn anew, and how many of that one show the model.
_UNLIKE = """() => {
  const { gpu, canvas: { width, height }, display, camera } = viewer, { gl } = gpu;
  const read = () => {
    const codes = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, gpu.targets.image.buffer);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, codes);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return new Uint32Array(codes.buffer);
  };
  const before = read();
  gpu.draw(display, camera, width, height);
  const now = read();
  return [before.filter((code, n) => code !== now[n]).length, now.filter((code) => code !== now[0]).length];
}"""


def test_only_what_is_near_a_change_is_drawn_anew(browser, tmp_path):
    studio, random = Studio(browser, tmp_path, depth=8), np.random.default_rng(0)
    with studio.opened() as page:
        near = 0
        page.set_viewport_size({"width": 760, "height": 280})
        page.evaluate("viewer.maxScale = 0.5")
        for view in ("orbit(0.3, 0.2)", "zoom(0.2)", "zoom(9.0)", "orbit(0.9, 0.1)"):
            page.evaluate(f"viewer.camera.{view}; viewer.invalidate()")
            sharp(page)
            for step in range(3):
                size = int(random.integers(3, 20))
                page.evaluate("(size) => viewer.painting.set({ size })", size)
                looked_up, images = page.evaluate("[viewer.lookupKey, viewer.imageCount]")
                x, y = random.integers(-15, 15, 2).tolist()
                if step < 2:
                    studio.drag(page, (x, y), (x + 6, y + 4))
                else:
                    page.keyboard.press("Control+z")
                studio.is_done(page)
                page.wait_for_function("!viewer.changedRegion && viewer.isSharp")
                unlike, shown = page.evaluate(_UNLIKE)
                assert unlike == 0
                assert shown > 100
                is_small = all(change.tiles is not None for change in studio.session.shown.changes)
                if is_small and looked_up == page.evaluate("viewer.lookupKey"):
                    assert page.evaluate("viewer.imageCount") == images
                    near += 1
        assert near >= 6
