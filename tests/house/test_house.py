"""The house keeps its shape: who imports whom, what is exported, and what an import costs."""

import ast
import builtins
import json
import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

import octex

ROOT = Path(octex.__file__).parent
MODULES = sorted(path.relative_to(ROOT).with_suffix("").as_posix() for path in ROOT.rglob("*.py"))

# A module imports only from its own row and the rows above.
ROWS = [
    {"arrays", "errors", "files", "gltf", "checks", "ahead", "docs", "jit", "parallel", "channels", "npz"},
    {"tree"},
    {"nearest"},
    {"field"},
    {"container", "remote"},
    {"archive"},
    {"texture"},
    {"kernels"},
    {"editing"},
    {"source"},
    {"voxelize"},
    {"cleaning"},
    {"conversion"},
    {"cameras"},
    {"view"},
    {"painting", "photos"},
    {"processing"},
    {"baking"},
    {"formats"},
    {"drawing"},
    {"session"},
    {"viewer"},
    {"cli", "__main__"},
]
# The wing of what models look like does not know the wing of what is stored; what works on textures alone
# needs neither what makes them of models nor what paints them: it shares its tools with these in editing.
STORED = {"tree", "field", "container", "archive", "texture", "editing"}
MADE = {"source", "voxelize", "cleaning", "conversion", "cameras", "view", "painting", "photos"}
FORBIDDEN = {
    "source": STORED, "cameras": STORED, "view": STORED, "editing": MADE, "processing": MADE - {"source"},
}  # fmt: skip
#: What numpy has from 2.0 on: octex runs beside 1.26, which programs like Blender bring along.
NEW_IN_NUMPY_2 = {
    "acos", "acosh", "asin", "asinh", "astype", "atan", "atan2", "atanh", "bitwise_count", "bitwise_invert",
    "bitwise_left_shift", "bitwise_right_shift", "bool", "concat", "cumulative_prod", "cumulative_sum",
    "isdtype", "long", "mT", "matrix_norm", "matrix_transpose", "matvec", "permute_dims", "pow", "strings",
    "svdvals", "trapezoid", "ulong", "unique_all", "unique_counts", "unique_inverse", "unique_values",
    "unstack", "vecdot", "vecmat", "vector_norm",
}  # fmt: skip
# Depth and cell limits are checked at the border too.
EXCEPTIONS = {("checks", "octex.tree.layout")}

_NAMES = """
Box Camera Creases Environment Layers MappedImage OctexError OctreeTexture Painter Patch PointCloud
Projection Ptex Run Sphere Surface TextureSet Transfer Voxels __version__ bake bake_vertices blur cast
combine convert convert_set crop curves difference displace fill finish levels load_surface merge mix paint
project read_cameras refine_cameras render repair resize separate simplify subdivide unwrap write_cameras
write_model write_osl write_preview write_ptex
"""
EXPORTED = _NAMES.split()

PROJECT = tomllib.loads((ROOT.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@cache
def imports(module):
    """Names of the modules that a module imports, at its top or in its functions, but not for types only."""
    return list(_imports(module))


def _imports(module):
    tree = ast.parse((ROOT / f"{module}.py").read_text(encoding="utf-8"))
    pending = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            pending.extend(node.orelse)
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            assert node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        holders = ast.stmt, ast.ExceptHandler, ast.match_case  # no expression holds an import
        pending.extend(child for child in ast.iter_child_nodes(node) if isinstance(child, holders))


def room(name):
    return name.split(".")[1] if "." in name else ""


def row(name):
    return next(number for number, rooms in enumerate(ROWS) if name in rooms)


def test_modules_import_only_from_the_rows_above_and_their_own():
    for module in MODULES:
        own = module.split("/")[0]
        for name in imports(module) if module != "__init__" else ():
            if not name.startswith("octex.") or name == "octex.__version__":
                continue
            if (own, name.rpartition(".")[0]) in EXCEPTIONS:
                continue
            assert row(room(name)) <= row(own), f"{module} imports {name}"
            assert room(name) not in FORBIDDEN.get(own, set()), f"{module} imports {name}"


def test_each_big_package_has_one_user():
    for module in MODULES:
        packages = {name.split(".")[0] for name in imports(module)}
        # These compile, keep what is compiled, and say that there is compiling.
        if not module.startswith("jit/") and module not in ("ahead", "cli/common"):
            assert not packages & {"numba", "llvmlite"}, module
        if not module.startswith("source/"):
            assert not packages & {"trimesh", "manifold3d"}, module


def test_no_name_is_used_that_numpy_1_26_lacks():
    for module in MODULES:
        used = re.findall(r"\bnp(?:\.linalg)?\.(\w+)", (ROOT / f"{module}.py").read_text())
        assert NEW_IN_NUMPY_2.isdisjoint(used), module


def test_the_exported_names_are_these_and_each_exists():
    assert octex.__all__ == EXPORTED
    for name in [*EXPORTED, "map", "open"]:
        assert getattr(octex, name) is not None
        assert name in dir(octex)
    with pytest.raises(AttributeError, match="no attribute 'paint_it_black'"):
        octex.paint_it_black  # noqa: B018


def test_there_is_one_version_and_the_changelog_has_it():
    assert "version" in PROJECT["dynamic"]  # flit reads octex.__version__
    package = json.loads((ROOT / "viewer" / "package.json").read_text(encoding="utf-8"))
    manifest = tomllib.loads(
        (ROOT.parent / "tools" / "blender" / "extension" / "blender_manifest.toml").read_text("utf-8")
    )
    assert package["version"] == manifest["version"] == octex.__version__
    changes = (ROOT / "docs" / "changelog.md").read_text(encoding="utf-8")
    assert re.search(rf"^## {re.escape(octex.__version__)}\b", changes, re.MULTILINE)


def test_a_star_import_leaves_what_python_has():
    names = {}
    exec("from octex import *", names)
    assert set(names) - {"__builtins__"} == set(EXPORTED)
    assert not set(EXPORTED) & set(dir(builtins)) - {"__version__"}


def test_the_extra_test_brings_what_tests_are_skipped_without():
    listed = [each for extra in PROJECT["optional-dependencies"].values() for each in extra]
    brought = {re.split(r"[^\w-]", each)[0].lower() for each in listed} | {"aiohttp"}  # with fsspec[http]
    packages = {
        "fast_simplification": "fast-simplification", "opengl_basisu": "opengl-basisu", "pxr": "usd-core",
    }  # fmt: skip
    left_out = {"moto", "s3fs", "scipy"}  # much to install for a test each
    texts = [path.read_text("utf-8") for path in (ROOT.parent / "tests").rglob("*.py")]
    modules = set(re.findall(r'importorskip\(\s*"(\w+)', " ".join(texts)))
    assert "playwright" in modules
    assert {packages.get(module, module.lower()) for module in modules - left_out} <= brought
