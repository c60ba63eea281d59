"""A garment's state as a graph: mesh edges, and world edges to the nearest body points.

Rows of the graph, as `jraph.GraphsTuple` with dictionaries:

- nodes "garment" [V, features] and "body" [W, features]; edges "mesh" [E, features] and "world" [W,
  features], the latter from body to garment, and "world_reverse" [W, features] where body rows are updated.
- Body row w is the nearest body point of the garment vertex at the other end of world edge w, so both come in
  pairs. W is the number of vertices, or `ModelConfig.world_edge_capacity`; rows beyond the edges in use are
  masked. Without a body there are no "body" and "world" entries at all.
- globals hold what the model needs beside the features: `Topology` names the entries.
"""

from __future__ import annotations

from typing import TypedDict

import jax
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.config import ModelConfig
from eslr_jax.graph import features
from eslr_jax.graph.inputs import GraphInputs
from eslr_jax.types import Contacts, Garment, Material


class Topology(TypedDict, total=False):
    """Entries of a graph's `globals`."""

    status: Int[Array, ""]  # errors.Status bits
    edge_length: Float[Array, ""]  # mean rest edge length [m]
    garment_type: Int[Array, " vertices"]  # HOOD's vertex type
    body_type: Int[Array, " world_edges"]
    world_mask: Bool[Array, " world_edges"]
    world_slot: Int[Array, " vertices"]  # world edge of a vertex, or the number of world rows


def build_graph(
    garment: Garment, material: Material, inputs: GraphInputs, config: ModelConfig
) -> jraph.GraphsTuple:
    """Build the graph of one frame, or of one pass.

    Args:
        garment: Rest mesh and topology.
        material: Fabric.
        inputs: State of garment and body.
        config: Decides which features, which radius and which capacity; static.

    Returns:
        The graph; its `globals["status"]` holds `Status.WORLD_EDGE_OVERFLOW` where edges were left out.
    """
    graph = build_frame_graph(garment, material, inputs, config)
    if config.features == "hood":
        return graph
    return join_features(graph, build_refinement_graph(garment, material, inputs, graph))


def build_frame_graph(
    garment: Garment, material: Material, inputs: GraphInputs, config: ModelConfig
) -> jraph.GraphsTuple:
    """Build what stays the same in every pass over a frame; with HOOD's features that is everything."""
    is_hood = config.features == "hood"
    globals_: Topology = {"status": jnp.zeros((), jnp.int32)}
    if is_hood:
        garment_type = jnp.where(garment.is_pinned, features.TYPE_PINNED, features.TYPE_GARMENT)
        globals_["garment_type"] = garment_type
        nodes = {
            "garment": features.hood_garment_features(
                garment, material, inputs.position, inputs.velocity, inputs.timestep
            )
        }
        edges = {"mesh": features.hood_mesh_features(garment, material, inputs.position, inputs.timestep)}
    else:
        edge_length = features.mean_edge_length(garment)
        globals_["edge_length"] = edge_length
        nodes = {
            "garment": features.frame_node_features(
                garment, material, inputs.position, inputs.velocity, inputs.timestep, edge_length
            )
        }
        edges = {"mesh": features.frame_mesh_features(garment, inputs.position, edge_length)}
    senders, receivers = {"mesh": garment.senders}, {"mesh": garment.receivers}
    if inputs.contacts is not None:
        selected, slot, mask, overflow = select_world_edges(inputs.contacts, garment.vertex_mask, config)
        globals_["world_mask"], globals_["world_slot"] = mask, slot
        globals_["status"] = jnp.where(overflow, 2, 0)
        body, world = _world_rows(inputs, selected, is_hood)
        nodes["body"] = _mask_rows(body, mask)
        edges["world"] = _mask_rows(world, mask)
        senders["world"] = jnp.arange(mask.shape[0])
        receivers["world"] = jnp.arange(mask.shape[0]) if selected is None else selected
        if is_hood:
            globals_["body_type"] = jnp.full(mask.shape, features.TYPE_BODY)
        if config.update_body:
            signs = reverse_signs(is_hood, world.dtype)
            edges["world_reverse"] = edges["world"] * signs[None]
            senders["world_reverse"], receivers["world_reverse"] = receivers["world"], senders["world"]
    return jraph.GraphsTuple(
        nodes=nodes,
        edges=edges,
        senders=senders,
        receivers=receivers,
        globals=globals_,
        n_node={name: jnp.array([rows.shape[0]]) for name, rows in nodes.items()},
        n_edge={name: jnp.array([rows.shape[0]]) for name, rows in edges.items()},
    )


def build_refinement_graph(
    garment: Garment, material: Material, inputs: GraphInputs, frame: jraph.GraphsTuple
) -> jraph.GraphsTuple:
    """Build the features that change from pass to pass, over the topology of `frame`.

    Raises:
        ValueError: A field of `inputs` that gradient features need is missing.
    """
    for name in ("guess", "inertial_guess", "gradient", "step", "weight"):
        if getattr(inputs, name) is None:
            raise ValueError(f'GraphInputs.{name} is required by features = "gradient"')
    edge_length = frame.globals["edge_length"]
    nodes = {
        "garment": features.refinement_node_features(
            garment,
            material,
            inputs.guess,
            inputs.inertial_guess,
            inputs.gradient,
            inputs.step,
            inputs.weight,
            edge_length,
            inputs.correction,
            inputs.previous_gradient,
        )
    }
    edges = {"mesh": features.refinement_mesh_features(garment, inputs.guess, edge_length)}
    if "world" in frame.edges:
        selected = _selection(frame)
        contacts = _take_contacts(inputs.contacts, selected)
        world = features.refinement_world_features(_take(inputs.guess, selected), contacts)
        edges["world"] = _mask_rows(world, frame.globals["world_mask"])
        if "world_reverse" in frame.edges:
            edges["world_reverse"] = edges["world"]  # distances have no direction
    return frame._replace(nodes=nodes, edges=edges)


def join_features(frame: jraph.GraphsTuple, changing: jraph.GraphsTuple) -> jraph.GraphsTuple:
    """Append the features of a pass to those of its frame."""

    def join(first, second):
        return {
            name: jnp.concatenate([rows, second[name]], axis=1) if name in second else rows
            for name, rows in first.items()
        }

    return frame._replace(nodes=join(frame.nodes, changing.nodes), edges=join(frame.edges, changing.edges))


def feature_sizes(config: ModelConfig) -> dict[str, int]:
    """Return the width of every kind of row that `build_graph` makes."""
    if config.features == "hood":
        return {
            "garment": features.HOOD_NODE_SIZE,
            "body": features.HOOD_NODE_SIZE,
            "mesh": features.HOOD_MESH_SIZE,
            "world": features.HOOD_WORLD_SIZE,
        }
    return {
        "garment": features.NODE_FRAME_SIZE + features.NODE_REFINEMENT_SIZE,
        "body": features.BODY_FRAME_SIZE,
        "mesh": features.MESH_FRAME_SIZE + features.MESH_REFINEMENT_SIZE,
        "world": features.WORLD_FRAME_SIZE + features.WORLD_REFINEMENT_SIZE,
    }


def select_world_edges(
    contacts: Contacts, vertex_mask: Bool[Array, " vertices"], config: ModelConfig
) -> tuple[
    Int[Array, " world_edges"] | None,
    Int[Array, " vertices"],
    Bool[Array, " world_edges"],
    Bool[Array, ""],
]:
    """Choose the vertices that get a world edge: those within `world_edge_radius` of the body.

    Args:
        contacts: Nearest body point of every vertex.
        vertex_mask: Vertices that are not padding.
        config: Holds the radius [m] and the capacity.

    Returns:
        The vertex of every row (None where row w is vertex w), the row of every vertex (the number of rows
        where there is none), which rows are in use, and whether some vertex found no row.
    """
    num_vertices = vertex_mask.shape[0]
    is_close = (jnp.abs(contacts.distances) <= config.world_edge_radius) & vertex_mask
    capacity = config.world_edge_capacity
    if capacity is None or capacity >= num_vertices:
        slot = jnp.where(is_close, jnp.arange(num_vertices), num_vertices)
        return None, slot, is_close, jnp.zeros((), bool)
    order = jnp.cumsum(is_close) - 1
    count = order[-1] + 1
    has_row = is_close & (order < capacity)
    slot = jnp.where(has_row, order, capacity)
    (selected,) = jnp.nonzero(has_row, size=capacity, fill_value=num_vertices - 1)
    return selected, slot, jnp.arange(capacity) < count, count > capacity


def reverse_signs(is_hood: bool, dtype) -> Float[Array, " features"]:
    """Return the factors that turn features of a world edge into those of the opposite direction."""
    signs = features.hood_reverse_signs(dtype)
    if is_hood:
        return signs
    return jnp.concatenate([signs[:8], jnp.ones(features.WORLD_FRAME_SIZE - 8, dtype)])


def _world_rows(
    inputs: GraphInputs, selected: Int[Array, " world_edges"] | None, is_hood: bool
) -> tuple[Float[Array, "world_edges _"], Float[Array, "world_edges _"]]:
    """Return features of body rows and of world edges, unmasked."""
    contacts = _take_contacts(inputs.contacts, selected)
    position, velocity = _take(inputs.position, selected), _take(inputs.body_velocity, selected)
    if is_hood:
        return (
            features.hood_body_features(velocity, contacts.normals, inputs.timestep),
            features.hood_world_features(position, contacts.points, contacts.next_points, inputs.timestep),
        )
    return (
        features.frame_body_features(velocity, contacts, inputs.timestep),
        features.frame_world_features(position, contacts, _take(inputs.inertial_guess, selected)),
    )


def _selection(frame: jraph.GraphsTuple) -> Int[Array, " world_edges"] | None:
    """Return the vertices of the world rows, None where row w is vertex w."""
    is_identity = frame.globals["world_mask"].shape == frame.globals["world_slot"].shape
    return None if is_identity else frame.receivers["world"]


def _take(rows: Array, selected: Int[Array, " world_edges"] | None) -> Array:
    """Return the selected rows, all of them for None."""
    return rows if selected is None else rows[selected]


def _take_contacts(contacts: Contacts, selected: Int[Array, " world_edges"] | None) -> Contacts:
    """Return the contacts of the selected vertices."""
    return jax.tree.map(lambda rows: _take(rows, selected), contacts)


def _mask_rows(
    rows: Float[Array, "rows features"], mask: Bool[Array, " rows"]
) -> Float[Array, "rows features"]:
    """Zero the rows that are not in use."""
    return jnp.where(mask[:, None], rows, 0)
