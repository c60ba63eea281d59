"""Laplacian-smoothed dual message passing.

Symbols of the paper: v (`garment`, `body`), e^m (`mesh`), e^w (`edges` from body to garment, `reverse` from
garment to body), f_e (`mesh_mlp`, `world_mlp`), f_v (`vertex_mlp`), f'_v (`smooth_mlp`), N(i) neighbours of
vertex i.

The paper leaves open what follows; the choices are those of MeshGraphNet and HOOD. f_e, f_v and f'_v give
increments, for edges and vertices alike. N(i) of eq. 3 includes the body point of i's world edge, and every
smoothing adds e_ij again. One default differs from HOOD. HOOD updates its body vertices, and garment vertices
near the same body vertex exchange messages through it. Here every world edge has a body row of its own, which
could only return its garment vertex's own message. So body rows keep their encoding, and a layer costs a
quarter less. `Eslr.update_body` restores HOOD's update, with the same number of weights: both directions
share f_e, garment and body share f_v and f'_v.

Source: paper, eqs. 1-4.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.networks.architecture import Architecture, TwoBranches
from eslr_jax.networks.dense import MLP
from eslr_jax.networks.operators import (
    MeshTables,
    sum_neighbors,
    sum_receivers,
    take_receivers,
    take_senders,
)


class WorldLatents(NamedTuple):
    """Latents around the body. Row w belongs to garment vertex w, modulo the vertices."""

    body: Float[Array, "world_edges latent"]
    edges: Float[Array, "world_edges latent"]  # from body to garment
    reverse: (
        Float[Array, "world_edges latent"] | None
    )  # from garment to body; None where body rows are constant


class Latents(NamedTuple):
    """What passes from layer to layer."""

    garment: Float[Array, "vertices latent"]
    mesh: Float[Array, "edges latent"]
    mesh_sum: Float[Array, "vertices latent"]  # of `mesh` over the edges that enter a vertex
    world: WorldLatents | None = None  # None in a scene without a body


class LayerTables(NamedTuple):
    """What is the same in every layer."""

    mesh: MeshTables
    world_mask: Float[Array, "world_edges 1"]  # one within reach; zeros without a body


class LsdmpLayer(nn.Module):
    """One layer: message passing (eqs. 1, 2), then Laplacian smoothing (eqs. 3, 4)."""

    config: TwoBranches

    def setup(self) -> None:
        """Declare the perceptrons."""
        size = self.config.latent_size
        self.mesh_mlp = make_mlp(self.config, 3 * size)
        self.world_mlp = make_mlp(self.config, 3 * size)
        self.vertex_mlp = make_mlp(self.config, 3 * size)
        if self.config.smoothing_steps:
            self.smooth_mlp = make_mlp(self.config, size)

    def __call__(self, latents: Latents, tables: LayerTables):
        """Return the next latents, in the form that `nn.scan` asks for."""
        latents = self.pass_messages(latents, tables)
        if self.config.smoothing_steps:
            latents = self.smooth(latents, tables)
        return latents, None

    def pass_messages(self, latents: Latents, tables: LayerTables) -> Latents:
        """Update edges from both ends, then vertices from the sums over their edges.

        e_ij += f_e(v_i, v_j, e_ij) and v_i += f_v(v_i, sum_j f_e^m, sum_j f_e^w). No concatenation is
        formed: every piece is multiplied by its own rows of the first kernel, vertices before the edges
        gather them.

        Source: paper, eqs. 1 and 2.
        """
        size, garment, world = self.config.latent_size, latents.garment, latents.world
        edge, vertex = self.mesh_mlp, self.vertex_mlp
        ends = take_receivers(edge.start(garment, 0, bias=True), tables.mesh) + take_senders(
            edge.start(garment, size), tables.mesh
        )  # summed first: one kernel gathers both
        messages = edge.finish(edge.start(latents.mesh, 2 * size) + ends)
        message_sum = sum_receivers(messages, tables.mesh)
        hidden = vertex.start(garment, 0, bias=True) + vertex.start(message_sum, size)
        if world is not None:
            edge = self.world_mlp
            ends = to_world_edges(edge.start(garment, 0), world) + edge.start(world.body, size)
            to_garment = edge.finish(ends + edge.start(world.edges, 2 * size, bias=True))
            hidden = hidden + sum_world_edges(vertex.start(to_garment, 2 * size) * tables.world_mask, garment)
            world = self._pass_to_body(garment, world)._replace(edges=world.edges + to_garment)
        return Latents(
            garment + vertex.finish(hidden), latents.mesh + messages, latents.mesh_sum + message_sum, world
        )

    def _pass_to_body(self, garment: Float[Array, "vertices latent"], world: WorldLatents) -> WorldLatents:
        """Update reverse world edges and body rows, unless these are constant."""
        if world.reverse is None:
            return world
        size, edge, vertex = self.config.latent_size, self.world_mlp, self.vertex_mlp
        ends = edge.start(world.body, 0) + to_world_edges(edge.start(garment, size), world)
        messages = edge.finish(ends + edge.start(world.reverse, 2 * size, bias=True))
        hidden = vertex.start(world.body, 0, bias=True) + vertex.start(messages, 2 * size)
        return world._replace(body=world.body + vertex.finish(hidden), reverse=world.reverse + messages)

    def smooth(self, latents: Latents, tables: LayerTables) -> Latents:
        """Average over neighbours and their edges a few times, then update the vertices.

        Source: paper, eqs. 3 and 4.
        """
        garment, body = propagate(latents, tables, self.config.smoothing_steps)
        world = latents.world
        if world is not None and body is not None:
            world = world._replace(body=world.body + self.smooth_mlp(body))
        return latents._replace(garment=latents.garment + self.smooth_mlp(garment), world=world)


def make_mlp(config: Architecture, input_size: int) -> MLP:
    """Return a perceptron from features or concatenated latents to a latent."""
    size = config.latent_size
    return MLP(input_size, size, size, config.hidden_layers, precision=config.precision)


def to_world_edges(
    rows: Float[Array, "vertices features"], world: WorldLatents
) -> Float[Array, "world_edges features"]:
    """Return the row of every world edge's vertex."""
    return jnp.tile(rows, (world.body.shape[0] // rows.shape[0], 1))


def sum_world_edges(
    rows: Float[Array, "world_edges features"], garment: Float[Array, "vertices latent"]
) -> Float[Array, "vertices features"]:
    """Sum over the world edges of every vertex of the garment."""
    return jnp.sum(rows.reshape(-1, garment.shape[0], rows.shape[1]), axis=0)


def propagate(
    latents: Latents, tables: LayerTables, num_steps: int
) -> tuple[Float[Array, "vertices latent"], Float[Array, "world_edges latent"] | None]:
    """Smooth vertex latents: p_i = 1 / |N(i)| sum_(j in N(i)) (p_j + e_ij), `num_steps` times.

    The mean of e_ij is the same in every step and computed once. A vertex without neighbours keeps its latent. A
    body row has one neighbour, the garment vertex at the other end of its world edge.

    Returns:
        Smoothed latents of the garment, and of the body rows; None for these where they are constant.

    Source: paper, eq. 3.
    """
    garment, world = latents.garment, latents.world
    degree, edge_sum = tables.mesh.degree, latents.mesh_sum
    if world is not None:
        degree = degree + sum_world_edges(tables.world_mask, garment)
        arriving = world.edges + world.body if world.reverse is None else world.edges
        edge_sum = edge_sum + sum_world_edges(arriving * tables.world_mask, garment)
    inverse = jnp.where(degree > 0, 1 / jnp.maximum(degree, 1), 0)
    edge_mean = edge_sum * inverse
    body = None
    if world is None or world.reverse is None:
        for _ in range(num_steps):
            garment = sum_neighbors(garment, tables.mesh) * inverse + edge_mean
    else:
        body = world.body
        for _ in range(num_steps):
            total = sum_neighbors(garment, tables.mesh) + sum_world_edges(body * tables.world_mask, garment)
            body = to_world_edges(garment, world) + world.reverse
            garment = total * inverse + edge_mean
    return jnp.where(degree > 0, garment, latents.garment), body
