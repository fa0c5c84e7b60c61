"""Open3D's bake_vertex_attr_textures of a mesh: once for each line read; run by a Python that has Open3D.

usage: open3d_bake.py ARRAYS.npz SIZE
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import open3d

arrays, size = np.load(sys.argv[1]), int(sys.argv[2])
mesh = open3d.t.geometry.TriangleMesh(
    open3d.core.Tensor(arrays["vertices"]), open3d.core.Tensor(arrays["triangles"])
)
mesh.triangle.texture_uvs = open3d.core.Tensor(arrays["uv"][arrays["triangles"]].astype(np.float32))
mesh.vertex.albedo = open3d.core.Tensor(np.ascontiguousarray(arrays["vertices"], np.float32))
for _ in sys.stdin:
    cpu, wall = time.process_time(), time.perf_counter()
    made = mesh.bake_vertex_attr_textures(size, {"albedo"}, margin=0.0, fill=0.0, update_material=False)
    spent = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    print(json.dumps({**spent, "mean": float(made["albedo"].numpy().mean())}), flush=True)
