"""From a rest mesh to a `Garment`, and what depends on its rest shape, as differentiable functions of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.errors import MeshError
from eslr_jax.mesh import padding, topology
from eslr_jax.mesh.coarse import add_coarse_edges
from eslr_jax.mesh.geodesic import EmbeddingMode, geodesic_embedding
from eslr_jax.mesh.surface import compact_groups
from eslr_jax.mesh.validate import validate_lengths, validate_mesh, validate_orientation
from eslr_jax.numerics import safe_norm, scatter_corners, to_device
from eslr_jax.types import Garment


def prepare_garment(
    rest_positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    skin_weights: Float[np.ndarray, "vertices influences"],
    skin_indices: Int[np.ndarray, "vertices influences"],
    is_pinned: Bool[np.ndarray, " vertices"] | Int[np.ndarray, " pins"] | None = None,
    sewn_positions: Float[np.ndarray, "vertices 3"] | None = None,
    panel_corners: Float[np.ndarray, "faces 3 2"] | None = None,
    embedding_size: int = 8,
    embedding_mode: EmbeddingMode = "canonical",
    allow_components: bool = False,
    pad: bool = False,
    name: str = "garment",
) -> Garment:
    """Validate a rest mesh and compute everything about it that stays constant during a rollout.

    Args:
        rest_positions: Vertex positions in the body's rest pose [m], shape [vertices, 3].
        faces: Triangles, counter-clockwise seen from outside, shape [faces, 3].
        skin_weights: Joint weights, shape [vertices, influences]; rows are normalised to one.
        skin_indices: Joint of every weight, shape [vertices, influences].
        is_pinned: Vertices that follow their skinned position, as a mask, shape [vertices], or as indices.
        sewn_positions: Positions on which lengths, areas and angles are measured [m], shape [vertices, 3]; the
            rest positions by default. They differ where the rest shape was posed or moved out of the body.
        panel_corners: Corners of each face in the plane of the panel that it was cut from [m], shape
            [faces, 3, 2], where that measures lengths, areas and angles instead.
        embedding_size: Number of coordinates of the geodesic embedding.
        embedding_mode: Its kind; see `mesh.geodesic`.
        allow_components: Accept a mesh of several connected components.
        pad: Pad to the garment's bucket.
        name: Name of the garment in messages.

    Returns:
        The garment, with float32, int32 and bool leaves.

    Raises:
        MeshError: The mesh can't be simulated, or an array has the wrong number of rows.
        ConfigError: The embedding mode is unknown.
    """
    validate_mesh(rest_positions, faces, name=name, allow_components=allow_components)
    validate_orientation(rest_positions, faces, name=name)
    positions = sewn = np.asarray(rest_positions, np.float64)
    if sewn_positions is not None:
        sewn = np.asarray(sewn_positions, np.float64)
        if sewn.shape != positions.shape:
            raise MeshError(
                f"{name}: sewn positions {sewn.shape} do not fit rest positions {positions.shape}; "
                "give one row per vertex"
            )
        validate_lengths(sewn, faces, name=f"{name}, as sewn")
    faces = np.asarray(faces, np.int64)
    num_vertices = len(positions)
    is_pinned = _pin_mask(name, num_vertices, is_pinned)
    skin_weights = np.asarray(skin_weights, np.float64)
    skin_indices = np.asarray(skin_indices)
    _check_rows(name, num_vertices, skin_weights, skin_indices)

    corners, apart = sewn[faces], np.arange(3 * len(faces)).reshape(-1, 3)
    if panel_corners is not None:
        if np.shape(panel_corners) != (len(faces), 3, 2):
            raise MeshError(f"{name}: panel corners {np.shape(panel_corners)} do not fit {len(faces)} faces")
        corners = np.pad(np.asarray(panel_corners, np.float64), ((0, 0), (0, 0), (0, 1)))
        validate_lengths(corners.reshape(-1, 3), apart, name=f"{name}, as cut")
    points = corners.reshape(-1, 3)
    areas = topology.face_areas(points, apart)
    hinges, hinge_faces = topology.find_hinges(faces)
    sides = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2).ravel()
    left, right = topology.hinge_half_edges(faces)
    edges = topology.unique_edges(faces)
    senders, receivers, reverse = topology.directed_edges(edges)
    neighbors, neighbor_mask = topology.neighbor_table(senders, receivers, num_vertices)
    garment: Any = Garment(  # NumPy leaves, until the padding is done
        rest_positions=positions,
        sewn_positions=sewn,
        faces=faces,
        rest_areas=areas,
        inverse_rest_frames=topology.inverse_rest_frames(points, apart),
        hinges=hinges,
        hinge_rest_areas=areas[hinge_faces].sum(axis=1),
        hinge_rest_lengths=0.5 * (sides[left] + sides[right]),
        vertex_areas=topology.vertex_areas(areas, faces, num_vertices),
        senders=senders,
        receivers=receivers,
        reverse_edges=reverse,
        neighbors=neighbors,
        neighbor_mask=neighbor_mask,
        face_incidence=topology.incidence_table(faces, num_vertices),
        hinge_incidence=topology.incidence_table(hinges, num_vertices),
        vertex_blocks=compact_groups(positions, padding.BLOCK),
        face_blocks=compact_groups(positions[faces].mean(axis=1), padding.FACE_BLOCK),
        edges=edges,
        edge_blocks=compact_groups(positions[edges].mean(axis=1), padding.EDGE_BLOCK),
        edge_mask=np.ones(len(senders), bool),
        vertex_mask=np.ones(num_vertices, bool),
        geodesic_embedding=geodesic_embedding(positions, faces, embedding_size, embedding_mode),
        skin_weights=skin_weights / skin_weights.sum(axis=1, keepdims=True),
        skin_indices=skin_indices,
        is_pinned=is_pinned,
    )
    return to_device(padding.pad_garment(garment) if pad else garment)


def pad_alike(garments: Sequence[Garment], bucket: padding.Bucket | None = None) -> list[Garment]:
    """Pad garments to one bucket, so that they share compiled functions and can be stacked.

    The bucket is by default the smallest that holds all garments and a spare vertex. Their coarse edges are made
    anew, padded too, and their materials left out.
    """
    if bucket is None:
        bucket = padding.common_bucket([padding.garment_bucket(garment) for garment in garments])
        bucket = bucket._replace(vertices=bucket.vertices + 1)
    padded = [padding.pad_garment(garment.replace(material=None), bucket) for garment in garments]
    return [to_device(add_coarse_edges(one) if one.coarse is not None else one) for one in padded]


def with_rest_positions(garment: Garment, rest_positions: Float[Array, "vertices 3"]) -> Garment:
    """Return a garment whose lengths, areas and angles are measured on other rest positions.

    These are `garment.sewn_positions`, changed [m], shape [vertices, 3]; the place from which the garment is
    skinned moves as much. `prepare_garment` computes the same on the host, in float64. This one is for gradients
    with respect to the shape that a garment is cut to; topology, skinning and embedding stay. Warp and weft stay
    where they are in every face. Bending in N m does not follow: a `Plate` holds the shape that it was prepared
    for, and energies of the new garment refuse it with a ConfigError. Describe bending by `bending_stiffness`.
    """
    is_real = garment.rest_areas > 0
    areas = jnp.where(is_real, _areas(rest_positions, garment.faces), 0.0)
    left, right = garment.hinges[:, [0, 1, 2]], garment.hinges[:, [1, 0, 3]]
    hinge_areas = _areas(rest_positions, left) + _areas(rest_positions, right)
    hinge_edges = rest_positions[garment.hinges[:, 1]] - rest_positions[garment.hinges[:, 0]]
    thirds = jnp.broadcast_to((areas / 3.0)[:, None], garment.faces.shape)
    return garment.replace(
        rest_positions=garment.rest_positions + (rest_positions - garment.sewn_positions),
        sewn_positions=rest_positions,
        rest_areas=areas,
        inverse_rest_frames=jnp.where(
            is_real[:, None, None], _inverse_rest_frames(rest_positions, garment), garment.inverse_rest_frames
        ),
        hinge_rest_areas=jnp.where(garment.hinge_rest_areas > 0, hinge_areas, 0.0),
        hinge_rest_lengths=jnp.where(garment.hinge_rest_areas > 0, safe_norm(hinge_edges), 0.0),
        vertex_areas=scatter_corners(thirds, garment.face_incidence),
        is_recut=True,
    )


def _check_rows(name: str, num_vertices: int, skin_weights: np.ndarray, skin_indices: np.ndarray) -> None:
    """Raise on skin weights that do not fit the mesh, name no joint, or whose rows can't be normalised."""
    fits = skin_weights.ndim == 2 and len(skin_weights) == num_vertices
    if not fits or skin_weights.shape != skin_indices.shape:
        raise MeshError(
            f"{name}: skin weights {skin_weights.shape} and indices {skin_indices.shape} do not fit "
            f"{num_vertices} vertices; give one row per vertex, or use transfer_skin_weights"
        )
    if (skin_indices < 0).any():
        vertex = int(np.argmax((skin_indices < 0).any(axis=1)))
        raise MeshError(
            f"{name}: skin indices of vertex {vertex} are {skin_indices[vertex]}; joints are counted from 0"
        )
    sums = skin_weights.sum(axis=1)
    is_bad = ~(np.isfinite(sums) & (sums > 0)) | np.any(skin_weights < 0, axis=1)
    if is_bad.any():
        vertex = int(np.argmax(is_bad))
        raise MeshError(
            f"{name}: skin weights of vertex {vertex} are {skin_weights[vertex]}; "
            "give finite, non-negative weights with a positive sum"
        )


def _pin_mask(name: str, num_vertices: int, is_pinned: np.ndarray | None) -> Bool[np.ndarray, " vertices"]:
    """Return a mask of the pinned vertices, given a mask or indices; raise where they do not fit the mesh."""
    mask = np.zeros(num_vertices, bool)
    if is_pinned is None:
        return mask
    given = np.asarray(is_pinned)
    if given.dtype.kind in "iu":
        is_missing = (given < 0) | (given >= num_vertices)
        if given.ndim != 1 or is_missing.any():
            missing = given[is_missing].ravel()[:1]
            cause = f"vertex {missing[0]}" if len(missing) else f"an array of shape {given.shape}"
            raise MeshError(
                f"{name}: {cause} can't be pinned; give a list of indices from 0 to {num_vertices - 1}"
            )
        mask[given] = True
        return mask
    if given.dtype.kind != "b" or given.shape != (num_vertices,):
        raise MeshError(
            f"{name}: is_pinned has shape {given.shape} and dtype {given.dtype} for {num_vertices} vertices; "
            "give one boolean per vertex, or indices"
        )
    return given


def _areas(
    positions: Float[Array, "vertices 3"], corners: Int[Array, "triangles 3"]
) -> Float[Array, " triangles"]:
    a, b, c = (positions[corners[:, k]] for k in range(3))
    return 0.5 * safe_norm(jnp.cross(b - a, c - a))


def _inverse_rest_frames(
    positions: Float[Array, "vertices 3"], garment: Garment
) -> Float[Array, "faces 2 2"]:
    """Return the inverse of every face's edges in its own plane [1/m], see `topology.inverse_rest_frames`."""
    a, b, c = (positions[garment.faces[:, k]] for k in range(3))
    first, second = a - c, b - c
    is_real = garment.rest_areas > 0
    length = jnp.where(is_real, safe_norm(first), 1.0)
    along = jnp.sum(first * second, axis=-1) / length
    height = jnp.where(is_real, safe_norm(jnp.cross(first, second)) / length, 1.0)
    zero = jnp.zeros_like(length)
    rows = [
        jnp.stack([1.0 / length, -along / (length * height)], axis=-1),
        jnp.stack([zero, 1.0 / height], axis=-1),
    ]
    return jnp.stack(rows, axis=-2)
