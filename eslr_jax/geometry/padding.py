"""Buckets: a few sizes that garments are padded to, so that one compiled function serves many garments."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from eslr_jax.errors import CapacityError
from eslr_jax.types import Garment

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


def round_up(count: int) -> int:
    """Return the smallest size of the series that holds `count`: sixteen steps between powers of two."""
    step = max(2 ** (max(count - 1, 1).bit_length() - 1) // STEPS_PER_OCTAVE, 1)
    return -(-count // step) * step


def choose_bucket(garment: Garment) -> Bucket:
    """Return the bucket of an unpadded garment; almost a function of its vertex count alone.

    A mesh of n vertices without handles has fewer than 2 n faces, 3 n hinges and 6 n directed edges. Sizes
    follow those bounds, so garments of like vertex counts share a bucket; a mesh beyond them gets its own
    counts rounded up. One vertex is always left over, for the padding to point at.
    """
    vertices = round_up(len(garment.vertex_mask) + 1)
    return Bucket(
        vertices=vertices,
        faces=_at_least(2 * vertices, len(garment.faces)),
        hinges=_at_least(3 * vertices, len(garment.hinges)),
        edges=_at_least(6 * vertices, len(garment.edge_mask)),
        degree=_round_to(garment.neighbors.shape[1], 2),
        face_degree=_round_to(garment.face_incidence.shape[1], 2),
        hinge_degree=_round_to(garment.hinge_incidence.shape[1], 4),
    )


def garment_bucket(garment: Garment) -> Bucket:
    """Return the sizes a garment has now."""
    return Bucket(
        vertices=len(garment.vertex_mask),
        faces=len(garment.faces),
        hinges=len(garment.hinges),
        edges=len(garment.edge_mask),
        degree=garment.neighbors.shape[1],
        face_degree=garment.face_incidence.shape[1],
        hinge_degree=garment.hinge_incidence.shape[1],
    )


def common_bucket(buckets: list[Bucket]) -> Bucket:
    """Return the smallest bucket that holds all of `buckets`, for several garments in one batch."""
    return Bucket(*(max(sizes) for sizes in zip(*buckets, strict=True)))


def stacking_bucket(garments: list[Garment]) -> Bucket:
    """Return the smallest bucket that holds all garments, with a vertex to spare for padding to point at."""
    bucket = common_bucket([garment_bucket(garment) for garment in garments])
    return bucket._replace(vertices=bucket.vertices + 1)


def pad_garment(garment: Garment, bucket: Bucket | None = None) -> Garment:
    """Pad a garment's arrays to a bucket.

    Padded vertices rest at the garment's mean position with zero area and the first vertex's skin; padded
    faces, hinges and edges point at the last vertex with zero area; incidence tables don't list them.

    Args:
        garment: A garment; NumPy or JAX leaves.
        bucket: Sizes to reach; by default `choose_bucket`'s.

    Returns:
        The padded garment, with NumPy leaves of the same dtypes.

    Raises:
        CapacityError: The bucket is too small, or has no vertex left over for the padding to point at.
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
    extra = {key: want - has for key, has, want in zip(Bucket._fields, have, bucket, strict=True)}

    def append(name: str, rows: int, value: object) -> np.ndarray:
        leaf = leaves[name]
        block = np.broadcast_to(np.asarray(value, leaf.dtype), (rows, *leaf.shape[1:]))
        return np.concatenate([leaf, block])

    padded = {
        name: append(name, extra["vertices"], value)
        for name, value in {
            "rest_positions": leaves["rest_positions"].mean(axis=0),
            "vertex_areas": 0,
            "vertex_mask": False,
            "geodesic_embedding": 0,
            "skin_weights": leaves["skin_weights"][0],
            "skin_indices": leaves["skin_indices"][0],
            "is_pinned": False,
        }.items()
    }
    padded |= {
        "faces": append("faces", extra["faces"], last),
        "rest_areas": append("rest_areas", extra["faces"], 0),
        "inverse_rest_frames": append("inverse_rest_frames", extra["faces"], np.eye(2)),
        "hinges": append("hinges", extra["hinges"], last),
        "hinge_rest_areas": append("hinge_rest_areas", extra["hinges"], 0),
        "hinge_rest_angles": append("hinge_rest_angles", extra["hinges"], 0),
        "senders": append("senders", extra["edges"], last),
        "receivers": append("receivers", extra["edges"], last),
        "edge_mask": append("edge_mask", extra["edges"], False),
    }
    itself = np.arange(have.edges, bucket.edges, dtype=leaves["reverse_edges"].dtype)
    padded["reverse_edges"] = np.concatenate([leaves["reverse_edges"], itself])
    padded["neighbors"], padded["neighbor_mask"] = _pad_neighbors(
        leaves["neighbors"], leaves["neighbor_mask"], bucket
    )
    padded["face_incidence"] = _pad_incidence(
        leaves["face_incidence"], 3, (have.faces, bucket.faces), (bucket.vertices, bucket.face_degree)
    )
    padded["hinge_incidence"] = _pad_incidence(
        leaves["hinge_incidence"], 4, (have.hinges, bucket.hinges), (bucket.vertices, bucket.hinge_degree)
    )
    return dataclasses.replace(garment, **padded)


def _pad_neighbors(neighbors: np.ndarray, mask: np.ndarray, bucket: Bucket) -> tuple[np.ndarray, np.ndarray]:
    """Return a neighbour table and its mask grown to the bucket; new entries name their own row."""
    rows, columns = neighbors.shape
    own = np.arange(bucket.vertices, dtype=neighbors.dtype)[:, None]
    table = np.repeat(own, bucket.degree, axis=1)
    table[:rows, :columns] = neighbors
    return table, np.pad(mask, ((0, bucket.vertices - rows), (0, bucket.degree - columns)))


def _pad_incidence(
    table: np.ndarray, corners: int, items: tuple[int, int], shape: tuple[int, int]
) -> np.ndarray:
    """Return an incidence table grown to `shape` and from items[0] to items[1] items.

    Entry corner * items[0] + item becomes corner * items[1] + item; the padding moves along.
    """
    corner, item = np.divmod(table, max(items[0], 1))
    padded = np.full(shape, corners * items[1], table.dtype)
    is_padding = table == corners * items[0]
    padded[: table.shape[0], : table.shape[1]] = np.where(
        is_padding, corners * items[1], corner * items[1] + item
    )
    return padded


def _at_least(bound: int, count: int) -> int:
    """Return `bound` where it holds `count`, else `count` rounded up."""
    return bound if count <= bound else round_up(count)


def _round_to(count: int, multiple: int) -> int:
    """Return `count` rounded up to a multiple."""
    return math.ceil(count / multiple) * multiple
