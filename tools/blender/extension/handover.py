# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job gets of an object: its file for a Blender of its own, and pixels that are in no file."""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np

from . import objects
from .jobs import Job, Read


def hand_over(chosen: bpy.types.Object, job: Job, form: str) -> None:
    """Write an object to a job's folder, and have the job begin with a Blender that makes of it a form.

    That is its "arrays", a "model" with the mesh's materials or with those that are "shown", or such a model
    "without images". Pixels of images that are not saved are stored before.
    """
    files, folder = {}, job.folder
    nodes = objects.image_nodes(chosen, form == "shown") if form in ("model", "shown") else ()
    for image in {node.image for _, node in nodes}:
        if image.is_dirty:
            files[image.name] = f"pixels-{len(files)}"
            job.reads[files[image.name]] = _read_of(image)
    wanted = {"folder": str(folder), "name": chosen.name, "form": form, "pixels": files}
    if chosen.library is None:
        wanted["blend"] = str(folder / "object.blend")
        with _lent(chosen, form) as copy:
            wanted["object"] = copy.name
            bpy.data.libraries.write(wanted["blend"], {copy}, path_remap="ABSOLUTE")
    else:
        wanted |= {"blend": bpy.path.abspath(chosen.library.filepath), "object": chosen.name}
    (folder / "export.json").write_text(json.dumps(wanted), encoding="utf-8")
    call = [bpy.app.binary_path, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    if not bpy.app.binary_path:  # Blender is a module
        call = [sys.executable]
    call += [str(Path(__file__).with_name("export.py")), "--", str(folder / "export.json")]
    job.calls.append((call, None))


@contextmanager
def _lent(chosen: bpy.types.Object, form: str) -> Iterator[bpy.types.Object]:
    """Lend a copy of an object, which shares its arrays, without those that the form does not need."""
    mesh = chosen.data.copy()
    try:
        names = {objects.REST, objects.NORMAL} | ({objects.NAME} if form != "model" else set())
        if form == "arrays":
            names |= {*mesh.uv_layers.keys(), *mesh.color_attributes.keys()}
            mesh.materials.clear()
        for name in names & {*mesh.attributes.keys()}:
            mesh.attributes.remove(mesh.attributes[name])
        with objects.bare_copy(chosen) as copy:
            copy.data = mesh
            yield copy
    finally:
        bpy.data.meshes.remove(mesh)


def baked_images(chosen: bpy.types.Object) -> tuple[dict[str, str], dict[str, Read]]:
    """Return the files of baked base colours that an object shows, with names of their pixels if not saved.

    These are to be stored before.
    """
    files, pixels = {}, {}
    for material, node in objects.image_nodes(chosen, True):
        path = bpy.path.abspath(node.image.filepath, library=node.image.library)
        if path == material.get(objects.BAKED):
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
            raise objects.ObjectError(f"{name} was changed meanwhile; nothing was made")
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
        raise objects.ObjectError("No camera has a background image; give each camera its photograph there")
    return made, reads


def _photograph(camera: bpy.types.Object, image: bpy.types.Image, reads: dict[str, Read]) -> dict:
    if objects.is_missing(image):
        raise objects.ObjectError(f"{camera.name}: its background image {image.name} is missing")
    path = Path(bpy.path.abspath(image.filepath, library=image.library))
    made = {"image": str(path), "since": camera.get(objects.VIEW, ""), **objects.lens_and_pose(camera)}
    is_packed = image.packed_file is not None and not image.is_dirty
    if is_packed or image.is_dirty or not path.is_file():
        made["image"] = f"photograph-{len(reads)}{path.suffix}"
        reads[made["image"]] = _read_of(image, is_packed)
        if not is_packed:
            made |= {"pixels": [*image.size, image.channels], "is_linear": image.is_float}
    return made
