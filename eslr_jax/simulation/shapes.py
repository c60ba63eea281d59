"""Sizes of arrays that scenes share, so that they share compiled programs (host)."""

from __future__ import annotations

import jax
import numpy as np

from eslr_jax.mesh.padding import Bucket, choose_bucket, garment_bucket, pad_garment, pad_material
from eslr_jax.mesh.surface import pad_surface, padded_vertices
from eslr_jax.terms import Term
from eslr_jax.types import FAR, BodyMotion, Garment, Scene


def share_shapes(scene: Scene) -> Scene:
    """Return a scene padded to sizes that others share; what comes of it is the same.

    Cloth is padded by faces, hinges and edges, not by vertices, so trajectories and states stay as they are.

    Args:
        scene: Of `prepare_scene`; arrays may be shapes alone, of `jax.eval_shape`.
    """
    scene = jax.tree.map(_filled, scene)
    garment, bucket = scene.garment, _bucket(scene.garment, scene.terms)
    pins = scene.pin_targets
    if pins is None and not np.any(garment.is_pinned):  # they hold nothing
        pins = np.zeros((scene.num_frames, *garment.rest_positions.shape), np.float32)
    scene = scene.replace(
        garment=pad_garment(garment, bucket),
        material=pad_material(scene.material, garment, bucket),
        pin_targets=pins,
    )
    body = scene.body
    if body is None:
        return scene
    count = padded_vertices(body.surface)
    added = ((0, 0), (0, count - len(body.surface.vertex_ids)), (0, 0))
    positions = np.pad(np.asarray(body.positions), added, constant_values=FAR)
    return scene.replace(body=body.replace(surface=pad_surface(body.surface, count), positions=positions))


def share_start(garment: Garment, poses: BodyMotion, terms: tuple[Term, ...]) -> tuple[Garment, BodyMotion]:
    """Return what `first_state` reads of a garment and a motion, padded as `share_shapes` does."""
    surface = pad_surface(poses.surface, padded_vertices(poses.surface))
    poses = poses.replace(
        surface=surface, positions=poses.positions[:2], joint_transforms=poses.joint_transforms[:2]
    )
    return pad_garment(garment, _bucket(garment, terms)), poses


def _bucket(garment: Garment, terms: tuple[Term, ...]) -> Bucket:
    """Return the sizes of a garment's arrays; as they are where a term of one's own may have arrays by face."""
    is_known = all(type(term).__module__.startswith("eslr_jax.") for term in terms)
    return choose_bucket(garment, len(garment.vertex_mask)) if is_known else garment_bucket(garment)


def _filled(leaf: object) -> object:
    """Return zeros for a shape; other leaves as they are."""
    return np.zeros(leaf.shape, leaf.dtype) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf
