"""Painting reads as the paper tells it: seven steps, and nothing of photographs for a single image."""

import subprocess
import sys

from octex.painting import steps
from tests.house.test_house import MODULES, imports

#: What photographs are looked at with; the rest of painting comes after them.
BEFORE_PHOTOS = {
    "layer", "multigrid", "image", "project", "reading", "resume", "sheets", "sight", "surface",
}  # fmt: skip


def test_the_seven_steps_are_named_and_numbered_as_in_the_paper():
    named = (
        steps.rasterize_surface, steps.refine_paint, steps.form_boundary, steps.raise_texture,
        steps.merge_paint, steps.delete_paint, steps.cull_cells,
    )  # fmt: skip
    for number, step in enumerate(named, 1):
        assert (step.__doc__ or "").startswith(f"{number}. ")


def test_photographs_know_nothing_of_what_is_done_with_their_paint():
    for module in MODULES:
        names = imports(module)
        if module.startswith("photos/"):
            known = {name.split(".")[2] for name in names if name.startswith("octex.painting.")}
            assert known <= BEFORE_PHOTOS, module
        elif module.startswith("painting/") and module != "painting/paint":
            assert not any(name.startswith("octex.photos") for name in names), module


def test_a_single_image_never_enters_what_photographs_need():
    task = (
        "import sys, octex\n"
        "from tests.make.painted import ball, image_of\n"
        "surface = ball(rings=8)\n"
        "camera = octex.Camera.fitted(surface.vertices, (0, 0, 1), size=(16, 16))\n"
        "image = octex.Projection(image_of(surface, camera), camera)\n"
        "octex.paint(None, surface, image, max_depth=3)\n"
        "print(*[name for name in sys.modules if name.startswith('octex.photos')])\n"
    )
    done = subprocess.run([sys.executable, "-c", task], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
