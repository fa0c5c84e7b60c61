"""octex: octree textures for Python. Colour a model without UVs (Benson & Davis, SIGGRAPH 2002)."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from octex.conversion.apart import separate as separate
    from octex.conversion.convert import convert as convert
    from octex.errors import OctexError as OctexError
    from octex.painting.merge import merge as merge
    from octex.painting.paint import paint as paint
    from octex.painting.paint import project as project
    from octex.painting.pictures import Projection as Projection
    from octex.painting.region import Box as Box
    from octex.painting.region import Sphere as Sphere
    from octex.painting.region import fill as fill
    from octex.source.cloud import PointCloud as PointCloud
    from octex.source.load import load_surface as load_surface
    from octex.source.mapped import MappedImage as MappedImage
    from octex.source.surface import Surface as Surface
    from octex.source.transfer import Transfer as Transfer
    from octex.texture import OctreeTexture as OctreeTexture
    from octex.texture import open_texture
    from octex.view.camera import Camera as Camera
    from octex.view.camera_files import read_cameras as read_cameras
    from octex.view.camera_files import write_cameras as write_cameras

    open = open_texture

__version__ = "0.1.0"

# Names are imported when they are first used: importing octex costs next to nothing.
_HOMES = {
    "Box": ("octex.painting.region", "Box"),
    "Camera": ("octex.view.camera", "Camera"),
    "MappedImage": ("octex.source.mapped", "MappedImage"),
    "OctexError": ("octex.errors", "OctexError"),
    "OctreeTexture": ("octex.texture", "OctreeTexture"),
    "PointCloud": ("octex.source.cloud", "PointCloud"),
    "Projection": ("octex.painting.pictures", "Projection"),
    "Sphere": ("octex.painting.region", "Sphere"),
    "Surface": ("octex.source.surface", "Surface"),
    "Transfer": ("octex.source.transfer", "Transfer"),
    "convert": ("octex.conversion.convert", "convert"),
    "fill": ("octex.painting.region", "fill"),
    "load_surface": ("octex.source.load", "load_surface"),
    "merge": ("octex.painting.merge", "merge"),
    "open": ("octex.texture", "open_texture"),
    "paint": ("octex.painting.paint", "paint"),
    "project": ("octex.painting.paint", "project"),
    "read_cameras": ("octex.view.camera_files", "read_cameras"),
    "separate": ("octex.conversion.apart", "separate"),
    "write_cameras": ("octex.view.camera_files", "write_cameras"),
}

__all__ = sorted([*_HOMES, "__version__"])


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'octex' has no attribute {name!r}")
    module, attribute = _HOMES[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
