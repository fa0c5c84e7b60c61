"""Colours of points by Open3D's closest point on a mesh, its UV, and a bilinear lookup in an image.

Once for each line read; run by a Python that has Open3D, on one thread.

usage: open3d_lookup.py ARRAYS.npz
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import open3d

arrays = np.load(sys.argv[1])
triangles, uv, points = arrays["triangles"], arrays["uv"].astype(np.float32), arrays["points"]
image = arrays["image"]
size = len(image)
texels = image.reshape(-1, 3)
scene = open3d.t.geometry.RaycastingScene(nthreads=1)
scene.add_triangles(open3d.core.Tensor(arrays["vertices"]), open3d.core.Tensor(triangles.astype(np.uint32)))
for _ in sys.stdin:
    cpu, wall = time.process_time(), time.perf_counter()
    closest = scene.compute_closest_points(open3d.core.Tensor(points), nthreads=1)
    corners = uv[triangles[closest["primitive_ids"].numpy()]]
    v, w = closest["primitive_uvs"].numpy().T
    weights = np.stack([1 - v - w, v, w], axis=1)
    place = (corners * weights[:, :, None]).sum(axis=1) * np.float32(size - 1)
    low = np.clip(place.astype(np.int32), 0, size - 2)
    x, y = (place - low).T[:, :, None]
    first = low[:, 1] * size + low[:, 0]
    upper = texels[first] * (1 - x) + texels[first + 1] * x
    lower = texels[first + size] * (1 - x) + texels[first + size + 1] * x
    colors = upper * (1 - y) + lower * y
    spent = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    print(json.dumps({**spent, "mean": float(colors.mean())}), flush=True)
