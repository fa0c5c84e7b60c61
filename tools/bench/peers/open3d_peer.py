"""What Open3D does, once for each line read; run by a Python that has Open3D.

usage: open3d_peer.py cells ARRAYS.npz RESOLUTION VoxelGrid of a mesh, its cells read out
       open3d_peer.py bake ARRAYS.npz SIZE        bake_vertex_attr_textures of a mesh
       open3d_peer.py look_up ARRAYS.npz          closest point of a mesh, its UV, a bilinear read of an image
       open3d_peer.py paint ARRAYS.npz            an image projected into a mesh's image
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

import numpy as np
import open3d

Work = Callable[[], float]  # its number tells that it was done
Tensor = open3d.core.Tensor


def cells(path: str, resolution: str) -> Work:
    arrays = np.load(path)
    positions, corners = arrays["vertices"].astype(np.float64), arrays["triangles"].astype(np.int32)
    points, faces = open3d.utility.Vector3dVector(positions), open3d.utility.Vector3iVector(corners)
    mesh = open3d.geometry.TriangleMesh(points, faces)
    create = open3d.geometry.VoxelGrid.create_from_triangle_mesh_within_bounds
    return lambda: len(create(mesh, 1 / int(resolution), np.zeros(3), np.ones(3)).get_voxels())


def _mesh(arrays: dict[str, np.ndarray]) -> open3d.t.geometry.TriangleMesh:
    mesh = open3d.t.geometry.TriangleMesh(
        Tensor(arrays["vertices"].astype(np.float32)), Tensor(arrays["triangles"])
    )
    mesh.triangle.texture_uvs = Tensor(arrays["uv"].astype(np.float32)[arrays["triangles"]])
    return mesh


def bake(path: str, size: str) -> Work:
    arrays = np.load(path)
    mesh = _mesh(arrays)
    mesh.vertex.albedo = Tensor(np.ascontiguousarray(arrays["vertices"], np.float32))
    options = {"margin": 0.0, "fill": 0.0, "update_material": False}
    return lambda: mesh.bake_vertex_attr_textures(int(size), {"albedo"}, **options)["albedo"].numpy().mean()


def look_up(path: str) -> Work:
    """Read on one thread."""
    arrays = np.load(path)
    triangles, uv, points = arrays["triangles"], arrays["uv"].astype(np.float32), arrays["points"]
    size, texels = len(arrays["image"]), arrays["image"].reshape(-1, 3)
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(Tensor(arrays["vertices"]), Tensor(triangles.astype(np.uint32)))

    def work() -> float:
        closest = scene.compute_closest_points(Tensor(points), nthreads=1)
        corners = uv[triangles[closest["primitive_ids"].numpy()]]
        v, w = closest["primitive_uvs"].numpy().T
        weights = np.stack([1 - v - w, v, w], axis=1)
        place = (corners * weights[:, :, None]).sum(axis=1) * np.float32(size - 1)
        low = np.clip(place.astype(np.int32), 0, size - 2)
        x, y = (place - low).T[:, :, None]
        first = low[:, 1] * size + low[:, 0]
        upper = texels[first] * (1 - x) + texels[first + 1] * x
        lower = texels[first + size] * (1 - x) + texels[first + size + 1] * x
        return (upper * (1 - y) + lower * y).mean()

    return work


def paint(path: str) -> Work:
    arrays = np.load(path)
    mesh, image = _mesh(arrays), open3d.t.geometry.Image(Tensor(arrays["image"]))
    cameras = [[Tensor(arrays[name])] for name in ("intrinsic", "extrinsic")]
    project = mesh.project_images_to_albedo
    return lambda: project([image], *cameras, 2048, False).as_tensor().numpy().mean()


work = globals()[sys.argv[1]](*sys.argv[2:])
for _ in sys.stdin:
    cpu, wall = time.process_time(), time.perf_counter()
    number = work()
    spent = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    print(json.dumps({**spent, "number": float(number)}), flush=True)
