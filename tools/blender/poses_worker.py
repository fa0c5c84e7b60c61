"""What poses.py has Blender do, run by a Python that has bpy: say where the vertices of a posed model are."""

from __future__ import annotations

import json
import sys

import bpy  # type: ignore[import-not-found]
import numpy as np

FPS = 1000


def main() -> None:
    job = json.loads(sys.argv[1])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = FPS  # to which the importer scales keys
    bpy.ops.import_scene.gltf(filepath=job["model"], import_shading="NORMALS")
    found = {}
    for number, name in enumerate(job["animations"]):
        choose(job["names"][number])
        slerp(job["times"][number])
        found[name] = [vertices(scene, time).tolist() for time in job["times"][number]]
    print(json.dumps(found))


def owners() -> list[bpy.types.ID]:
    keys = [mesh.shape_keys for mesh in bpy.data.meshes if mesh.shape_keys is not None]
    return [each for each in [*bpy.data.objects, *keys] if each.animation_data is not None]


def choose(name: str) -> None:
    """Play the animation of this name alone, as it is: strips of tracks are rounded to frames."""
    played = 0
    for owner in owners():
        data = owner.animation_data
        strips = [strip for track in data.nla_tracks if track.name == name for strip in track.strips]
        for track in data.nla_tracks:
            track.mute = True
        data.action = strips[0].action if strips else None
        if strips:
            data.action_slot = strips[0].action_slot
            played += 1
    if not played:
        sys.exit(f"Blender has no animation {name!r}")


def slerp(times: list[float]) -> None:
    """Put keys of quaternions at these times: Blender blends their components, glTF asks for slerp."""
    import mathutils  # type: ignore[import-not-found]

    for owner in owners():
        turns: dict[str, dict] = {}
        for curve in curves_of(owner.animation_data):
            if curve.data_path.endswith("rotation_quaternion"):
                turns.setdefault(curve.data_path, {})[curve.array_index] = curve
        for four in turns.values():
            insert(four, times, mathutils.Quaternion)


def insert(four: dict, times: list[float], quaternion: type) -> None:
    points = [four[axis].keyframe_points for axis in range(4)]
    keys = np.array([[point.co[0] for point in points[0]]] + [[p.co[1] for p in each] for each in points])
    if points[0][0].interpolation != "LINEAR":
        return
    added = []
    for time in times:
        frame = time * FPS
        after = int(np.searchsorted(keys[0], frame))
        if 0 < after < keys.shape[1] and keys[0, after] != frame and keys[0, after - 1] != frame:
            a, b = quaternion(keys[1:, after - 1]), quaternion(keys[1:, after])
            t = (frame - keys[0, after - 1]) / (keys[0, after] - keys[0, after - 1])
            added.append((frame, a.slerp(b, t)))
    for frame, value in added:
        for axis in range(4):
            four[axis].keyframe_points.insert(frame, value[axis]).interpolation = "LINEAR"


def curves_of(data: bpy.types.AnimData) -> list:
    layers = [] if data.action is None else data.action.layers
    bags = [strip.channelbag(data.action_slot) for layer in layers for strip in layer.strips]
    return [curve for bag in bags if bag is not None for curve in bag.fcurves]


def vertices(scene: bpy.types.Scene, time: float) -> np.ndarray:
    """Return where all vertices are (n, 3), in glTF's axes."""
    frame = time * FPS
    scene.frame_set(int(frame), subframe=frame - int(frame))
    graph = bpy.context.evaluated_depsgraph_get()
    every = []
    for each in scene.objects:
        if each.type != "MESH" or each.name.startswith("Icosphere"):
            continue
        evaluated = each.evaluated_get(graph)
        mesh = evaluated.to_mesh()
        local = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", local)
        matrix = np.array(evaluated.matrix_world)
        every.append(local.reshape(-1, 3).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3])
        evaluated.to_mesh_clear()
    x, y, z = np.concatenate(every).T
    return np.stack([x, z, -y], axis=1)


if __name__ == "__main__":
    main()
