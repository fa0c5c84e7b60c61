"""octex: octree textures for Python. Colour a model without UVs (Benson & Davis, SIGGRAPH 2002).

The words
    texture     an octree with values: of each channel, one for each of its cells
    root cell   the cube that holds the model; a cell of level k has 2⁻ᵏ of its edge
    cell        a cube that the surface meets: a leaf, or a node, which is divided in eight
    node        a cell above the leaves; its value is the average of those below it
    depth       the level of the finest cells
    channel     what is stored: base_color, alpha, roughness …; components are its numbers, codes its integers
    rest        where a point of the surface lies before it is posed: the texture coordinate
    field       the function of position that lookups evaluate: a spline over the cells around a point
    footprint   what a lookup averages over: a width, or the derivatives of a position along a picture's axes
    facing      one of six directions that the surface shows; a split cell has a value for each side
    kept        of a node above finer paint: it keeps the value that the field beside the paint is made of
    residual    what a node's value has beyond the average of the cells below it
    layer       paint as a texture of its own: a channel, and how much of each cell it covers
    source      what a point's value comes from: images, functions, numbers, other models, points
    patch       a disc of a surface, laid flat to be painted on in a picture
    fit         choosing the leaves' values so that the field meets the source

The rooms, each of which knows only those before it (painting and photos know each other)
    tree        Morton codes, areas, placement; building, changing, searching and walking octrees
    nearest     nearest points of triangles and of clouds, how near meshes come
    field       what lies between the cells: which of them a lookup blends, and what weighs them
    archive     the same in a third of the bytes: predicted, and coded by entropy
    texture     OctreeTexture: tree, channels and placement; lookups; the .octex file
    kernels     lookups of one point, for one's own compiled loops
    editing     what every change of a texture shares: averages, rows of split cells, refined cells
    source      surfaces and what they are coloured by: models, images, mappings, functions, clouds
    conversion  cells met exactly, sums over clipped pieces, the fit, adaptive depth
    view        cameras and their files, what a camera sees, studio light
    painting    pictures projected into a paint octree, regions, layers; raising and merging
    photos      what painting asks of several photographs first: masks, gains, weights; better cameras
    processing  textures from textures
    baking      textures to images at texture coordinates
    preview     model and texture side by side; pictures of differences
    formats     files that are not our own
    viewer      textures in a browser: a page, the walk as a shader, a server
    cli         the commands
    docs        the pages of octex help and of the documentation site

Common ground: ahead, arrays, channels, checks, compare, container, errors, files, functions, jit, npz,
parallel, remote.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as type checkers know it; to import typing would take most of the time here
if TYPE_CHECKING:
    from typing import Any

    from octex.baking.bake import bake as bake
    from octex.baking.displaced import displace as displace
    from octex.baking.vertices import bake_vertices as bake_vertices
    from octex.conversion.apart import separate as separate
    from octex.conversion.convert import convert as convert
    from octex.conversion.sets import convert_set as convert_set
    from octex.errors import OctexError as OctexError
    from octex.formats.models import write_model as write_model
    from octex.formats.ptex.export import write_ptex as write_ptex
    from octex.formats.ptex.source import Ptex as Ptex
    from octex.painting.merge import merge as merge
    from octex.painting.paint import paint as paint
    from octex.painting.paint import project as project
    from octex.painting.painter import Painter as Painter
    from octex.painting.picture import Projection as Projection
    from octex.painting.region import Box as Box
    from octex.painting.region import Sphere as Sphere
    from octex.painting.region import fill as fill
    from octex.painting.unwrap import Patch as Patch
    from octex.painting.unwrap import unwrap as unwrap
    from octex.photos.refine import refine_cameras as refine_cameras
    from octex.processing.blur import blur as blur
    from octex.processing.cast import cast as cast
    from octex.processing.combine import combine as combine
    from octex.processing.combine import mix as mix
    from octex.processing.mapping import map_values
    from octex.processing.resize import crop as crop
    from octex.processing.resize import resize as resize
    from octex.processing.tone import curves as curves
    from octex.processing.tone import levels as levels
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
    from octex.view.camera import Camera as Camera
    from octex.view.camera_files import read_cameras as read_cameras
    from octex.view.camera_files import write_cameras as write_cameras

    map = map_values
    open = open_texture

__version__ = "0.1.0"

# Names are imported when they are first used: importing octex costs next to nothing.
_EXPORTS = {
    "baking.bake": "bake",
    "baking.displaced": "displace",
    "baking.vertices": "bake_vertices",
    "conversion.apart": "separate",
    "conversion.convert": "convert",
    "conversion.sets": "convert_set",
    "errors": "OctexError",
    "formats.models": "write_model",
    "formats.ptex.export": "write_ptex",
    "formats.ptex.source": "Ptex",
    "painting.merge": "merge",
    "painting.paint": "paint project",
    "painting.painter": "Painter",
    "painting.picture": "Projection",
    "painting.region": "Box Sphere fill",
    "painting.unwrap": "Patch unwrap",
    "photos.refine": "refine_cameras",
    "processing.blur": "blur",
    "processing.cast": "cast",
    "processing.combine": "combine mix",
    "processing.mapping": "map",
    "processing.resize": "crop resize",
    "processing.tone": "curves levels",
    "source.cloud": "PointCloud",
    "source.corners": "Creases",
    "source.load": "load_surface",
    "source.mapped": "MappedImage",
    "source.subdivided": "subdivide",
    "source.surface": "Surface",
    "source.transfer": "Transfer",
    "source.voxels": "Voxels",
    "texture": "OctreeTexture TextureSet open",
    "view.camera": "Camera",
    "view.camera_files": "read_cameras write_cameras",
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
