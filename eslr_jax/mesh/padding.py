"""Buckets: a few sizes that garments are padded to, so that one compiled function serves many garments."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from eslr_jax.errors import CapacityError
from eslr_jax.mesh.topology import moved_incidence
from eslr_jax.types import Garment, Material

BLOCK = 8  # vertices that a search handles together, see `Garment.vertex_blocks`
FACE_BLOCK = 16  # likewise faces; at most 32
EDGE_BLOCK = 16  # likewise edges
STEPS_PER_OCTAVE = 16  # a size is rounded up by at most a sixteenth of itself


class Bucket(NamedTuple):
    """Sizes of a padded garment's arrays."""

    vertices: int
    faces: int
    hinges: int
    edges: int  # directed
    degree: int  # columns of the neighbour table
    face_degree: int  # columns of the face incidence
    hinge_degree: int  # columns of the hinge incidence


def round_up(count: int, steps: int = STEPS_PER_OCTAVE) -> int:
    """Return the smallest bucket size that holds `count`; there are so many steps between powers of two."""
    step = max(2 ** (max(count - 1, 1).bit_length() - 1) // steps, 1)
    return -(-count // step) * step


def choose_bucket(garment: Garment, vertices: int | None = None) -> Bucket:
    """Return the bucket of an unpadded garment; almost a function of its vertex count alone.

    A mesh of n vertices without handles has fewer than 2 n faces, 3 n hinges and 6 n directed edges. Sizes
    follow these bounds, so garments of similar vertex counts share a bucket. A mesh beyond them gets its own
    counts rounded up.

    Args:
        garment: The garment.
        vertices: Of the bucket; by default the next larger size.
    """
    have = garment_bucket(garment)
    vertices = round_up(have.vertices + 1) if vertices is None else vertices

    def holding(bound: int, count: int) -> int:
        return bound if count <= bound else round_up(count)

    return Bucket(
        vertices=vertices,
        faces=holding(2 * vertices, have.faces),
        hinges=holding(3 * vertices, have.hinges),
        edges=holding(6 * vertices, have.edges),
        degree=-(-have.degree // 2) * 2,
        face_degree=-(-have.face_degree // 2) * 2,
        hinge_degree=-(-have.hinge_degree // 4) * 4,
    )


def garment_bucket(garment: Garment) -> Bucket:
    """Return the present sizes of a garment's arrays."""
    return Bucket(
        vertices=len(garment.vertex_mask),
        faces=len(garment.faces),
        hinges=len(garment.hinges),
        edges=len(garment.edge_mask),
        degree=garment.neighbors.shape[1],
        face_degree=garment.face_incidence.shape[1],
        hinge_degree=garment.hinge_incidence.shape[1],
    )


def common_bucket(buckets: Sequence[Bucket]) -> Bucket:
    """Return the smallest bucket that holds all `buckets`, for several garments in one batch."""
    return Bucket(*(max(sizes) for sizes in zip(*buckets, strict=True)))


def pad_garment(garment: Garment, bucket: Bucket | None = None) -> Garment:
    """Pad a garment's arrays to a bucket.

    Padded vertices rest at the garment's mean position, with zero area and the first vertex's skin. Padded
    faces, hinges and edges point at the last vertex and have zero area. Incidence tables don't list them.

    Args:
        garment: Garment with NumPy or JAX leaves.
        bucket: Sizes to reach; that of `choose_bucket` by default.

    Returns:
        The padded garment, with NumPy leaves of the same dtypes.

    Raises:
        CapacityError: The bucket is too small.
    """
    bucket = choose_bucket(garment) if bucket is None else bucket
    have = garment_bucket(garment)
    for name, has, wants in zip(Bucket._fields, have, bucket, strict=True):
        if has > wants:
            raise CapacityError(f"the garment has {name} {has}, the bucket holds {wants}; use choose_bucket")
    if have == bucket:
        return garment
    leaves = {name: np.asarray(getattr(garment, name)) for name in garment.__dataclass_fields__}
    last = bucket.vertices - 1
    values = {
        "vertices": {
            "rest_positions": leaves["rest_positions"].mean(axis=0),
            "sewn_positions": leaves["sewn_positions"].mean(axis=0),
            "vertex_areas": 0,
            "vertex_mask": False,
            "geodesic_embedding": 0,
            "skin_weights": leaves["skin_weights"][0],
            "skin_indices": leaves["skin_indices"][0],
            "is_pinned": False,
        },
        "faces": {"faces": last, "rest_areas": 0, "inverse_rest_frames": np.eye(2)},
        "hinges": {"hinges": last, "hinge_rest_areas": 0, "hinge_rest_lengths": 0},
        "edges": {"senders": last, "receivers": last, "edge_mask": False},
    }
    padded = {}
    for size, fields in values.items():
        for name, value in fields.items():
            leaf = leaves[name]
            rows = getattr(bucket, size) - getattr(have, size)
            block = np.broadcast_to(np.asarray(value, leaf.dtype), (rows, *leaf.shape[1:]))
            padded[name] = np.concatenate([leaf, block])
    itself = np.arange(have.edges, bucket.edges, dtype=leaves["reverse_edges"].dtype)
    extra = (bucket.edges - have.edges) // 2
    padded["edges"] = np.pad(leaves["edges"], ((0, extra), (0, 0)), constant_values=last)
    padded["reverse_edges"] = np.concatenate([leaves["reverse_edges"], itself])
    neighbors = np.arange(bucket.vertices, dtype=leaves["neighbors"].dtype)[:, None].repeat(bucket.degree, 1)
    neighbors[: have.vertices, : have.degree] = leaves["neighbors"]
    extra = ((0, bucket.vertices - have.vertices), (0, bucket.degree - have.degree))
    padded["neighbors"], padded["neighbor_mask"] = neighbors, np.pad(leaves["neighbor_mask"], extra)
    for name, corners, old, new, degree in (
        ("face_incidence", 3, have.faces, bucket.faces, bucket.face_degree),
        ("hinge_incidence", 4, have.hinges, bucket.hinges, bucket.hinge_degree),
    ):
        padded[name] = moved_incidence(leaves[name], corners, old, new, bucket.vertices, degree)
    for name, size, count in (
        ("vertex_blocks", BLOCK, bucket.vertices),
        ("face_blocks", FACE_BLOCK, bucket.faces),
        ("edge_blocks", EDGE_BLOCK, bucket.edges // 2),
    ):
        spare = -(-count // size) - len(leaves[name])
        padded[name] = np.pad(leaves[name], ((0, spare), (0, 0)), constant_values=count - 1)
    return dataclasses.replace(garment, **padded)


def pad_material(material: Material, garment: Garment, bucket: Bucket) -> Material:
    """Return the fabric of an unpadded garment for one that is padded to a bucket of as many vertices.

    What a fabric has by face or by hinge is repeated where it is padded: without area it counts for nothing.
    """
    have = garment_bucket(garment)
    faces, hinges = bucket.faces - have.faces, bucket.hinges - have.hinges

    def longer(values: Any, rows: int, axis: int = 0) -> Any:
        if not np.ndim(values):
            return values
        width = [(0, 0)] * np.ndim(values)
        width[axis] = (0, rows)
        return np.pad(np.asarray(values), width, mode="edge")

    plate, threads = material.plate, material.threads
    if plate is not None:
        rows = np.asarray(plate.rows)
        plate = plate.replace(
            hinges=longer(plate.hinges, faces),
            incidence=moved_incidence(plate.incidence, 9, have.faces, bucket.faces, bucket.hinges),
            rows=np.pad(rows, ((0, 0), (0, 0), (0, faces))),
        )
    if threads is not None:
        threads = threads.replace(
            warp=longer(threads.warp, faces),
            stiffness=longer(threads.stiffness, faces, 1),
            limits=None if threads.limits is None else longer(threads.limits, faces, 1),
        )
    return material.replace(
        lame_mu=longer(material.lame_mu, faces),
        lame_lambda=longer(material.lame_lambda, faces),
        bending_stiffness=longer(material.bending_stiffness, hinges),
        plate=plate,
        threads=threads,
    )
