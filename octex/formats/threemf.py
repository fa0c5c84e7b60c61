"""Writes 3MF: a surface with coloured vertices, for printing (3MF Core 1.3; Materials and Properties 1.2)."""

from __future__ import annotations

import ctypes
import locale
from pathlib import Path
from typing import Any

import lib3mf
import numpy as np

from octex.arrays import Array
from octex.errors import ModelError
from octex.files import replacing, scratch_folder
from octex.formats.models import Target, Unit, Written, codes_of, needed_colors, origin_of
from octex.source.surface import Surface
from octex.source.welding import distinct_rows

#: lib3mf's names of units.
_UNITS: dict[Unit, str] = {
    "meter": "Meter", "centimeter": "CentiMeter", "millimeter": "MilliMeter", "inch": "Inch", "foot": "Foot",
}  # fmt: skip


def write(surface: Surface, target: Target) -> Written:
    """Write a surface with vertex colours as a 3MF mesh; raises ModelError for one with images.

    A model far from the origin is moved by the item's transform. Vertices at one position are welded, so that
    slicers find closed surfaces closed; triangles that lose their area are left out. Each corner has a colour
    of the mesh's group, sRGB with alpha.
    """
    colors = needed_colors(surface, ".3mf")
    origin = origin_of(surface.vertices)
    points = (surface.vertices - origin).astype(np.float32)
    positions, vertex_of = distinct_rows(points)
    triangles = vertex_of[surface.triangles]
    is_solid = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    if not is_solid.any():
        raise ModelError(f"{surface.name} has no triangles with an area; there is nothing to print")
    codes, numbers = np.unique(codes_of(colors).view(np.uint32), return_inverse=True)
    wrapper = lib3mf.get_wrapper()
    model = wrapper.CreateModel()
    model.SetUnit(getattr(lib3mf.ModelUnit, _UNITS[target.unit]))
    group = model.AddColorGroup()
    distinct = codes.view(np.uint8).reshape(-1, 4).tolist()
    color_numbers = [group.AddColor(wrapper.RGBAToColor(*each)) for each in distinct]
    mesh = model.AddMeshObject()
    mesh.SetName(Path(surface.name).stem)
    mesh.SetGeometry(_items(lib3mf.Position, positions), _items(lib3mf.Triangle, triangles[is_solid]))
    properties = np.empty((int(is_solid.sum()), 4), np.uint32)
    properties[:, 0] = group.GetResourceID()
    properties[:, 1:] = np.array(color_numbers, np.uint32)[numbers.reshape(-1)][surface.triangles[is_solid]]
    mesh.SetAllTriangleProperties(_items(lib3mf.TriangleProperties, properties))
    mesh.SetObjectLevelProperty(group.GetResourceID(), color_numbers[0])
    model.AddBuildItem(mesh, wrapper.GetTranslationTransform(*origin.tolist()))
    with scratch_folder() as folder:  # lib3mf writes only to paths
        scratch = folder / "model.3mf"
        locale_before = locale.setlocale(locale.LC_ALL)
        try:
            model.QueryWriter("3mf").WriteToFile(str(scratch))
        finally:  # lib3mf changes the process's locale to one with ASCII text
            locale.setlocale(locale.LC_ALL, locale_before)
        with replacing(target.path) as file:
            file.write(scratch.read_bytes())
    return Written([target.path], 0)


def _items(kind: Any, rows: Array) -> Any:
    """Return rows of 4-byte numbers as an array of lib3mf's structures."""
    data = np.ascontiguousarray(rows, np.float32 if rows.dtype.kind == "f" else np.uint32)
    assert ctypes.sizeof(kind) == data.dtype.itemsize * data.shape[1]
    return (kind * len(data)).from_buffer_copy(data)
