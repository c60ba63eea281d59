"""Export a body and a garment with shape keys, for `test_blender_addon.py`; for a Python that has `bpy`.

    python blender_shapes_worker.py FOLDER_OF_THE_ADDON CHARACTER.glb OUT

Writes what the simulator reads, and `shown.npz` with what Blender shows of both, without modifiers, Y up.
"""

import sys
from pathlib import Path

import bpy
import numpy as np


def give_keys(thing):
    """Give a mesh a shape: a key on half of it, one that is relative to that, a muted one."""
    rows = np.arange(len(thing.data.vertices))
    group = thing.vertex_groups.new(name="half")
    group.add(rows[::2].tolist(), 0.5, "REPLACE")
    thing.shape_key_add(name="Basis")
    places = np.empty(3 * len(rows))
    thing.data.vertices.foreach_get("co", places)
    for number, (name, value) in enumerate((("wide", 0.7), ("high", 0.5), ("gone", 1.0))):
        key = thing.shape_key_add(name=name)
        key.value = value
        offset = np.zeros((len(rows), 3))
        offset[:, number] = (0.3 + 0.1 * np.sin(rows)) / thing.matrix_world.to_scale()[number]
        key.data.foreach_set("co", places + offset.ravel())
    keys = thing.data.shape_keys.key_blocks
    keys["wide"].vertex_group = "half"
    keys["high"].relative_key = keys["wide"]
    keys["gone"].mute = True
    thing.active_shape_key_index = 2


def state(thing):
    """Return what the export may not change."""
    places = np.empty(3 * len(thing.data.vertices))
    thing.data.vertices.foreach_get("co", places)
    keys = [(key.name, key.value) for key in thing.data.shape_keys.key_blocks]
    return places, keys, thing.active_shape_key_index


def placed(thing, source):
    """Return vertices in the world, Y up."""
    places = np.empty((len(source), 3))
    source.foreach_get("co", places.reshape(-1))
    matrix = np.array(thing.matrix_world)
    places = places @ matrix[:3, :3].T + matrix[:3, 3]
    return places[:, [0, 2, 1]] * [1, 1, -1]


def main():
    """Export, look."""
    addon, character, out = sys.argv[1:]
    sys.path.insert(0, addon)
    import exchange

    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    bpy.ops.import_scene.gltf(filepath=character)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 0, 3
    body = next(thing for thing in bpy.data.objects if thing.type == "MESH" and thing.find_armature())
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=7, y_subdivisions=5)
    garment = bpy.context.object
    bpy.context.view_layer.update()
    for thing in (body, garment):
        give_keys(thing)
    bpy.context.view_layer.update()
    before = [state(thing) for thing in (body, garment)]
    exchange.export_body(Path(out) / "body.glb", body, bpy.context)
    exchange.export_garment(Path(out) / "garment.obj", garment, scene)
    after = [state(thing) for thing in (body, garment)]
    is_as_before = all(
        np.array_equal(old[0], new[0]) and old[1:] == new[1:] for old, new in zip(before, after, strict=True)
    )
    arrays = {}
    for name, thing in (("body", body), ("garment", garment)):
        for modifier in thing.modifiers:
            modifier.show_viewport = False
        final = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
        arrays[name] = placed(thing, final.data.vertices)
        arrays[f"{name}_drawn"] = placed(thing, thing.data.vertices)
    np.savez(Path(out) / "shown.npz", is_as_before=is_as_before, **arrays)


main()
