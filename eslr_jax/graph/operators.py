"""Gathers and sums over a graph, each with the backward pass that XLA would not find.

Automatic differentiation turns a gather into a scatter-add, which a CPU does one element at a time and a GPU
in an order that changes from run to run. A mesh is undirected and its edges are sorted by receiver, so every
backward pass below is again a gather or a sorted segment sum.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.numerics import segment_sum
from eslr_jax.types import Garment


class MeshTables(NamedTuple):
    """Index tables of a garment's mesh edges."""

    senders: Int[Array, " edges"]
    receivers: Int[Array, " edges"]  # sorted
    reverse_edges: Int[Array, " edges"]
    neighbors: Int[Array, "vertices degree"]  # padded with the number of vertices
    degree: Float[Array, "vertices 1"]


class WorldTables(NamedTuple):
    """Which world edge belongs to which vertex; None for both where row w is vertex w."""

    vertex: Int[Array, " world_edges"] | None  # the number of vertices where masked
    slot: Int[Array, " vertices"] | None  # the number of world edges where a vertex has none
    mask: Float[Array, "world_edges 1"]
    vertex_mask: Float[Array, "vertices 1"]  # the same mask seen from the vertices


def mesh_tables(garment: Garment, dtype) -> MeshTables:
    """Return the tables of `garment`, with its neighbours padded for `sum_neighbors`."""
    num_vertices = garment.neighbors.shape[0]
    return MeshTables(
        senders=garment.senders,
        receivers=garment.receivers,
        reverse_edges=garment.reverse_edges,
        neighbors=jnp.where(garment.neighbor_mask, garment.neighbors, num_vertices),
        degree=jnp.sum(garment.neighbor_mask, axis=1, keepdims=True).astype(dtype),
    )


def world_tables(
    slot: Int[Array, " vertices"],
    vertex: Int[Array, " world_edges"],
    mask: Bool[Array, " world_edges"],
    dtype,
) -> WorldTables:
    """Return the tables of the world edges.

    Args:
        slot: World edge of every vertex, or the number of world edges.
        vertex: Vertex of every world edge.
        mask: World edges in use.
        dtype: Of the masks.
    """
    num_vertices, num_edges = slot.shape[0], mask.shape[0]
    if num_vertices == num_edges:
        column = mask.astype(dtype)[:, None]
        return WorldTables(None, None, column, column)
    return WorldTables(
        vertex=jnp.where(mask, vertex, num_vertices),
        slot=slot,
        mask=mask.astype(dtype)[:, None],
        vertex_mask=(slot < num_edges).astype(dtype)[:, None],
    )


def _take(x: Float[Array, "rows features"], indices: Int[Array, " items"]) -> Float[Array, "items features"]:
    """Gather rows; indices are known to be in range and not negative."""
    return x.at[indices].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _append_zero(x: Float[Array, "rows features"]) -> Float[Array, "rows_and_one features"]:
    """Append a row of zeros, for indices that mean "none"."""
    return jnp.concatenate([x, jnp.zeros((1, x.shape[1]), x.dtype)])


@jax.custom_vjp
def take_receivers(
    x: Float[Array, "vertices features"], tables: MeshTables
) -> Float[Array, "edges features"]:
    """Return the row of every edge's receiver; the backward pass is a sorted segment sum."""
    return _take(x, tables.receivers)


def _take_receivers_backward(tables, cotangent):
    return sum_receivers(cotangent, tables), None


take_receivers.defvjp(lambda x, tables: (take_receivers(x, tables), tables), _take_receivers_backward)


@jax.custom_vjp
def take_senders(x: Float[Array, "vertices features"], tables: MeshTables) -> Float[Array, "edges features"]:
    """Return the row of every edge's sender.

    The backward pass sums over the edges that leave a vertex: those that enter it, seen through
    `reverse_edges`.
    """
    return _take(x, tables.senders)


def _take_senders_backward(tables, cotangent):
    return sum_receivers(_take(cotangent, tables.reverse_edges), tables), None


take_senders.defvjp(lambda x, tables: (take_senders(x, tables), tables), _take_senders_backward)


@jax.custom_vjp
def sum_receivers(x: Float[Array, "edges features"], tables: MeshTables) -> Float[Array, "vertices features"]:
    """Sum over the edges that enter every vertex; the backward pass is a gather."""
    num_vertices = tables.neighbors.shape[0]
    return segment_sum(x, tables.receivers, num_vertices, is_sorted=True)


sum_receivers.defvjp(
    lambda x, tables: (sum_receivers(x, tables), tables),
    lambda tables, cotangent: (_take(cotangent, tables.receivers), None),
)


@jax.custom_vjp
def sum_neighbors(
    x: Float[Array, "vertices features"], tables: MeshTables
) -> Float[Array, "vertices features"]:
    """Sum over the neighbours of every vertex; on an undirected mesh the operator is its own adjoint."""
    padded = _append_zero(x)
    return sum(_take(padded, tables.neighbors[:, k]) for k in range(tables.neighbors.shape[1]))


sum_neighbors.defvjp(
    lambda x, tables: (sum_neighbors(x, tables), tables),
    lambda tables, cotangent: (sum_neighbors(cotangent, tables), None),
)


def to_world(
    x: Float[Array, "vertices features"], tables: WorldTables
) -> Float[Array, "world_edges features"]:
    """Return the row of every world edge's vertex; masked rows are anything finite."""
    return x if tables.vertex is None else _take_paired(x, tables.vertex, tables.slot)


def from_world(
    x: Float[Array, "world_edges features"], tables: WorldTables
) -> Float[Array, "vertices features"]:
    """Return the row of every vertex's world edge; zero where it has none."""
    return x * tables.mask if tables.vertex is None else _take_paired(x, tables.slot, tables.vertex)


@jax.custom_vjp
def _take_paired(
    x: Float[Array, "rows features"], indices: Int[Array, " items"], inverse: Int[Array, " rows"]
) -> Float[Array, "items features"]:
    """Gather where every row is named at most once, so that the backward pass is the gather by the inverse.

    Both tables hold one past the end for "none", which gathers zero.
    """
    return _take(_append_zero(x), indices)


_take_paired.defvjp(
    lambda x, indices, inverse: (_take_paired(x, indices, inverse), (indices, inverse)),
    lambda tables, cotangent: (_take_paired(cotangent, tables[1], tables[0]), None, None),
)
