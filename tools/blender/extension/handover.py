# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job gets of an object: its file for a Blender of its own, and pixels that are in no file."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import bpy
import numpy as np

from .objects import BAKED, NAME, NORMAL, REST, VIEW, ObjectError, image_nodes, is_missing, lens_and_pose


class Read(NamedTuple):
    """Values that only the window's thread can read, into memory which another thread has touched."""

    count: int
    dtype: type
    into: Callable[[np.ndarray], None]


def hand_over(chosen: bpy.types.Object, folder: Path, form: str) -> tuple[list[str], dict[str, Read]]:
    """Write an object to a folder, for a Blender of its own, which takes its time to make of it a form.

    That is its "arrays", a "model" with the mesh's materials or with those that are "shown", or such a model
    "without images". Returns the command that makes it, and what must be stored before: the pixels of images
    that are not saved, by the names of files.
    """
    pixels: dict[str, Read] = {}
    files = {}
    nodes = image_nodes(chosen, form == "shown") if form in ("model", "shown") else ()
    for image in {node.image for _, node in nodes}:
        if image.is_dirty:
            files[image.name] = f"pixels-{len(files)}"
            pixels[files[image.name]] = _read_of(image)
    job = {"folder": str(folder), "name": chosen.name, "form": form, "pixels": files}
    if chosen.library is None:
        job["blend"] = str(folder / "object.blend")
        with _lent(chosen, form) as copy:
            job["object"] = copy.name
            bpy.data.libraries.write(job["blend"], {copy}, path_remap="ABSOLUTE")
    else:
        job |= {"blend": bpy.path.abspath(chosen.library.filepath), "object": chosen.name}
    (folder / "export.json").write_text(json.dumps(job), encoding="utf-8")
    script, given = str(Path(__file__).with_name("export.py")), str(folder / "export.json")
    if not bpy.app.binary_path:  # Blender is a module
        return [sys.executable, script, given], pixels
    call = [bpy.app.binary_path, "--background", "--factory-startup", "--python-exit-code", "1"]
    return [*call, "--python", script, "--", given], pixels


@contextmanager
def _lent(chosen: bpy.types.Object, form: str) -> Iterator[bpy.types.Object]:
    """Lend a copy of an object, which shares its arrays, without those that the form does not need."""
    copy = chosen.copy()
    copy.data = mesh = chosen.data.copy()
    try:
        copy.animation_data_clear()
        copy.parent = None
        copy.constraints.clear()
        copy.modifiers.clear()
        names = {REST, NORMAL} if form == "model" else {REST, NORMAL, NAME}
        if form == "arrays":
            names |= {*mesh.uv_layers.keys(), *mesh.color_attributes.keys()}
            mesh.materials.clear()
        for name in names & {*mesh.attributes.keys()}:
            mesh.attributes.remove(mesh.attributes[name])
        yield copy
    finally:
        bpy.data.objects.remove(copy)
        bpy.data.meshes.remove(mesh)


def baked_images(chosen: bpy.types.Object) -> tuple[dict[str, str], dict[str, Read]]:
    """Return the files of baked base colours that an object shows, with names of their pixels if not saved.

    These are to be stored before.
    """
    files, pixels = {}, {}
    for material, node in image_nodes(chosen, True):
        path = bpy.path.abspath(node.image.filepath, library=node.image.library)
        if path == material.get(BAKED):
            files[path] = f"pixels-{len(pixels)}" if node.image.is_dirty else ""
            if node.image.is_dirty:
                pixels[files[path]] = _read_of(node.image)
    return files, pixels


def _read_of(image: bpy.types.Image, is_packed: bool = False) -> Read:
    """Return how to read an image's packed file, or its pixels from the bottom to the top."""
    name, library = image.name, image.library and image.library.filepath

    def count(found: bpy.types.Image | None) -> int:
        if found is None:
            return 0
        return found.packed_file.size if is_packed else len(found.pixels)

    def into(values: np.ndarray) -> None:
        found = bpy.data.images.get((name, library))
        if count(found) != len(values):
            raise ObjectError(f"{name} was changed meanwhile; nothing was made")
        if is_packed:
            values[:] = np.frombuffer(found.packed_file.data, np.uint8)
        else:
            found.pixels.foreach_get(values)

    return Read(count(image), np.uint8 if is_packed else np.float32, into)


def photographs(context: bpy.types.Context, required: bool) -> tuple[list[dict], dict[str, Read]]:
    """Return the image, lens and pose of each camera object with a background image.

    Images that are no files are to be stored before: they are returned by the names of their files. Raises
    ObjectError if one cannot be used, or if one is ``required`` and there is none.
    """
    made: list[dict] = []
    reads: dict[str, Read] = {}
    for camera in context.scene.objects:
        if camera.type != "CAMERA":
            continue
        images = [each.image for each in camera.data.background_images if each.image is not None]
        if images:
            made.append(_photograph(camera, images[0], reads))
    if required and not made:
        raise ObjectError("No camera has a background image; give each camera its photograph there")
    return made, reads


def _photograph(camera: bpy.types.Object, image: bpy.types.Image, reads: dict[str, Read]) -> dict:
    if is_missing(image):
        raise ObjectError(f"{camera.name}: its background image {image.name} is missing")
    path = Path(bpy.path.abspath(image.filepath, library=image.library))
    made = {"image": str(path), "since": camera.get(VIEW, ""), **lens_and_pose(camera)}
    is_packed = image.packed_file is not None and not image.is_dirty
    if is_packed or image.is_dirty or not path.is_file():
        made["image"] = f"photograph-{len(reads)}{path.suffix}"
        reads[made["image"]] = _read_of(image, is_packed)
        if not is_packed:
            made |= {"pixels": [*image.size, image.channels], "is_linear": image.is_float}
    return made
