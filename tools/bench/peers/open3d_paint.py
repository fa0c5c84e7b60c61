"""Open3D's projection of a picture into a mesh's image, by a Python that has it: once for each line read.

usage: open3d_paint.py ARRAYS.npz
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import open3d

arrays = np.load(sys.argv[1])
mesh = open3d.t.geometry.TriangleMesh(
    open3d.core.Tensor(arrays["vertices"].astype(np.float32)), open3d.core.Tensor(arrays["triangles"])
)
mesh.triangle["texture_uvs"] = open3d.core.Tensor(arrays["uv"].astype(np.float32)[arrays["triangles"]])
image = open3d.t.geometry.Image(open3d.core.Tensor(arrays["image"]))
intrinsic, extrinsic = (open3d.core.Tensor(arrays[name]) for name in ("intrinsic", "extrinsic"))
for _ in sys.stdin:
    cpu, wall = time.process_time(), time.perf_counter()
    albedo = mesh.project_images_to_albedo([image], [intrinsic], [extrinsic], 2048, False)
    spent = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    print(json.dumps({**spent, "mean": float(albedo.as_tensor().numpy().mean())}), flush=True)
