"""Web files in three.js: pixels are samples."""

import numpy as np
import pytest

import octex
from octex.channels import linear_to_srgb
from octex.source.surface import Surface
from octex.viewer.export import write_page
from tests.conftest import needs_jit
from tests.make import three
from tests.make.painted import ball
from tests.make.three import SIZE, needs_three, opened, pixel_points, square, waves

pytestmark = [needs_jit, needs_three]
SCRIPT = """
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { GLTFOctreeTexture, OctreeTextureLoader } from "octex-three";
const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
renderer.setPixelRatio(1);
renderer.setSize(64, 64);
const imaged = (scene, view = camera) => {
  renderer.render(scene, view);
  const gl = renderer.getContext(), codes = new Uint8Array(4 * 64 * 64);
  gl.readPixels(0, 0, 64, 64, gl.RGBA, gl.UNSIGNED_BYTE, codes);
  return Array.from(codes);
};
const unlit = ({ textures: [texture], group }) => {
  group.children[0].material = texture.applyTo(new THREE.MeshBasicMaterial({ side: THREE.DoubleSide }));
  return new THREE.Scene().add(group);
};
const own = { OctreeTextureLoader, GLTFOctreeTexture, renderer };
globalThis.told = { THREE, GLTFLoader, ...own, imaged, read, unlit, camera };
"""


@pytest.fixture
def page(browser, tmp_path):
    with opened(browser, tmp_path, SCRIPT) as found:
        yield found


def codes(found):
    return np.array(found).reshape(SIZE, SIZE, 4)[..., :3]


@pytest.mark.parametrize("max_error", [None, 20.0])
def test_pixels_are_samples(page, tmp_path, max_error):
    surface = square()
    texture = octex.convert(surface, depth=5, max_error=max_error)
    write_page(texture, tmp_path / "square.octw", surface)
    page.evaluate(
        "async () => { told.own = await told.read('/square.octw'); told.scene = told.unlit(told.own); }"
    )
    points = pixel_points()
    for filter in ("nearest", "linear", "quadratic"):
        asked = """filter => {
          Object.assign(told.own.textures[0], { filter, footprints: false });
          return told.imaged(told.scene);
        }"""
        found = codes(page.evaluate(asked, filter))
        wanted = 255 * linear_to_srgb(texture.sample(points, filter=filter).reshape(SIZE, SIZE, 3))
        assert np.abs(found - wanted).max() <= 1.0, filter
    page.evaluate("() => { told.own.textures[0].footprints = true; }")
    found = codes(page.evaluate("() => told.imaged(told.scene)"))
    wanted = 255 * linear_to_srgb(texture.sample(points, width=1 / SIZE).reshape(SIZE, SIZE, 3))
    assert np.abs(found - wanted).max() <= 2.0


def test_models_of_gltf_and_instances_show_the_same(page, tmp_path):
    surface = ball(24).with_sources({"base_color": waves})
    texture = octex.convert(surface, depth=5)
    write_page(texture, tmp_path / "ball.octw", surface)
    write_page(texture, tmp_path / "bare.octw")
    octex.write_model(octex.bake(texture, surface, texture_size=64), tmp_path / "ball.glb")
    page.evaluate(
        """async () => {
          const { THREE, read, unlit, GLTFLoader } = told;
          told.view = new THREE.OrthographicCamera(-1.2, 1.2, 1.2, -1.2, 0.1, 20);
          told.view.position.set(0, 0, 10);
          const own = await read("/ball.octw"), bare = await read("/bare.octw"), [mesh] = own.group.children;
          const gltf = await new GLTFLoader().loadAsync("/ball.glb");
          bare.textures[0].applyToObject(gltf.scene, () => new THREE.MeshBasicMaterial());
          told.scenes = [unlit(own), new THREE.Scene().add(gltf.scene)];
          const many = new THREE.InstancedMesh(mesh.geometry, mesh.material, 2), at = new THREE.Matrix4();
          many.setMatrixAt(0, at.makeScale(0.5, 0.5, 0.5).setPosition(-0.6, 0, 0));
          many.setMatrixAt(1, at.makeScale(0.5, 0.5, 0.5).setPosition(0.6, 0, 0));
          told.scenes.push(new THREE.Scene().add(many));
        }"""
    )
    own, other, many = (
        codes(page.evaluate(f"() => told.imaged(told.scenes[{n}], told.view)")) for n in range(3)
    )
    assert (own > 0).any(axis=2).mean() > 0.4
    assert np.percentile(np.abs(own - other), 99) <= 2
    np.testing.assert_array_less(np.abs(many[:, :32] - many[:, 32:]), 2)


@pytest.mark.parametrize("ending", [".glb", ".gltf"])
def test_models_that_carry_their_octree_show_it(page, tmp_path, ending):
    """With the extension pixels are samples; without it, the vertices' colours. Poses change nothing."""
    surface = square()
    texture = octex.convert(surface, depth=5)
    path = (tmp_path / "square").with_suffix(ending)
    octex.write_model(octex.bake_vertices(texture, surface), path, octree=texture)
    moved = surface.vertices @ np.diag([0.5, 0.5, 1.0]) + [0.25, 0.25, 0.0]
    posed = Surface.from_arrays(moved, surface.triangles).with_rest(surface.vertices)
    octex.write_model(octex.bake_vertices(texture, posed), tmp_path / "posed.glb", octree=texture)
    page.evaluate(
        """() => {
          const { THREE, GLTFLoader, GLTFOctreeTexture, imaged } = told;
          told.seen = async (name, knows) => {
            const loader = new GLTFLoader();
            if (knows) loader.register((parser) => new GLTFOctreeTexture(parser));
            const gltf = await loader.loadAsync(name);
            for (const { texture, complete } of gltf.octrees ?? []) {
              await complete;
              texture.footprints = false;
            }
            gltf.scene.traverse((mesh) => {
              if (mesh.isMesh) mesh.material.side = THREE.DoubleSide;
            });
            const light = new THREE.AmbientLight(0xffffff, Math.PI);
            return imaged(new THREE.Scene().add(gltf.scene, light));
          };
        }"""
    )
    points = pixel_points().reshape(SIZE, SIZE, 3)
    for knows, model in ((True, path), (False, path), (True, tmp_path / "posed.glb")):
        found = codes(page.evaluate("given => told.seen(...given)", [f"/{model.name}", knows]))
        own = points if model == path else (points - [0.25, 0.25, 0.0]) * [2.0, 2.0, 1.0]
        inside = ((own > 0) & (own < 1)).all(axis=2)
        wanted = 255 * linear_to_srgb(texture.sample(own[inside]))
        difference = np.abs(found[inside] - wanted)
        # Lit materials reflect a little less than their colour.
        assert difference.max() <= 3.0 if knows else difference.mean() > 12, model.name


def test_mirrored_sheets_show_the_side_that_is_seen(page, tmp_path):
    sheet = three.two_sided()
    texture = octex.convert(sheet, depth=4)
    assert texture.tree.split.cells.size
    write_page(texture, tmp_path / "sheet.octw", sheet)
    seen = page.evaluate(
        f"""async () => {{
          const loaded = await told.read("/sheet.octw");
          told.unlit(loaded);
          loaded.group.children[0].material.side = told.THREE.FrontSide;
          return ({three.TURNED})(told.THREE, loaded.group.children[0], told.imaged);
        }}"""
    )
    np.testing.assert_allclose(np.array(seen)[:, :3], [three.RED] * 4 + [three.BLUE] * 4, atol=4)


def test_one_material_may_serve_several_meshes_and_own_colours_do_not_count(page, tmp_path):
    surface = square()
    texture = octex.convert(surface, depth=4)
    write_page(texture, tmp_path / "square.octw", surface)
    wanted = 255 * linear_to_srgb(texture.sample([[32.5 / SIZE, 32.5 / SIZE, 0.3]], width=1 / SIZE))[0]
    seen = page.evaluate(
        """async () => {
          const { THREE, read, imaged } = told, { textures: [texture], group } = await read("/square.octw");
          const [mesh] = group.children;
          const shared = new THREE.MeshBasicMaterial({ color: 0x333333, vertexColors: true });
          mesh.geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(12).fill(0.2), 3));
          group.add(new THREE.Mesh(mesh.geometry, shared));
          texture.applyToObject(group, () => shared);
          return imaged(new THREE.Scene().add(group)).slice(4 * (32 * 64 + 32), 4 * (32 * 64 + 32) + 3);
        }"""
    )
    np.testing.assert_allclose(seen, wanted, atol=4)


def test_a_texture_of_one_value_draws_as_the_material_does(page, tmp_path):
    """With lights, shadows, fog, instances and a skin: three's own material of that value is the measure."""
    three.write_plain_ball(tmp_path / "ball.octw")
    asked = """async () => {
      const { THREE, read, renderer, imaged } = told, scene = %s;
      const { group, textures: [texture] } = await read("/ball.octw");
      renderer.shadowMap.enabled = true;
      const material = texture.applyTo(new THREE.MeshStandardMaterial());
      return scene(THREE, group.children[0].geometry, material).map((each) => imaged(...each));
    }"""
    found, wanted, still = map(codes, page.evaluate(asked % three.SCENES))
    assert len(np.unique(wanted.reshape(-1, 3), axis=0)) > 500  # it is an image with light in it
    assert np.abs(found - wanted).max() <= 2.0
    assert (np.abs(found - still).max(axis=2) > 20).mean() > 0.02


def noise(points):
    """Colours that take many bytes."""
    return np.random.default_rng(1).random((len(points), 3))


def test_the_first_bytes_show_an_image(page, tmp_path):
    """Coarse levels, while all that lies behind the first 100,000 bytes has not come; then the others."""
    surface = square().with_sources({"base_color": lambda p: 0.7 * waves(p) + 0.3 * noise(p)})
    texture = octex.convert(surface, depth=8)
    (tmp_path / "ranged").mkdir()
    path = tmp_path / "ranged" / "square.octw"
    write_page(texture, path, surface)
    assert path.stat().st_size > 150_000
    page.evaluate(
        """async () => {
          told.own = await new told.OctreeTextureLoader().loadAsync("/ranged/square.octw");
          told.own.textures[0].footprints = false;
          told.scene = told.unlit(told.own);
        }"""
    )
    points = pixel_points()
    page.wait_for_function("told.own.textures[0].octree.depth >= 4")
    while len(page.server.asked) < 2:
        page.wait_for_timeout(20)  # ms
    reached = page.evaluate("told.own.textures[0].octree.depth")
    assert 4 <= reached < 8
    for level in (reached, 8):
        if level == 8:
            page.server.gate.set()
            page.evaluate("told.own.complete")
        found = codes(page.evaluate("told.imaged(told.scene)"))
        wanted = texture.level(level).sample(points).reshape(SIZE, SIZE, 3)
        assert np.abs(found - 255 * linear_to_srgb(wanted)).max() <= 1.0
    assert len(page.server.asked) <= 4  # the start, and a request for each stream beyond it


def test_pages_without_workers_read_files_themselves(page, tmp_path):
    surface = square()
    write_page(octex.convert(surface, depth=4), tmp_path / "square.octw", surface)
    seen = page.evaluate(
        """async () => {
          const seen = [], own = Worker;
          class Broken {
            constructor() { setTimeout(() => this.onerror()); }
            postMessage() {}
            terminate() {}
          }
          for (const kind of [own, undefined, Broken]) {
            globalThis.Worker = kind;
            seen.push(told.imaged(told.unlit(await told.read("/square.octw"))));
          }
          globalThis.Worker = own;
          return seen;
        }"""
    )
    assert len(seen) == 3 and seen[0] == seen[1] == seen[2]
    assert np.ptp(codes(seen[0])) > 100


def test_a_lost_context_comes_back_with_its_image(page, tmp_path):
    surface = square()
    write_page(octex.convert(surface, depth=5, max_error=20.0), tmp_path / "square.octw", surface)
    before, lost, after = page.evaluate(
        """async () => {
          const scene = told.unlit(await told.read("/square.octw")), images = [told.imaged(scene)];
          const canvas = told.renderer.domElement, gl = told.renderer.getContext();
          const lose = gl.getExtension("WEBGL_lose_context");
          const turns = (name) => new Promise((resolve) => {
            canvas.addEventListener(name, () => setTimeout(resolve), { once: true });
          });
          for (const [name, act] of [["lost", "loseContext"], ["restored", "restoreContext"]]) {
            const turned = turns(`webglcontext${name}`);
            lose[act]();
            await turned;
            images.push(told.imaged(scene));
          }
          return images;
        }"""
    )
    assert before == after
    assert np.ptp(codes(before)) > 100 and lost != before
    page.complaints[:] = [each for each in page.complaints if "ontext" not in each]


def test_a_gpu_whose_textures_are_too_small_is_told(page, tmp_path):
    surface = square()
    write_page(octex.convert(surface, depth=3), tmp_path / "square.octw", surface)
    said = page.evaluate(
        """async () => {
          const scene = told.unlit(await told.read("/square.octw")), { capabilities } = told.renderer;
          capabilities.maxTextureSize = 2048;
          try {
            told.imaged(scene);
          } catch ({ message }) {
            return message;
          }
        }"""
    )
    assert said == (
        "this GPU has textures of 2048, and the octree needs 4096: write the file with a --max-size"
    )


def test_files_that_cannot_be_read_are_refused_in_words(page, tmp_path):
    write_page(octex.convert(square(), depth=3), tmp_path / "good.octw")
    whole = (tmp_path / "good.octw").read_bytes()
    (tmp_path / "other.octw").write_bytes(b"something else that is long enough")
    (tmp_path / "newer.octw").write_bytes(whole[:8] + b"\x09" + whole[9:])
    (tmp_path / "cut.octw").write_bytes(whole[:-20])
    (tmp_path / "header.octw").write_bytes(whole[:16] + b"?" + whole[17:])
    (tmp_path / "levels.octw").write_bytes(whole[:-20] + bytes(20))
    (tmp_path / "ranged").mkdir()
    (tmp_path / "ranged" / "bare.octw").write_bytes(whole[: 16 + int.from_bytes(whole[12:16], "little")])
    page.server.gate.set()
    for name, complaint in (
        ("other", "/other.octw is no octex web file"),
        ("newer", "/newer.octw has version 9; this octex-three reads version 1"),
        ("cut", "/cut.octw ends too early"),
        ("ranged/bare", "/ranged/bare.octw ends too early"),  # the server says 416
        ("header", "/header.octw is damaged, in header; write it again"),
        ("levels", "/levels.octw is damaged, in 0-levels-0; write it again"),
    ):
        said = page.evaluate("name => told.read(name).catch((error) => error.message)", f"/{name}.octw")
        assert complaint in said
    page.complaints[:] = [each for each in page.complaints if "416" not in each]  # the browser's own
