"""What ``sample`` and ``convert`` enter: a value goes down through few functions of few files."""

import inspect
import sys
from pathlib import Path

import numpy as np
import pytest

import octex
from octex.channels import ALPHA
from tests.conftest import needs_jit
from tests.make.painted import ball
from tests.make.small_textures import shell, unit, with_channel

ROOT = Path(octex.__file__).parent
DIRECTIONS = unit(np.random.default_rng(0).normal(size=(100, 3)))
POINTS = 0.5 + 0.45 * DIRECTIONS
WIDTHS = np.linspace(0.01, 0.2, 100)

QUESTIONS = {
    "plain": {},
    "nearest": {"filter": "nearest"},
    "linear": {"filter": "linear"},
    "quartic": {"filter": "quartic"},
    "normals": {"normals": DIRECTIONS},
    "gradient": {"gradient": True},
    "width": {"width": 0.1},
    "widths": {"width": WIDTHS},
    "widths, normals": {"width": WIDTHS, "normals": DIRECTIONS},
    "widths, gradient": {"width": WIDTHS, "gradient": True},
    "pixels": {"dPdx": 0.1 * DIRECTIONS, "dPdy": 0.05 * DIRECTIONS[::-1]},
}


def entered(call):
    """Return the code of the functions of octex that a call enters the second time.

    Kernels are left out, and with them the room that calls them. So are comprehensions and lambdas, which
    newer Pythons count otherwise.
    """
    found = set()

    def note(frame, event, _argument):
        if event == "call" and Path(frame.f_code.co_filename).is_relative_to(ROOT):
            found.add(frame.f_code)

    call()
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
    return {code for code in found if not (code.co_name.startswith("<") or _is_kernel(code))}


def _is_kernel(code):
    """Say whether code is that of a function that numba compiles, or calls such a function."""
    if Path(code.co_filename).parent == ROOT / "jit":
        return True
    module = inspect.getmodule(code)
    return hasattr(getattr(module, code.co_name, None), "py_func")


TEXTURES = {
    "even": lambda: shell(5, keep=0.0),
    "with kept nodes": lambda: shell(5),
    "with alpha": lambda: with_channel(shell(5, keep=0.0), ALPHA, 200),
}


@needs_jit
@pytest.mark.parametrize("question", QUESTIONS)
@pytest.mark.parametrize("kind", TEXTURES)
def test_sample_enters_at_most_40_functions_of_6_files(kind, question):
    texture, options = TEXTURES[kind](), QUESTIONS[question]
    found = entered(lambda: texture.sample(POINTS, **options))
    files = {code.co_filename for code in found}
    assert len(found) <= 40, sorted(code.co_qualname for code in found)
    assert len(files) <= 6, sorted(files)


@needs_jit
def test_convert_enters_at_most_145_functions_of_28_files():
    surface = ball(rings=8)
    found = entered(lambda: octex.convert(surface, 6, threads=1))
    files = {code.co_filename for code in found}
    assert len(found) <= 145, sorted(code.co_qualname for code in found)
    assert len(files) <= 28, sorted(files)


@needs_jit
def test_a_stroke_enters_at_most_278_functions_of_35_files():
    surface = ball()
    texture = octex.convert(surface, 6)
    camera = octex.Camera.fitted(surface.vertices, (0.3, 0.5, 1.0), size=(64, 64))
    image = np.full((64, 64, 4), 200, np.uint8)
    image[:24, :, 3] = image[:, :24, 3] = 0
    painter = octex.Painter(texture, surface)

    def stroke():
        painter.paint(octex.Projection(image, camera), max_depth=6, threads=1)
        painter.undo()

    found = entered(stroke)
    files = {code.co_filename for code in found}
    assert painter.redo()
    assert len(found) <= 278, len(found)
    assert len(files) <= 35, len(files)
