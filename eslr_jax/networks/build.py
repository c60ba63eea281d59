"""A garment's state as a `jraph.GraphsTuple`: mesh edges, and world edges to near body points.

Nodes, edges, senders and receivers are dictionaries:

- nodes "garment" [vertices, features] and, beside a body, "body" [world_edges, features];
- edges "mesh" [edges, features] in both directions, sorted by receiver;
- with `GraphKind.has_coarse_edges`, edges "coarse0" to "coarse2" [coarse_edges, features] of the coarse levels;
- beside a body, edges "world" [world_edges, features] from body to garment, and with
  `GraphKind.has_reverse_edges` "world_reverse" [world_edges, features] from garment to body.

All vertices have as many world edges (`GraphKind.world_edges`). The first is to the nearest point of the body's
surface, the others are to the nearest of its vertices. World edge w joins body row w to garment vertex w, modulo
the vertices, so layers pair the rows and gather nothing. What lies beyond `GraphKind.world_edge_radius` has rows
of zeros, and `globals["world_mask"]` leaves it out; with "state" a vertex inside the body keeps its first edge.
Messages along mesh edges follow `senders["mesh"]`, `receivers["mesh"]` and the two tables in `globals` that
go with them: `Topology` names all entries of `globals`.

`n_node` holds the number of vertices, shape [1], and `n_edge` one such array for every set of edges. jraph's own
functions, such as `jraph.batch`, know one set of edges and no tables: `edge_set` gives them a graph of one set.
Networks map over scenes with `jax.vmap` in the place of a batch.
"""

from __future__ import annotations

from typing import NamedTuple, TypedDict, cast

import jax.numpy as jnp
import jraph
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.errors import ConfigError
from eslr_jax.networks import features
from eslr_jax.networks.features import GraphInputs, required
from eslr_jax.numerics import safe_norm
from eslr_jax.types import CoarseEdges, Garment, Material

COARSE_SETS = ("coarse0", "coarse1", "coarse2")
"""Edge sets of a garment's coarse levels, finest first (HOOD)."""

NUM_LEVELS = len(COARSE_SETS) + 1  # of a vertex; 0 is on the mesh alone

Rows = dict[str, Float[Array, "_ _"]]


class GraphKind(NamedTuple):
    """What a network reads of a frame; static."""

    reads_gradient: bool  # scaled features with the potential's gradient, in the place of HOOD's
    reads_state: bool = False  # beside HOOD's: relative velocities, strains, signed distances
    has_coarse_edges: bool = False
    has_reverse_edges: bool = False  # from garment to body, for networks that update body rows
    world_edge_radius: float = 0.03  # [m] (HOOD)
    world_edges: int = 1  # of a vertex, at most


class Topology(TypedDict, total=False):
    """Entries of a graph's `globals`."""

    reverse_edges: Int[Array, " edges"]  # index of the opposite mesh edge
    incoming_edges: Int[Array, "vertices degree"]  # mesh edges that enter a vertex, padded with their number
    coarse: tuple[CoarseEdges, ...]  # coarse levels, finest first; hierarchical networks
    edge_length: Float[Array, ""]  # mean rest edge length [m]; features "gradient"
    garment_type: Int[Array, " vertices"]  # HOOD's vertex type; features "hood"
    body_type: Int[Array, " world_edges"]  # the same of the body rows
    world_mask: Bool[Array, " world_edges"]  # that are within reach


def build_graph(
    garment: Garment, material: Material, inputs: GraphInputs, kind: GraphKind
) -> jraph.GraphsTuple:
    """Return the graph of a frame, or of one refinement step; `kind` is static.

    Raises:
        ConfigError: The network is hierarchical and the garment has no coarse levels.
    """
    graph = build_frame_graph(garment, material, inputs, kind)
    if not kind.reads_gradient:
        return graph
    return join_features(graph, build_refinement_graph(garment, material, inputs, graph))


def build_frame_graph(
    garment: Garment, material: Material, inputs: GraphInputs, kind: GraphKind
) -> jraph.GraphsTuple:
    """Return the graph with the features that stay for a whole frame: all of HOOD's. `kind` is static."""
    is_hood = not kind.reads_gradient

    def hood_edges(level: Garment | CoarseEdges) -> Array:
        rows = features.hood_edge_features(garment, material, inputs, level)
        state = [features.state_edge_features(garment, inputs, level)] if kind.reads_state else []
        return jnp.concatenate([*state, rows], axis=1)  # columns that are not normalised stay last

    topology: Topology = {
        "reverse_edges": garment.reverse_edges,
        "incoming_edges": incoming_edges(garment.neighbor_mask, garment.receivers.shape[0]),
    }
    senders, receivers = {"mesh": garment.senders}, {"mesh": garment.receivers}
    if is_hood:
        topology["garment_type"] = jnp.where(garment.is_pinned, features.TYPE_PINNED, features.TYPE_GARMENT)
        nodes = {"garment": features.hood_garment_features(garment, material, inputs)}
        edges = {"mesh": hood_edges(garment)}
    else:
        spacing = topology["edge_length"] = features.mean_edge_length(garment, garment)
        nodes = {"garment": features.frame_node_features(garment, material, inputs, spacing)}
        edges = {"mesh": features.frame_mesh_features(garment, inputs.position, garment, spacing)}
    if kind.has_coarse_edges:
        if garment.coarse is None:
            raise ConfigError(
                "the network is hierarchical and the garment has no coarse levels; add_coarse_edges adds them"
            )
        topology["coarse"] = garment.coarse
        for name, level in zip(COARSE_SETS, garment.coarse, strict=True):
            edges[name] = (
                hood_edges(level)
                if is_hood
                else features.frame_mesh_features(
                    garment, inputs.position, level, features.mean_edge_length(garment, level)
                )
            )
            senders[name], receivers[name] = level.senders, level.receivers
    if inputs.contacts is not None:
        # A contact of thrown cloth is measured on its path; HOOD's edges join what is near now.
        signed, count = inputs.contacts.distances, garment.vertex_mask.shape[0]
        away = jnp.abs(signed)
        if kind.reads_state:  # a vertex deep in the body needs its edge to the surface most
            away = jnp.concatenate([signed[:count], away[count:]])
        elif is_hood:
            position = features.per_world_edge(inputs.position, inputs.contacts)
            away = safe_norm(inputs.contacts.points - position)
        mask = (away <= kind.world_edge_radius) & jnp.tile(garment.vertex_mask, kind.world_edges)
        topology["world_mask"] = mask
        contacts, velocity = inputs.contacts, required(inputs, "body_velocity")
        if is_hood:
            topology["body_type"] = jnp.full(mask.shape, features.TYPE_BODY)
            body = features.hood_body_features(velocity, contacts.normals, inputs.timestep)
            world = features.hood_world_features(contacts, inputs)
            if kind.reads_state:
                world = jnp.concatenate([world, features.state_world_features(contacts, inputs)], axis=1)
        else:
            inertial_guess = required(inputs, "inertial_guess")
            body = features.frame_body_features(velocity, contacts, inputs.timestep)
            world = features.frame_world_features(inputs.position, contacts, inertial_guess)
        nodes["body"], edges["world"] = _mask_rows(body, mask), _mask_rows(world, mask)
        senders["world"] = jnp.arange(mask.shape[0])
        receivers["world"] = senders["world"] % count
        if kind.has_reverse_edges:
            edges["world_reverse"] = features.reverse_world_features(edges["world"])
            senders["world_reverse"], receivers["world_reverse"] = receivers["world"], senders["world"]
    return jraph.GraphsTuple(
        nodes=nodes,
        edges=edges,
        senders=senders,
        receivers=receivers,
        globals=topology,
        n_node=jnp.array([garment.vertex_mask.shape[0]]),
        n_edge={name: jnp.array([rows.shape[0]]) for name, rows in edges.items()},
    )


def edge_set(graph: jraph.GraphsTuple, name: str) -> jraph.GraphsTuple:
    """Return one set of edges as a graph for jraph's own functions: `jraph.batch`, `jraph.unbatch` and others.

    Args:
        graph: Of `build_graph`, `build_frame_graph` or `build_refinement_graph`.
        name: Set of edges, such as "mesh". Its senders and receivers are rows of the nodes that it joins.
    """
    return graph._replace(
        edges=graph.edges[name],
        senders=graph.senders[name],
        receivers=graph.receivers[name],
        n_edge=graph.n_edge[name],
        globals=None,
    )


def build_refinement_graph(
    garment: Garment, material: Material, inputs: GraphInputs, frame_graph: jraph.GraphsTuple
) -> jraph.GraphsTuple:
    """Return the features that change with every refinement step, on the topology of `frame_graph`.

    Raises:
        ValueError: A field of `inputs` that these features need is None.
    """
    spacing = frame_graph.globals["edge_length"]
    guess = required(inputs, "guess")
    nodes = {"garment": features.refinement_node_features(garment, material, inputs, spacing)}
    edges = {"mesh": features.refinement_mesh_features(garment, guess, garment, spacing)}
    coarse = cast(Topology, frame_graph.globals).get("coarse", ())
    for name, level in zip(COARSE_SETS, coarse, strict=False):
        length = features.mean_edge_length(garment, level)
        edges[name] = features.refinement_mesh_features(garment, guess, level, length)
    if inputs.contacts is not None:
        world = features.refinement_world_features(guess, inputs.contacts)
        edges["world"] = _mask_rows(world, frame_graph.globals["world_mask"])
        if "world_reverse" in frame_graph.edges:
            edges["world_reverse"] = edges["world"]  # distances have no direction
    return frame_graph._replace(nodes=nodes, edges=edges)


def join_features(frame_graph: jraph.GraphsTuple, changing: jraph.GraphsTuple) -> jraph.GraphsTuple:
    """Return one graph with the features of a frame and, behind them, those of a refinement step."""

    def join(first: Rows, second: Rows) -> Rows:
        return {
            name: jnp.concatenate([rows, second[name]], axis=1) if name in second else rows
            for name, rows in first.items()
        }

    nodes, edges = join(frame_graph.nodes, changing.nodes), join(frame_graph.edges, changing.edges)
    return frame_graph._replace(nodes=nodes, edges=edges)


def feature_sizes(kind: GraphKind) -> dict[str, int]:
    """Return the number of columns of every kind of row that `build_graph` makes."""
    if not kind.reads_gradient:
        return {
            "garment": features.HOOD_NODE_SIZE,
            "body": features.HOOD_NODE_SIZE,
            "mesh": features.HOOD_MESH_SIZE + kind.reads_state * features.STATE_MESH_SIZE,
            "world": features.HOOD_WORLD_SIZE + kind.reads_state * features.STATE_WORLD_SIZE,
        }
    return {
        "garment": features.NODE_FRAME_SIZE + features.NODE_REFINEMENT_SIZE,
        "body": features.BODY_FRAME_SIZE,
        "mesh": features.MESH_FRAME_SIZE + features.MESH_REFINEMENT_SIZE,
        "world": features.WORLD_FRAME_SIZE + features.WORLD_REFINEMENT_SIZE,
    }


def incoming_edges(
    neighbor_mask: Bool[Array, "vertices degree"], num_edges: int
) -> Int[Array, "vertices degree"]:
    """Return the mesh edges that enter every vertex; they are consecutive, as edges are sorted by receiver.

    Real neighbours come first in `neighbor_mask`. The table is padded with `num_edges`.
    """
    degrees = jnp.sum(neighbor_mask, axis=1, dtype=jnp.int32)
    first = jnp.cumsum(degrees) - degrees
    edges = first[:, None] + jnp.arange(neighbor_mask.shape[1], dtype=jnp.int32)[None]
    return jnp.where(neighbor_mask, edges, num_edges)


def _mask_rows(
    rows: Float[Array, "rows features"], mask: Bool[Array, " rows"]
) -> Float[Array, "rows features"]:
    """Return `rows` with zeros where `mask` is False."""
    return jnp.where(mask[:, None], rows, 0)
