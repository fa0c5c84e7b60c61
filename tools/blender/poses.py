#!/usr/bin/env python
"""Compare the poses of glTF models with Blender's own evaluation of the same files.

usage: poses.py PYTHON MODEL [MODEL …] [--times 10]

PYTHON is that of an environment with PyPI's bpy (5.0.1 is for Python 3.11); it runs worker.py. Each
animation is taken at so many times, evenly from its start to its end. Blender blends the components of
quaternions between keys where glTF asks for slerp: at these times it gets keys, by its own mathutils' slerp.
The exit code is 1 if a vertex is off by more than 1e-4 of the model's size.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from calling import blender

import octex
from octex.gltf import Document
from octex.source.models.gltf_motion import Moves

LIMIT = 1e-4


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("python", type=Path)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--times", type=int, default=10)
    options = parser.parse_args(arguments)
    worst = max(compare(options.python, model, options.times) for model in options.models)
    print(f"largest distance {worst:.2e} of the model's size: {'good' if worst <= LIMIT else 'too far'}")
    return int(not worst <= LIMIT)


def compare(python: Path, model: Path, count: int) -> float:
    """Print how far each animation of a model is off; return the worst, in parts of its size."""
    document = Document(model)
    animations = list(enumerate(document.items("animations")))
    lengths = {str(each.get("name", n)): Moves(document, n).length for n, each in animations}
    names = [each.get("name", f"Anim_{n}") for n, each in animations]
    times = [np.linspace(0, length, count).astype(np.float32).tolist() for length in lengths.values()]
    job = {"animations": list(lengths), "names": names, "times": times}
    found = blender(python, "pose", model=str(model.resolve()), **job)
    worst = 0.0
    for name, chosen in zip(lengths, times, strict=True):
        distances = []
        for time, theirs in zip(chosen, found[name], strict=True):
            surface = octex.load_surface(model, pose=f"{name}@{time}")
            size = np.linalg.norm(surface.bounds[1] - surface.bounds[0])
            ours = surface.vertices[np.unique(surface.triangles)]
            if len(ours) != len(theirs):
                sys.exit(f"{model.name}: {len(ours)} vertices, and {len(theirs)} in Blender")
            distances.append(np.linalg.norm(ours - theirs, axis=1).max() / size)
        print(f"{model.name} {name}: {count} times from 0 to {chosen[-1]:.4g} s, off by {max(distances):.2e}")
        worst = max(worst, *distances)
    return worst


if __name__ == "__main__":
    sys.exit(main())
