"""octex: octree textures for Python. Colour a model without UVs (Benson & Davis, SIGGRAPH 2002).

The words
    texture     an octree with a value of each channel for each cell
    root cell   the cube that holds the model; a cell of level k is 2⁻ᵏ as wide
    cell        a cube that the surface passes through: a leaf, or a node, which has cells below it
    depth       the finest level
    rest        a point's position before a pose moves it: the texture coordinate
    source      the origin of a point's value: images, functions, numbers, other models, points
    channel     one property: base_color, alpha, roughness …; components are its numbers, codes its integers
    node        its value is the average of the source over the surface inside it
    leaf        its value is a coefficient of the field, or an average without a fit
    field       the function of position that lookups evaluate: a spline over the cells around a point
    fit         choosing the leaves' values so that the field matches the source
    residual    a node's value minus the average of the values below it: not 0 where leaves are fitted
    tap         a stored value that a lookup reads, with its weight
    footprint   the area that a lookup averages over: a width, or derivatives by an image's x and y
    probe       a sample of the field over one level's averages; a footprint adds several up
    facing      the axis direction nearest to a triangle's normal: +x −x +y −y +z −z
    split cell  a cell that stores a value for each facing of the surface in it, one row each
    kept node   a node above finer paint that also stores its old leaf value, for the field next to the paint
    adaptive    of a tree: it has leaves of several levels
    fragment    the part of a triangle that lies in a cell
    layer       a texture that holds only paint: one channel, and its coverage as alpha
    patch       a disc of a surface, laid flat to be painted on in an image

The rooms, each of which knows only those before it (painting and photos know each other)
    tree        Morton codes, areas, placement; building, changing, searching and walking octrees
    nearest     nearest points of meshes and clouds, and the distance of two meshes
    field       the function between the cells: the taps of lookups, and their weights
    archive     textures in a third of the bytes: predicted, and entropy-coded
    texture     OctreeTexture: tree, channels and placement; lookups; the .octex file
    kernels     lookups of one point, for your own compiled loops
    editing     shared by all edits: averages, rows of split cells, refined cells, drafts
    source      surfaces and their colours: models, images, mappings, functions, clouds
    voxelize    the exact cells of a surface; its fragments in them; sums by level
    cleaning    repairs scans and generated meshes: duplicates, cracks, inner faces
    conversion  surfaces to textures: the tree, the fit, adaptive depth
    cameras     cameras, lenses and camera files
    view        z-buffers, and the points that a camera sees
    painting    images projected into a paint octree, regions, layers; raising and merging
    photos      several photographs before painting: masks, gains, weights; better cameras
    processing  textures from textures
    baking      textures to images at texture coordinates
    formats     files of other programs
    drawing     renders models and textures: views, light, previews, differences
    session     paints for browser pages: commands, undo, recovery, saving
    viewer      textures in a browser: a page with a shader that walks the octree, a server
    cli         the commands
    docs        the pages of octex help and of the documentation site

Common ground: ahead, arrays, channels, checks, container, errors, files, gltf, jit, npz, parallel, remote.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as type checkers know it; to import typing would take most of the time here
if TYPE_CHECKING:
    from typing import Any

    from octex.baking.bake import bake as bake
    from octex.baking.displaced import displace as displace
    from octex.baking.finish import finish as finish
    from octex.baking.simplify import simplify as simplify
    from octex.baking.vertices import bake_vertices as bake_vertices
    from octex.cameras.camera import Camera as Camera
    from octex.cameras.files import read_cameras as read_cameras
    from octex.cameras.files import write_cameras as write_cameras
    from octex.cleaning.repair import repair as repair
    from octex.conversion.convert import convert as convert
    from octex.conversion.convert import separate as separate
    from octex.conversion.sets import convert_set as convert_set
    from octex.drawing.compare import difference as difference
    from octex.drawing.environment import Environment as Environment
    from octex.drawing.panels import write_preview as write_preview
    from octex.drawing.views import render as render
    from octex.errors import OctexError as OctexError
    from octex.formats.models import write_model as write_model
    from octex.formats.osl import write_osl as write_osl
    from octex.formats.ptex.export import write_ptex as write_ptex
    from octex.formats.ptex.source import Ptex as Ptex
    from octex.painting.image import Projection as Projection
    from octex.painting.layers import Layers as Layers
    from octex.painting.merge import merge as merge
    from octex.painting.paint import paint as paint
    from octex.painting.paint import project as project
    from octex.painting.painter import Painter as Painter
    from octex.painting.region import Box as Box
    from octex.painting.region import Sphere as Sphere
    from octex.painting.region import fill as fill
    from octex.painting.unwrap import Patch as Patch
    from octex.painting.unwrap import unwrap as unwrap
    from octex.parallel import Run as Run
    from octex.photos.refine import refine_cameras as refine_cameras
    from octex.processing.blur import blur as blur
    from octex.processing.combine import combine as combine
    from octex.processing.combine import mix as mix
    from octex.processing.mapping import cast as cast
    from octex.processing.mapping import curves as curves
    from octex.processing.mapping import levels as levels
    from octex.processing.mapping import map_values
    from octex.processing.resize import crop as crop
    from octex.processing.resize import resize as resize
    from octex.source.cloud import PointCloud as PointCloud
    from octex.source.corners import Creases as Creases
    from octex.source.load import load_surface as load_surface
    from octex.source.mapped import MappedImage as MappedImage
    from octex.source.subdivided import subdivide as subdivide
    from octex.source.surface import Surface as Surface
    from octex.source.transfer import Transfer as Transfer
    from octex.source.voxels import Voxels as Voxels
    from octex.texture import OctreeTexture as OctreeTexture
    from octex.texture import TextureSet as TextureSet
    from octex.texture import open_texture

    map = map_values
    open = open_texture

__version__ = "0.1.0"

# Names are imported when they are first used: importing octex costs next to nothing.
_EXPORTS = {
    "baking.bake": "bake",
    "baking.displaced": "displace",
    "baking.finish": "finish",
    "baking.simplify": "simplify",
    "baking.vertices": "bake_vertices",
    "cameras.camera": "Camera",
    "cameras.files": "read_cameras write_cameras",
    "cleaning.repair": "repair",
    "conversion.convert": "convert separate",
    "conversion.sets": "convert_set",
    "drawing.compare": "difference",
    "drawing.environment": "Environment",
    "drawing.panels": "write_preview",
    "drawing.views": "render",
    "errors": "OctexError",
    "formats.models": "write_model",
    "formats.osl": "write_osl",
    "formats.ptex.export": "write_ptex",
    "formats.ptex.source": "Ptex",
    "painting.layers": "Layers",
    "painting.merge": "merge",
    "painting.paint": "paint project",
    "painting.painter": "Painter",
    "painting.image": "Projection",
    "painting.region": "Box Sphere fill",
    "painting.unwrap": "Patch unwrap",
    "parallel": "Run",
    "photos.refine": "refine_cameras",
    "processing.blur": "blur",
    "processing.combine": "combine mix",
    "processing.mapping": "cast curves levels map",
    "processing.resize": "crop resize",
    "source.cloud": "PointCloud",
    "source.corners": "Creases",
    "source.load": "load_surface",
    "source.mapped": "MappedImage",
    "source.subdivided": "subdivide",
    "source.surface": "Surface",
    "source.transfer": "Transfer",
    "source.voxels": "Voxels",
    "texture": "OctreeTexture TextureSet open",
}
_RENAMED = {"map": "map_values", "open": "open_texture"}
_HOMES = {
    name: (f"octex.{module}", _RENAMED.get(name, name))
    for module, names in _EXPORTS.items()
    for name in names.split()
}

# ``from octex import *`` leaves Python's own ``map`` and ``open`` as they are.
__all__ = sorted({*_HOMES, "__version__"} - {"map", "open"})


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'octex' has no attribute {name!r}")
    module, attribute = _HOMES[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*_HOMES, "__version__"])
