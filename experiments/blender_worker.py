"""Run Blender's cloth on a scene that `blender_cloth.py` wrote into a folder; for a Python that has `bpy`.

`bpy` wants NumPy 1 and the package NumPy 2, so the two never share an interpreter.

    python blender_worker.py FOLDER

Reads scene.npz and the point caches cloth.pc2 and body.pc2; writes out.npz.
"""

import sys
import time
from pathlib import Path

import bpy
import numpy as np


def add_mesh(name, positions, faces):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(positions.tolist(), [], faces.tolist())
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def animate(thing, path):
    """Let a mesh follow a point cache, in the axes that it was written in."""
    cache = thing.modifiers.new("motion", "MESH_CACHE")
    cache.cache_format, cache.filepath, cache.frame_start = "PC2", str(path), 0
    cache.forward_axis, cache.up_axis = "POS_Y", "POS_Z"


def add_cloth(scene, folder):
    """Return the cloth object; `scene` holds the arrays and settings of the file."""
    thing = add_mesh("cloth", scene["start"], scene["faces"])
    animate(thing, folder / "cloth.pc2")
    cloth = thing.modifiers.new("cloth", "CLOTH")
    cloth.point_cache.frame_start, cloth.point_cache.frame_end = 0, int(scene["frames"]) - 1
    settings, contacts = cloth.settings, cloth.collision_settings
    if scene["is_pinned"].any():
        group = thing.vertex_groups.new(name="pins")
        group.add(np.flatnonzero(scene["is_pinned"]).tolist(), 1.0, "REPLACE")
        settings.vertex_group_mass = group.name
    else:  # lengths at rest are those that the point cache has now; a rest shape key is not heeded
        settings.use_dynamic_mesh = True
    settings.quality, settings.time_scale = int(scene["quality"]), float(scene["time_scale"])
    settings.mass, settings.air_damping, settings.bending_model = float(scene["mass"]), 0.0, "ANGULAR"
    tension, bending = float(scene["tension"]), float(scene["bending"])
    settings.tension_stiffness = settings.compression_stiffness = settings.shear_stiffness = tension
    settings.tension_damping = settings.compression_damping = settings.shear_damping = 0.0
    settings.bending_stiffness, settings.bending_damping = bending, 0.0
    contacts.use_collision = "body_start" in scene
    contacts.collision_quality = int(scene["collision_quality"])
    contacts.distance_min = float(scene["distance"])
    contacts.use_self_collision = "layer_distance" in scene
    if contacts.use_self_collision:
        contacts.self_distance_min = float(scene["layer_distance"])
    return thing


def add_body(scene, folder):
    thing = add_mesh("body", scene["body_start"], scene["body_faces"])
    animate(thing, folder / "body.pc2")
    thing.modifiers.new("collision", "COLLISION")
    body = thing.collision
    body.damping, body.cloth_friction = 0.0, float(scene["friction"])
    body.thickness_outer = float(scene["body_distance"])


def main():
    """Simulate and write positions, and the time that every frame took."""
    folder = Path(sys.argv[1])
    scene = dict(np.load(folder / "scene.npz"))
    frames = int(scene["frames"])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    world = bpy.context.scene
    world.gravity = (0.0, -float(scene["gravity"]), 0.0)
    world.frame_start, world.frame_end = 0, frames - 1
    positions, wall, processor = np.empty((frames, *scene["start"].shape), np.float32), [], []
    if "body_start" in scene:
        add_body(scene, folder)
    cloth = add_cloth(scene, folder)
    for frame in range(frames):
        began, began_processor = time.perf_counter(), time.process_time()
        world.frame_set(frame)
        shown = cloth.evaluated_get(bpy.context.evaluated_depsgraph_get())
        wall.append(1e3 * (time.perf_counter() - began))
        processor.append(1e3 * (time.process_time() - began_processor))
        shown.data.vertices.foreach_get("co", positions[frame].reshape(-1))
    times = {"wall": wall[1:], "processor": processor[1:]}
    np.savez(folder / "out.npz", positions=positions, version=bpy.app.version_string, **times)


main()
