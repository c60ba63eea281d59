"""Buckets: a few sizes that garments are padded to, so that one compiled function serves many garments."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from eslr_jax.errors import CapacityError
from eslr_jax.mesh.topology import moved_incidence
from eslr_jax.types import Garment

BLOCK = 8  # vertices that a search handles together, see `Garment.vertex_blocks`
FACE_BLOCK = 16  # likewise faces; at most 32
EDGE_BLOCK = 16  # likewise edges
STEPS_PER_OCTAVE = 16  # a size is rounded up by at most a sixteenth


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


def choose_bucket(garment: Garment) -> Bucket:
    """Return the bucket of an unpadded garment; almost a function of its vertex count alone.

    A mesh of n vertices without handles has fewer than 2 n faces, 3 n hinges and 6 n directed edges. Sizes
    follow these bounds, so garments of similar vertex counts share a bucket. A mesh beyond them gets its own
    counts rounded up. One vertex is always spare, for the padding to point at.
    """
    have = garment_bucket(garment)
    vertices = round_up(have.vertices + 1)

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
    """Return a garment, NumPy or JAX, padded to a bucket, that of `choose_bucket` by default, with NumPy leaves.

    Padded vertices rest at the garment's mean position, with zero area and the first vertex's skin. Padded faces,
    hinges and edges point at the last vertex and have zero area. Incidence tables don't list them.

    Raises:
        CapacityError: The bucket is too small, or has no spare vertex.
    """
    bucket = choose_bucket(garment) if bucket is None else bucket
    have = garment_bucket(garment)
    for name, has, wants in zip(Bucket._fields, have, bucket, strict=True):
        if has > wants:
            raise CapacityError(f"the garment has {name} {has}, the bucket holds {wants}; use choose_bucket")
    if have == bucket:
        return garment
    if have.vertices == bucket.vertices:
        needed = have.vertices + 1
        raise CapacityError(f"padding needs a vertex to point at; give the bucket at least {needed} vertices")
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
