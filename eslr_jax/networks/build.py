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

from typing import NamedTuple, TypedDict

import jax.numpy as jnp
import jraph
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.errors import ConfigError
from eslr_jax.networks import features
from eslr_jax.networks.features import GraphInputs, RefinementInputs
from eslr_jax.networks.operators import to_world_edges
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
    edge_lengths: dict[str, Float[Array, ""]]  # mean at rest of every set [m]; features "gradient"
    garment_type: Int[Array, " vertices"]  # HOOD's vertex type; features "hood"
    body_type: Int[Array, " world_edges"]  # the same of the body rows
    world_mask: Bool[Array, " world_edges"]  # that are within reach


def build_graph(
    garment: Garment, material: Material, inputs: GraphInputs, kind: GraphKind
) -> jraph.GraphsTuple:
    """Return the graph of a frame, or of one refinement step; `kind` is static. See `build_frame_graph`."""
    graph = build_frame_graph(garment, material, inputs, kind)
    if not isinstance(inputs, RefinementInputs) or not kind.reads_gradient:
        return graph
    return join_features(graph, build_refinement_graph(garment, material, inputs, graph))


def build_frame_graph(
    garment: Garment, material: Material, inputs: GraphInputs, kind: GraphKind
) -> jraph.GraphsTuple:
    """Return the graph with the features that stay for a whole frame: all of HOOD's. `kind` is static.

    Raises:
        ConfigError: The network is hierarchical and the garment has no coarse levels.
    """
    levels: dict[str, Garment | CoarseEdges] = {"mesh": garment}
    topology: Topology = {
        "reverse_edges": garment.reverse_edges,
        "incoming_edges": incoming_edges(garment.neighbor_mask, garment.receivers.shape[0]),
    }
    if kind.has_coarse_edges:
        if garment.coarse is None:
            raise ConfigError(
                "the network is hierarchical and the garment has no coarse levels; add_coarse_edges adds them"
            )
        topology["coarse"] = garment.coarse
        levels |= dict(zip(COARSE_SETS, garment.coarse, strict=True))
    if kind.reads_gradient:
        lengths = {name: features.mean_edge_length(garment, level) for name, level in levels.items()}
        topology["edge_lengths"] = lengths
        nodes = {"garment": features.frame_node_features(garment, material, inputs, lengths["mesh"])}
        edges = {
            name: features.frame_mesh_features(garment, inputs.position, level, lengths[name])
            for name, level in levels.items()
        }
    else:
        topology["garment_type"] = jnp.where(garment.is_pinned, features.TYPE_PINNED, features.TYPE_GARMENT)
        nodes = {"garment": features.hood_garment_features(garment, material, inputs)}
        edges = {
            name: features.hood_edge_features(garment, material, inputs, level, reads_state=kind.reads_state)
            for name, level in levels.items()
        }
    senders = {name: level.senders for name, level in levels.items()}
    receivers = {name: level.receivers for name, level in levels.items()}
    if (contacts := inputs.contacts) is not None:
        signed, count = contacts.distances, garment.vertex_mask.shape[0]
        if kind.reads_gradient:
            away = jnp.abs(signed)
        elif kind.reads_state:  # a vertex deep in the body needs its edge to the surface most
            away = jnp.abs(signed).at[:count].set(signed[:count])
        else:  # a contact of thrown cloth is measured on its path; HOOD's edges join what is near now
            away = safe_norm(contacts.points - to_world_edges(inputs.position, signed.shape[0]))
        mask = (away <= kind.world_edge_radius) & jnp.tile(garment.vertex_mask, kind.world_edges)
        topology["world_mask"] = mask
        if kind.reads_gradient:
            body = features.frame_body_features(contacts, inputs.timestep)
            world = features.frame_world_features(contacts, inputs)
        else:
            topology["body_type"] = jnp.full(mask.shape, features.TYPE_BODY)
            body = features.hood_body_features(contacts, inputs.timestep)
            world = features.hood_world_features(contacts, inputs, reads_state=kind.reads_state)
        nodes["body"], edges["world"] = (jnp.where(mask[:, None], rows, 0) for rows in (body, world))
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

    Its senders and receivers are rows of the nodes that it joins.
    """
    return graph._replace(
        edges=graph.edges[name],
        senders=graph.senders[name],
        receivers=graph.receivers[name],
        n_edge=graph.n_edge[name],
        globals=None,
    )


def build_refinement_graph(
    garment: Garment, material: Material, inputs: RefinementInputs, frame_graph: jraph.GraphsTuple
) -> jraph.GraphsTuple:
    """Return the features that change with every refinement step, on the topology of `frame_graph`."""
    lengths = frame_graph.globals["edge_lengths"]
    nodes = {"garment": features.refinement_node_features(garment, material, inputs, lengths["mesh"])}
    levels = zip(lengths.items(), (garment, *(garment.coarse or ())), strict=False)
    edges = {
        name: features.refinement_mesh_features(garment, inputs.guess, level, length)
        for (name, length), level in levels
    }
    if inputs.contacts is not None:
        world = features.refinement_world_features(inputs.guess, inputs.contacts)
        edges["world"] = jnp.where(frame_graph.globals["world_mask"][:, None], world, 0)
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


def normalizer_of(name: str) -> str:
    """Return the name of the normaliser of a graph's kind of node or edge (HOOD)."""
    if name in ("garment", "body"):
        return "garment"
    return "world" if name.startswith("world") else "mesh"


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
