"""Open3D's VoxelGrid of a mesh, its cells read out: once for each line read; run by a Python that has Open3D.

usage: open3d.py MESH RESOLUTION
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import open3d

with open(sys.argv[1], "rb") as file:  # noqa: PTH123
    vertices, triangles = np.fromfile(file, np.int64, 2)
    positions = np.fromfile(file, np.float32, 3 * vertices).reshape(-1, 3).astype(np.float64)
    corners = np.fromfile(file, np.int32, 3 * triangles).reshape(-1, 3)
resolution = int(sys.argv[2])
mesh = open3d.geometry.TriangleMesh(
    open3d.utility.Vector3dVector(positions), open3d.utility.Vector3iVector(corners)
)
for _ in sys.stdin:
    cpu, wall = time.process_time(), time.perf_counter()
    grid = open3d.geometry.VoxelGrid.create_from_triangle_mesh_within_bounds(
        mesh, 1 / resolution, np.zeros(3), np.ones(3)
    )
    cells = grid.get_voxels()
    spent = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    print(json.dumps({**spent, "cells": len(cells)}), flush=True)
    del grid, cells
