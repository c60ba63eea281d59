"""Gathers and sums over the edges of a graph; those of the mesh have backward passes that suit CPU and GPU.

Automatic differentiation turns a gather into a scatter-add. A CPU does that one element at a time, a GPU in an
order that changes from run to run. A mesh is undirected and its edges are sorted by receiver, so every backward
pass below is again a gather or a sorted segment sum.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Float, Int

from eslr_jax.numerics import segment_sum


class MeshTables(NamedTuple):
    """Index tables of the mesh edges, in the form that the operators below read."""

    senders: Int[Array, " edges"]
    receivers: Int[Array, " edges"]  # ascending
    reverse_edges: Int[Array, " edges"]  # index of the opposite edge
    # Senders of the incoming edges, padded with the number of vertices.
    neighbors: Int[Array, "vertices degree"]
    degree: Float[Array, "vertices 1"]  # number of neighbours


def mesh_tables(graph: jraph.GraphsTuple, dtype) -> MeshTables:
    """Return the tables that messages along a graph's mesh edges follow; degrees are of `dtype`."""
    senders, incoming = graph.senders["mesh"], graph.globals["incoming_edges"]
    num_vertices, num_edges = incoming.shape[0], senders.shape[0]
    padded = jnp.concatenate([senders, jnp.full(1, num_vertices, senders.dtype)])
    return MeshTables(
        senders=senders,
        receivers=graph.receivers["mesh"],
        reverse_edges=graph.globals["reverse_edges"],
        neighbors=_take(padded, incoming),
        degree=jnp.sum(incoming < num_edges, axis=1, keepdims=True).astype(dtype),
    )


def coarse_tables(graph: jraph.GraphsTuple, level: int) -> MeshTables:
    """Return the tables that messages along a coarse level's edges follow, 0 the finest; nothing is smoothed."""
    edges, name = graph.globals["coarse"][level], f"coarse{level}"
    num_vertices = edges.is_kept.shape[0]
    return MeshTables(
        senders=graph.senders[name],
        receivers=graph.receivers[name],
        reverse_edges=edges.reverse_edges,
        neighbors=jnp.zeros((num_vertices, 0), jnp.int32),
        degree=jnp.zeros((num_vertices, 1)),
    )


def _take(x: Array, indices: Int[Array, ...]) -> Array:
    """Gather rows; every index is known to be in range and not negative."""
    return x.at[indices].get(mode="promise_in_bounds", wrap_negative_indices=False)


@jax.custom_vjp
def take_receivers(
    x: Float[Array, "vertices features"], tables: MeshTables
) -> Float[Array, "edges features"]:
    """Return the row of every edge's receiver; the backward pass is a sorted segment sum."""
    return _take(x, tables.receivers)


take_receivers.defvjp(
    lambda x, tables: (take_receivers(x, tables), tables),
    lambda tables, cotangent: (sum_receivers(cotangent, tables), None),
)


@jax.custom_vjp
def take_senders(x: Float[Array, "vertices features"], tables: MeshTables) -> Float[Array, "edges features"]:
    """Return the row of every edge's sender; backward sums over the reverses of the edges that enter a vertex."""
    return _take(x, tables.senders)


take_senders.defvjp(
    lambda x, tables: (take_senders(x, tables), tables),
    lambda tables, cotangent: (sum_receivers(_take(cotangent, tables.reverse_edges), tables), None),
)


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
    padded = jnp.concatenate([x, jnp.zeros((1, x.shape[1]), x.dtype)])
    return sum(_take(padded, tables.neighbors[:, k]) for k in range(tables.neighbors.shape[1]))


sum_neighbors.defvjp(
    lambda x, tables: (sum_neighbors(x, tables), tables),
    lambda tables, cotangent: (sum_neighbors(cotangent, tables), None),
)


def to_world_edges(
    x: Float[Array, "vertices features"], num_edges: int
) -> Float[Array, "world_edges features"]:
    """Return the row of every world edge's vertex; see `networks.build` for their order."""
    return jnp.tile(x, (num_edges // x.shape[0], 1))


def sum_world_edges(
    x: Float[Array, "world_edges features"], num_vertices: int
) -> Float[Array, "vertices features"]:
    """Sum over the world edges of every vertex."""
    return jnp.sum(x.reshape(-1, num_vertices, x.shape[1]), axis=0)
