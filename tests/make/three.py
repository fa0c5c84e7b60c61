"""Pages of three.js for tests, from a server of their own.

OCTEX_TEST_THREE names the folder of three's package.
"""

from __future__ import annotations

import http.server
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import octex
from octex.channels import srgb_to_linear
from octex.source.surface import Surface
from octex.viewer.export import write_page
from tests.make.painted import ball

THREE = os.environ.get("OCTEX_TEST_THREE", "")
VIEWER = Path(octex.__file__).parent / "viewer"
needs_three = pytest.mark.skipif(not THREE, reason="OCTEX_TEST_THREE names no package of three")
#: Pixels along a side of the canvas.
SIZE = 64
_CORNERS = np.array([[0, 0, 0.3], [1, 0, 0.3], [0, 1, 0.3], [1, 1, 0.3]])
RED, BLUE = [240, 60, 60], [60, 60, 240]
_HEAD = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<script type="importmap">{"imports": {"three": "/three/build/three.%s.js",
"three/webgpu": "/three/build/three.webgpu.js", "three/tsl": "/three/build/three.tsl.js",
"three/addons/": "/three/examples/jsm/", "octex-three": "/viewer/three/index.js",
"octex-three/nodes": "/viewer/three/nodes.js"}}</script>
<script type="module">%s</script>"""


class Handler(http.server.SimpleHTTPRequestHandler):
    folder = Path()
    asked: ClassVar[list[int]]
    gate: ClassVar[threading.Event]
    extensions_map = {**http.server.SimpleHTTPRequestHandler.extensions_map, ".js": "text/javascript"}  # noqa: RUF012

    def translate_path(self, path: str) -> str:
        _, first, *rest = path.split("?")[0].split("/")
        root = {"three": Path(THREE), "viewer": VIEWER}.get(first, self.folder / (first or "index.html"))
        return str(root.joinpath(*rest))

    def do_GET(self) -> None:
        """Answer range requests for files in the folder ranged/; what lies behind the first bytes waits."""
        found, given = Path(self.translate_path(self.path)), self.headers.get("Range")
        if found.parent.name != "ranged" or given is None:
            return super().do_GET()
        begin, end = map(int, given.removeprefix("bytes=").split("-"))
        self.asked.append(begin)
        if begin:
            self.gate.wait(60)
        content = found.read_bytes()
        self.send_response(206 if begin < len(content) else 416)
        self.send_header("Content-Length", str(len(content[begin : end + 1])))
        self.end_headers()
        self.wfile.write(content[begin : end + 1])
        return None

    def log_message(self, *_: object) -> None:
        """Tests have no use for lines of requests."""


@contextmanager
def opened(browser: Any, folder: Path, script: str, build: str = "module") -> Iterator[Any]:
    """Serve files of a folder beside a page that runs a script, which sets ``told``; it must not complain.

    Before the script stand ``camera`` and ``read``.
    """
    (folder / "index.html").write_text(_HEAD % (build, _LOADING + script))
    kind = type("Own", (Handler,), {"folder": folder, "asked": [], "gate": threading.Event()})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), kind) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = browser.new_page(viewport={"width": SIZE, "height": SIZE})
        page.complaints, page.server = [], kind
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.on("console", lambda line: line.type == "error" and page.complaints.append(line.text))
        page.goto(f"http://127.0.0.1:{server.server_port}/")
        page.wait_for_function("globalThis.told")
        yield page
        assert page.complaints == []
        page.close()
        server.shutdown()


def waves(points: Any) -> Any:
    return 0.5 + 0.4 * np.sin(points * [19.0, 13.0, 7.0] + [0.0, 1.0, 2.0])


def square() -> Surface:
    """Return a square of side 1, which fills the canvas."""
    return Surface.from_arrays(_CORNERS, [[0, 1, 2], [1, 3, 2]]).with_sources({"base_color": waves})


def two_sided(*alpha: int) -> Surface:
    """Return that square red in front and blue behind, perhaps translucent."""
    faces = [[0, 1, 2], [1, 3, 2], [2, 1, 0], [2, 3, 1]]
    sides = np.repeat([[*RED, *alpha], [*BLUE, *alpha]], 2, axis=0).astype(np.uint8)
    return Surface.from_arrays(_CORNERS, faces, face_colors=sides)


def pixel_points() -> Any:
    """Return where pixels see the square, (n, 3)."""
    centres = (np.arange(SIZE) + 0.5) / SIZE
    x, y = np.meshgrid(centres, centres)
    return np.stack([x, y, np.full_like(x, 0.3)], axis=2).reshape(-1, 3)


def linear(srgb: list[int]) -> Any:
    color = srgb_to_linear(np.array(srgb) / 255)
    return lambda points: np.tile(color, (len(points), 1))


def write_plain_ball(path: Path) -> None:
    """Write a ball of one value, that of the second material of ``SCENES``."""
    values = {"base_color": linear([200, 100, 50]), "roughness": 102 / 255, "metallic": 51 / 255}
    surface = ball(24).with_sources(values)
    write_page(octex.convert(surface, depth=4), path, surface)


#: A camera that sees the square, and a function that reads a web file; the script imports what they need.
_LOADING = """const camera = new THREE.OrthographicCamera(-0.5, 0.5, 0.5, -0.5, 0.1, 20);
camera.position.set(0.5, 0.5, 10);
const read = async (name) => {
  const loaded = await new OctreeTextureLoader().loadAsync(name);
  await loaded.complete;
  return loaded;
};
"""
#: A function that returns the middle pixels of images of a mesh parallel to z = 0 and of one instance of
#: it: as it is, mirrored, turned around, and both.
TURNED = """async (THREE, mesh, imaged) => {
  const seen = [], middle = 4 * (32 * 64 + 32);
  for (const [mirror, turn] of [[1, 0], [-1, 0], [1, Math.PI], [-1, Math.PI]]) {
    mesh.scale.x = mirror;
    mesh.rotation.y = turn;
    mesh.position.set(mirror * Math.cos(turn) < 0 ? 1 : 0, 0, turn ? 1 : 0);
    mesh.updateMatrix();
    const one = new THREE.InstancedMesh(mesh.geometry, mesh.material, 1);
    one.setMatrixAt(0, mesh.matrix);
    for (const each of [mesh, one]) {
      seen.push((await imaged(new THREE.Scene().add(each))).slice(middle, middle + 4));
    }
  }
  return seen;
}"""
#: A function that returns scenes and their cameras: a ball of a material bent by its skin, of which instances
#: fly about, with lights, shadows and fog; the same of three's own material; and the first, not bent.
SCENES = """(THREE, geometry, own) => {
  const count = geometry.attributes.position.count, weights = new Float32Array(4 * count);
  for (let n = 0; n < count; n++) {
    const share = THREE.MathUtils.smoothstep(geometry.attributes.position.getY(n), -0.5, 0.5);
    weights.set([1 - share, share, 0, 0], 4 * n);
  }
  const joints = new Uint16Array(4 * count).map((_, n) => (n % 4 === 1 ? 1 : 0));
  geometry.setAttribute("skinIndex", new THREE.BufferAttribute(joints, 4));
  geometry.setAttribute("skinWeight", new THREE.BufferAttribute(weights, 4));
  const scene = (material, isBent) => {
    const made = new THREE.Scene(), bones = [new THREE.Bone(), new THREE.Bone()];
    const skinned = new THREE.SkinnedMesh(geometry, material);
    bones[0].add(bones[1]);
    skinned.add(bones[0]).bind(new THREE.Skeleton(bones));
    if (isBent) bones[1].position.x = 0.6;
    const many = new THREE.InstancedMesh(geometry, material, 2), at = new THREE.Matrix4();
    many.setMatrixAt(0, at.makeScale(0.3, 0.3, 0.3).setPosition(-1, 0.9, 0.4));
    many.setMatrixAt(1, at.makeScale(-0.3, 0.3, 0.3).setPosition(1, 0.9, 0.4));
    const floor = new THREE.Mesh(new THREE.PlaneGeometry(6, 6), new THREE.MeshStandardMaterial());
    floor.position.z = -1.2;
    const sun = new THREE.DirectionalLight(0xffffff, 2);
    sun.position.set(1.5, 2, 3);
    for (const each of [skinned, many, sun]) each.castShadow = true;
    for (const each of [skinned, many, floor]) each.receiveShadow = true;
    made.add(skinned, many, floor, sun, new THREE.HemisphereLight(0xaabbff, 0x443322, 1));
    made.fog = new THREE.Fog(0x8899aa, 2, 9);
    const camera = new THREE.PerspectiveCamera(45, 1, 0.1, 20);
    camera.position.set(0.3, 0.4, 4);
    camera.lookAt(0, 0, 0);
    return [made, camera];
  };
  const plain = new THREE.MeshStandardMaterial({ color: 0xc86432 });
  Object.assign(plain, { roughness: 102 / 255, metalness: 51 / 255 });
  return [scene(own, true), scene(plain, true), scene(own, false)];
}"""
