"""Install the add-on into Blender and simulate with it, for `test_blender_addon.py`; for a Python that has `bpy`.

    python blender_addon_worker.py ZIP CHARACTER.glb GARMENT.obj PYTHON OUT.npz [FABRIC]

Writes what Blender shows of garment and body in every frame, or the error that the operator reports.
"""

import sys
from pathlib import Path

import bpy
import numpy as np

MODULE = "bl_ext.user_default.eslr_garments"
FRAMES = 5  # at 24 frames a second, after the first


def install(archive, python):
    """Install the extension and name the simulator's Python."""
    bpy.ops.extensions.package_install_files(
        filepath=archive, repo="user_default", enable_on_install=True, overwrite=True
    )
    bpy.context.preferences.addons[MODULE].preferences.python = python


def build_scene(character, garment):
    """Return the garment and the body of a scene, the garment turned and moved as an object."""
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    bpy.ops.import_scene.gltf(filepath=character)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 0, FRAMES
    body = next(thing for thing in bpy.data.objects if thing.type == "MESH" and thing.find_armature())
    bpy.ops.wm.obj_import(filepath=garment)  # turned upright by its object, as files that are Y up are
    cloth = bpy.context.selected_objects[0]
    scene.eslr.garment, scene.eslr.body = cloth, body
    return cloth, body


def shown(thing):
    """Return the vertices that Blender shows in the world, [vertices, 3]."""
    final = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.empty((len(final.data.vertices), 3))
    final.data.vertices.foreach_get("co", points.reshape(-1))
    matrix = np.array(final.matrix_world)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def main():
    """Install, simulate, look."""
    archive, character, garment, python, out, *fabric = sys.argv[1:]
    install(archive, python)
    cloth, body = build_scene(character, garment)
    scene = bpy.context.scene
    scene.eslr.fabric = fabric[0] if fabric else "cotton"
    scene.eslr.folder = str(Path(out).parent / "cache")
    before = shown(cloth)
    error = ""
    try:
        result = bpy.ops.eslr.simulate()
    except RuntimeError as raised:  # an operator that reports an error raises it, from a script
        result, error = {"CANCELLED"}, str(raised)
    tracks = {"cloth": [], "body": []}
    for frame in range(FRAMES + 1):
        scene.frame_set(frame)
        tracks["cloth"].append(shown(cloth))
        tracks["body"].append(shown(body))
    faces = [tuple(face.vertices) for face in body.data.polygons]
    arrays = {name: np.array(track) for name, track in tracks.items()}
    modifiers = [modifier.name for modifier in cloth.modifiers]
    np.savez(out, before=before, faces=faces, result=list(result), error=error, modifiers=modifiers, **arrays)


main()
