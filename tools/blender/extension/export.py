# SPDX-License-Identifier: GPL-3.0-or-later
"""Write what octex needs of an object, in a Blender of its own: its arrays, or a model of it.

Called with a JSON file, next to the pixels of images that are not saved.
"""

import json
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))  # as Blender runs it
import objects


def main() -> None:
    job = json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8"))
    folder = Path(job["folder"])
    # Not read_factory_settings: that uninstalls the packages of all extensions.
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(job["blend"]) as (_, wanted):
        wanted.objects = [job["object"]]
    (chosen,) = wanted.objects
    for name, file in job["pixels"].items():
        bpy.data.images[name].pixels.foreach_set(np.fromfile(folder / file, np.float32))
    if job["form"] in ("model", "shown"):
        for _, node in objects.image_nodes(chosen, job["form"] == "shown"):
            if not node.image.size[0]:
                sys.exit(f"{node.image.name} cannot be read: replace or remove it first")
    if job["form"] == "arrays":
        np.savez(folder / "mesh.npz", **objects.mesh_arrays(chosen))
    else:
        try:
            objects.write_model(bpy.context, chosen, folder / "model.glb", job["form"])
        except RuntimeError as error:  # it ends with what Blender's Python raised, and where
            said = [line for line in str(error).splitlines() if line and not line.startswith("Location:")]
            sys.exit(f"Blender cannot write {job['name']} as glTF: {said[-1]}")


if __name__ == "__main__":
    main()
