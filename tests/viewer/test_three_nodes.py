"""Octree textures as nodes of TSL, drawn by WebGPU and by WebGL2: pixels are samples."""

import os

import numpy as np
import pytest

import octex
from octex.channels import linear_to_srgb
from octex.viewer.export import write_page
from tests.conftest import needs_jit
from tests.make import three
from tests.make.browser import started
from tests.make.painted import ball
from tests.make.three import SIZE, needs_three, opened, pixel_points, square, waves

is_chromium = os.environ.get("OCTEX_TEST_BROWSER", "chromium") == "chromium"
pytestmark = [needs_jit, needs_three, pytest.mark.skipif(not is_chromium, reason="WebGPU is chromium's")]
SCRIPT = """
import * as THREE from "three/webgpu";
import { OctreeTextureLoader } from "octex-three";
import { applyNodes } from "octex-three/nodes";
const begin = async (forceWebGL) => {
  const renderer = new THREE.WebGPURenderer({ antialias: false, forceWebGL });
  const target = new THREE.RenderTarget(64, 64, { type: THREE.FloatType });
  await renderer.init();
  renderer.setRenderTarget(target);
  told.renderer = renderer;
  told.imaged = async (scene, view = camera) => {
    renderer.render(scene, view);
    return Array.from(await renderer.readRenderTargetPixelsAsync(target, 0, 0, 64, 64));
  };
  return renderer.backend.isWebGPUBackend ? "webgpu" : "webgl";
};
globalThis.told = { THREE, begin, read, applyNodes };
"""
WEBGPU = ["--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan,WebGPU"]


@pytest.fixture(scope="module")
def browser(driver):
    with started(driver, *WEBGPU) as found:
        yield found


@pytest.fixture(params=["webgpu", "webgl"])
def page(browser, tmp_path, request):
    with opened(browser, tmp_path, SCRIPT, build="webgpu") as page:
        page.backend = page.evaluate("name => told.begin(name === 'webgl')", request.param)
        assert page.backend == request.param
        yield page


def light(page, found):
    """Return an image's linear values (height, width, 3), the lowest row first."""
    rows = np.array(found).reshape(SIZE, SIZE, 4)[..., :3]
    return rows[::-1] if page.backend == "webgpu" else rows


@pytest.mark.parametrize("max_error", [None, 20.0])
def test_pixels_are_samples(page, tmp_path, max_error):
    surface = square()
    texture = octex.convert(surface, depth=7, max_error=max_error)
    write_page(texture, tmp_path / "square.octw", surface)
    page.evaluate("async () => { told.own = await told.read('/square.octw'); }")
    for filter in ("nearest", "linear", "quadratic"):
        for footprints in (False, True):
            asked = """([filter, footprints]) => {
              const { THREE, own: { textures: [texture], group }, applyNodes, imaged } = told;
              Object.assign(texture, { filter, footprints });
              const material = new THREE.MeshBasicMaterial({ side: THREE.DoubleSide });
              texture.mesh.material = applyNodes(texture, material);
              return imaged(new THREE.Scene().add(group));
            }"""
            found = light(page, page.evaluate(asked, [filter, footprints]))
            width = {"width": 1 / SIZE} if footprints else {}
            wanted = texture.sample(pixel_points(), filter=filter, **width).reshape(SIZE, SIZE, 3)
            difference = np.abs(linear_to_srgb(found) - linear_to_srgb(wanted)).max()
            assert 255 * difference <= (2.0 if footprints else 0.1), (filter, footprints)


def test_sheets_show_the_side_that_is_seen_with_alpha(page, tmp_path):
    sheet = three.two_sided(128)
    texture = octex.convert(sheet, depth=4)
    assert texture.tree.split.cells.size and "alpha" in texture.channels
    write_page(texture, tmp_path / "sheet.octw", sheet)
    seen = page.evaluate(
        f"""async () => {{
          const {{ THREE, read, applyNodes, imaged }} = told;
          const {{ textures: [texture] }} = await read("/sheet.octw");
          texture.mesh.material = applyNodes(texture, new THREE.MeshBasicNodeMaterial());
          return ({three.TURNED})(THREE, texture.mesh, imaged);
        }}"""
    )
    alpha = 128 / 255
    codes = 255 * linear_to_srgb(np.array(seen)[:, :3] / alpha)  # over black
    np.testing.assert_allclose(codes, [three.RED] * 4 + [three.BLUE] * 4, atol=4)


def test_lit_models_look_as_by_webglrenderer(page, tmp_path):
    """Own normals, roughness and metal under lights: three's own material is the measure."""
    normal = [0.6, 0.0, 0.8]
    values = {
        "base_color": lambda p: np.tile([0.5, 0.2, 0.05], (len(p), 1)),
        "roughness": 0.4,
        "metallic": 0.2,
    }
    surface = ball(24).with_sources(values)
    write_page(octex.convert(surface, depth=4), tmp_path / "ball.octw", surface)
    flat = square().with_sources({"base_color": waves, "normal": lambda p: np.tile(normal, (len(p), 1))})
    write_page(octex.convert(flat, depth=4), tmp_path / "flat.octw", flat)
    own, plain, lit, tilted = page.evaluate(
        """async () => {
          const { THREE, read, applyNodes, imaged } = told, images = [];
          const sun = () => {
            const light = new THREE.DirectionalLight(0xffffff, 2);
            light.position.set(1.5, 2, 3);
            return light;
          };
          const view = new THREE.PerspectiveCamera(45, 1, 0.1, 20);
          view.position.set(0.3, 0.4, 4);
          view.lookAt(0, 0, 0);
          const { textures: [texture], group } = await read("/ball.octw"), { mesh } = texture;
          const ownOne = applyNodes(texture, mesh.material), other = new THREE.MeshStandardMaterial();
          other.color.setRGB(0.5, 0.2, 0.05);
          Object.assign(other, { roughness: 0.4, metalness: 0.2 });
          const sky = () => new THREE.HemisphereLight(0xaabbff, 0x443322, 1);
          for (const material of [ownOne, other]) {
            mesh.material = material;
            images.push(await imaged(new THREE.Scene().add(mesh, sun(), sky()), view));
          }
          const flat = await read("/flat.octw"), toward = new THREE.DirectionalLight(0xffffff, 3);
          toward.position.set(0, 0, 1);
          for (const has of [true, false]) {
            applyNodes(flat.textures[0], flat.textures[0].mesh.material);
            if (!has) flat.textures[0].mesh.material.normalNode = null;
            flat.textures[0].mesh.material.roughness = 1;
            images.push(await imaged(new THREE.Scene().add(flat.group, toward)));
          }
          return images;
        }"""
    )
    found, wanted = light(page, own), light(page, plain)
    assert np.ptp(wanted) > 0.3
    # The texture has 8 bits.
    assert 255 * np.abs(linear_to_srgb(found) - linear_to_srgb(wanted)).max() <= 2.0
    ratio = light(page, lit).mean() / light(page, tilted).mean()
    assert abs(ratio - normal[2]) < 0.05, "a normal that is tilted takes less light"


def test_a_texture_of_one_value_draws_as_the_material_does(page, tmp_path):
    """With lights, shadows, fog, instances and a skin: three's own material of that value is the measure."""
    three.write_plain_ball(tmp_path / "ball.octw")
    asked = """async () => {
      const { THREE, read, applyNodes, renderer, imaged } = told, scenes = %s;
      const { group, textures: [texture] } = await read("/ball.octw"), images = [];
      renderer.shadowMap.enabled = true;
      const material = applyNodes(texture, new THREE.MeshStandardNodeMaterial());
      const { geometry } = group.children[0];
      for (const each of scenes(THREE, geometry, material)) images.push(await imaged(...each));
      return images;
    }"""
    found, wanted, still = (light(page, each) for each in page.evaluate(asked % three.SCENES))
    assert len(np.unique(wanted.reshape(-1, 3), axis=0)) > 500  # it is an image with light in it
    assert 255 * np.abs(linear_to_srgb(found) - linear_to_srgb(wanted)).max() <= 2.0
    assert (np.abs(found - still).max(axis=2) > 0.05).mean() > 0.02
