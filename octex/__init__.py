"""octex: octree textures for Python. Colour a model without UVs (Benson & Davis, SIGGRAPH 2002)."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from octex.conversion.convert import convert as convert
    from octex.errors import OctexError as OctexError
    from octex.source.load import load_surface as load_surface
    from octex.source.surface import Surface as Surface
    from octex.texture import OctreeTexture as OctreeTexture
    from octex.texture import open_texture

    open = open_texture

__version__ = "0.1.0"

# Names are imported when they are first used: importing octex costs next to nothing.
_HOMES = {
    "OctexError": ("octex.errors", "OctexError"),
    "OctreeTexture": ("octex.texture", "OctreeTexture"),
    "Surface": ("octex.source.surface", "Surface"),
    "convert": ("octex.conversion.convert", "convert"),
    "load_surface": ("octex.source.load", "load_surface"),
    "open": ("octex.texture", "open_texture"),
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
