"""Write down what Blender shows of a file, for `test_export.py`; run by a Python that has `bpy`.

`bpy` wants NumPy 1 and the package NumPy 2, so the two never share an interpreter.

    python blender_worker.py FILE OUT.npz FRAMES VERTICES
"""

import sys
from pathlib import Path

import bpy
import numpy as np

FPS = 30


def open_file(path: Path, num_vertices: int) -> None:
    """Open a scene, or lay a point cache on a mesh of so many vertices."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.suffix == ".usdc":
        bpy.ops.wm.usd_import(filepath=str(path))
    elif path.suffix == ".abc":
        bpy.ops.wm.alembic_import(filepath=str(path), as_background_job=False)
    elif path.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(path))
    else:
        mesh = bpy.data.meshes.new("cache")
        mesh.from_pydata(np.zeros((num_vertices, 3)).tolist(), [], [])
        cloth = bpy.data.objects.new("cache", mesh)
        bpy.context.scene.collection.objects.link(cloth)
        cache = cloth.modifiers.new("cache", "MESH_CACHE")
        cache.cache_format, cache.filepath = path.suffix[1:].upper(), str(path)


def shown(frames: int, *, seconds: bool) -> dict[str, np.ndarray]:
    """Return the meshes' positions in the world, [frames, vertices, 3], and their faces."""
    scene, found = bpy.context.scene, {}
    for frame in range(frames):
        # glTF and Alembic count seconds, which Blender lays on the scene's own rate.
        at = frame * scene.render.fps / FPS if seconds else frame
        scene.frame_set(int(at), subframe=at - int(at))
        graph = bpy.context.evaluated_depsgraph_get()
        for entry in bpy.data.objects:
            if entry.type == "MESH":
                final = entry.evaluated_get(graph)
                mesh = final.to_mesh()
                points = [final.matrix_world @ vertex.co for vertex in mesh.vertices]
                found.setdefault(f"{entry.name}/positions", []).append(points)
                found[f"{entry.name}/faces"] = [tuple(face.vertices) for face in mesh.polygons]
    return {name: np.array(values) for name, values in found.items()}


if __name__ == "__main__":
    source, out, frames, vertices = sys.argv[1:]
    open_file(Path(source), int(vertices))
    np.savez(out, **shown(int(frames), seconds=source.endswith((".glb", ".abc"))))
