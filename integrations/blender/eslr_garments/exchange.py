# SPDX-License-Identifier: GPL-3.0-or-later
"""What goes to the simulator, and what comes back. Blender is Z up, the simulator Y up; both are in metres."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path

import bpy
import numpy as np

FPS = 30.0  # of the simulation
MODIFIER = "ESLR Garments"
_EXTENTS = (0.3, 3.0)  # [m] of a body; others would be scaled by the simulator
_MOVED = 1e-3  # [m] by which the simulator may put the garment elsewhere
_STILL = 1e-6  # entries of a matrix by which an object at rest may differ
_HINDERING = {"ARMATURE", "CLOTH", "MESH_CACHE", "SOFT_BODY", "SURFACE_DEFORM"}  # would move the cloth again


class ExchangeError(Exception):
    """The scene can't be simulated; the message says what to change."""


def to_y_up(points: np.ndarray) -> np.ndarray:
    """Return points of Blender as the simulator has them."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def to_z_up(points: np.ndarray) -> np.ndarray:
    """Return points of the simulator as Blender has them."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def shown_shape(thing: bpy.types.Object) -> np.ndarray:
    """Return a mesh's own vertices [vertices, 3] as its shape keys shape it in this frame, without modifiers."""
    mesh, active = thing.data, thing.active_shape_key_index
    points = np.empty((len(mesh.vertices), 3))
    if mesh.shape_keys is None:
        mesh.vertices.foreach_get("co", points.reshape(-1))
        return points
    # Blender heeds muted keys, vertex groups and keys relative to others.
    mix = thing.shape_key_add(from_mix=True)
    mix.data.foreach_get("co", points.reshape(-1))
    thing.shape_key_remove(mix)
    thing.active_shape_key_index = active
    return points


def export_body(path: Path, body: bpy.types.Object, context: bpy.types.Context) -> None:
    """Write a skinned mesh with its armature and their animation in the scene's frames as a GLB file.

    It has the shape that its shape keys give it in the current frame.

    Raises:
        ExchangeError: The body has no armature, does not move, or is not of a person's size.
    """
    armature = body.find_armature()
    if armature is None:
        raise ExchangeError(f"{body.name} has no armature that deforms it; choose the body's skinned mesh")
    vertices, shape = body.data.vertices, shown_shape(body)
    corners = shape @ np.array(body.matrix_world)[:3, :3].T
    size = float(np.ptp(corners, axis=0).max()) if len(corners) else 0.0
    if not _EXTENTS[0] <= size <= _EXTENTS[1]:
        raise ExchangeError(
            f"{body.name} is {size:.3g} m large; scale the character so that one unit is one metre"
        )
    chosen, active = list(context.selected_objects), context.view_layer.objects.active
    frame, drawn = context.scene.frame_current, np.empty_like(shape)
    vertices.foreach_get("co", drawn.reshape(-1))
    try:
        vertices.foreach_set("co", shape.reshape(-1))  # the exporter knows no vertex groups of shape keys
        for thing in context.view_layer.objects:
            thing.select_set(thing in (body, armature))
        bpy.ops.export_scene.gltf(
            filepath=str(path),
            export_format="GLB",
            use_selection=True,
            export_animation_mode="SCENE",
            export_anim_scene_split_object=False,
            export_frame_range=True,
            export_force_sampling=True,
            export_optimize_animation_size=False,
            export_morph=False,
            export_materials="NONE",
            export_texcoords=False,
        )
    finally:
        vertices.foreach_set("co", drawn.reshape(-1))
        for thing in context.view_layer.objects:
            thing.select_set(thing in chosen)
        context.view_layer.objects.active = active
        context.scene.frame_set(frame)
    data = path.read_bytes()
    tables = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    if not tables.get("animations"):
        scene = context.scene
        raise ExchangeError(
            f"{armature.name} does not move in frames {scene.frame_start} to {scene.frame_end}; give it an action"
        )


def export_garment(path: Path, garment: bpy.types.Object, scene: bpy.types.Scene) -> None:
    """Write a garment's own mesh and its active texture coordinates, without modifiers, where it is in the world.

    It has the shape that its shape keys give it in the current frame.

    Raises:
        ExchangeError: It has no faces, or moves as a whole.
    """
    mesh, frame, places = garment.data, scene.frame_current, []
    for end in (scene.frame_start, scene.frame_end):
        scene.frame_set(end)
        places.append(np.array(garment.matrix_world))
    scene.frame_set(frame)
    if np.abs(places[1] - places[0]).max() > _STILL:
        raise ExchangeError(
            f"{garment.name} moves as a whole; clear its parent (Alt P, keep transform) and its own animation"
        )
    if not len(mesh.polygons):
        raise ExchangeError(f"{garment.name} has no faces; choose the garment's mesh")
    matrix = np.array(garment.matrix_world)
    points = shown_shape(garment) @ matrix[:3, :3].T + matrix[:3, 3]
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in to_y_up(points)]
    layer = mesh.uv_layers.active
    if layer is not None and len(layer.data) == len(mesh.loops):
        uvs = np.empty((len(mesh.loops), 2), np.float32)
        layer.data.foreach_get("uv", uvs.reshape(-1))
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in uvs]
        corners = [zip(face.vertices, face.loop_indices, strict=True) for face in mesh.polygons]
        lines += ["f " + " ".join(f"{vertex + 1}/{loop + 1}" for vertex, loop in face) for face in corners]
    else:
        lines += ["f " + " ".join(str(vertex + 1) for vertex in face.vertices) for face in mesh.polygons]
    path.write_text("\n".join(lines) + "\n")


def check_place(path: Path) -> None:
    """Check what `eslr fit --json` wrote: the garment is still where it was.

    Raises:
        ExchangeError: It was moved.
    """
    moved = json.loads(path.read_text())["placement"]["moved_m"]
    if np.abs(moved).max() > _MOVED:
        raise ExchangeError(
            f"the garment would be moved by {np.abs(moved).max():.2g} m; let the character's rest pose stand "
            "with its soles within 2 cm of height 0, and the garment on it"
        )


def read_motion(path: Path, garment: bpy.types.Object) -> np.ndarray:
    """Return the garment's vertices in motion, in world space, Z up [m], shape [frames, vertices, 3].

    Raises:
        ExchangeError: The vertices are not the garment's.
    """
    with np.load(path) as arrays:
        positions = arrays["positions"].astype(np.float64)
    if positions.shape[1] != len(garment.data.vertices):
        raise ExchangeError(
            f"{garment.name} has vertices without faces; delete them (Mesh > Clean Up > Delete Loose)"
        )
    return to_z_up(positions)


def read_start(path: Path) -> float:
    """Return at what time of the animation a simulation begins [s], which its `report.json` tells.

    A pose from which the character jumps into the animation, such as a T-pose, is not simulated.
    """
    return float(json.loads(path.read_text()).get("motion_start_s", 0.0))  # missing in older versions


def lay_cache(
    garment: bpy.types.Object, positions: np.ndarray, path: Path, scene: bpy.types.Scene, *, start: float
) -> bpy.types.Modifier:
    """Let a garment follow positions by a point cache, which comes before its other modifiers.

    Modifiers that would move the cloth a second time are switched off.

    Args:
        garment: The garment.
        positions: Vertices in world space [m], shape [frames, vertices, 3].
        path: The PC2 file to write.
        scene: Its first frame and its rate tell when.
        start: Time from the scene's first frame to that of the positions [s].
    """
    back = np.linalg.inv(np.array(garment.matrix_world))
    local = (positions @ back[:3, :3].T + back[:3, 3]).astype("<f4")
    path.parent.mkdir(parents=True, exist_ok=True)
    # Magic, version, points, first frame, frames per sample, samples.
    header = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, local.shape[1], 0.0, 1.0, local.shape[0])
    new = path.with_name(f".{path.name}")
    new.write_bytes(header + local.tobytes())
    os.replace(new, path)  # the last cache stays if the disk is full
    for modifier in garment.modifiers:
        if modifier.type in _HINDERING and modifier.name != MODIFIER:
            modifier.show_viewport = modifier.show_render = False
    old = garment.modifiers.get(MODIFIER)
    if old is not None:
        garment.modifiers.remove(old)
    cache = garment.modifiers.new(MODIFIER, "MESH_CACHE")
    garment.modifiers.move(len(garment.modifiers) - 1, 0)
    cache.cache_format, cache.filepath = "PC2", str(path)
    cache.forward_axis, cache.up_axis = "POS_Y", "POS_Z"  # as they are
    cache.frame_scale = FPS * scene.render.fps_base / scene.render.fps  # samples per frame
    # Blender takes it from the scaled frame, so it counts samples (`MOD_meshcache.cc`).
    cache.frame_start = cache.frame_scale * scene.frame_start + FPS * start
    return cache
