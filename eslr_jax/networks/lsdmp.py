"""Laplacian-smoothed dual message passing.

Symbols of the paper: v (`garment`, `body`), e^m (`mesh`), e^w (`edges` from body to garment, `reverse` from
garment to body), f_e (`mesh_mlp`, `world_mlp`), f_v (`vertex_mlp`), f'_v (`smooth_mlp`), N(i) neighbours of
vertex i.

The paper leaves open what follows; the choices are those of MeshGraphNet and HOOD. f_e, f_v and f'_v give
increments, for edges and vertices alike. N(i) of eq. 3 includes the body points of i's world edges, and every
smoothing adds e_ij again. One default differs from HOOD. HOOD updates its body vertices, and garment vertices
near the same body vertex exchange messages through it. Here every world edge has a body row of its own, which
could only return its garment vertex's own message. So body rows keep their encoding, and a layer costs a
quarter less. `Eslr.update_body` restores HOOD's update, with the same number of weights: both directions
share f_e, garment and body share f_v and f'_v.

Source: paper, eqs. 1-4.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.networks.architecture import Architecture, TwoBranches
from eslr_jax.networks.build import Rows
from eslr_jax.networks.dense import MLP
from eslr_jax.networks.operators import (
    MeshTables,
    sum_neighbors,
    sum_receivers,
    sum_world_edges,
    take_receivers,
    take_senders,
    to_world_edges,
)


class WorldLatents(NamedTuple):
    """Latents around the body. Row w belongs to garment vertex w, modulo the vertices."""

    body: Float[Array, "world_edges latent"]
    edges: Float[Array, "world_edges latent"]  # from body to garment
    # From garment to body; None where body rows are constant.
    reverse: Float[Array, "world_edges latent"] | None


class Latents(NamedTuple):
    """What passes from layer to layer."""

    garment: Float[Array, "vertices latent"]
    edges: Rows  # by edge set
    world: WorldLatents | None  # None in a scene without a body
    # Of the mesh's edges that enter a vertex; None where nothing is smoothed.
    mesh_sum: Float[Array, "vertices latent"] | None = None


class LayerTables(NamedTuple):
    """What is the same in every layer."""

    edges: dict[str, MeshTables]
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
        latents = pass_messages({"mesh": self.mesh_mlp}, self.world_mlp, self.vertex_mlp, latents, tables)
        if self.config.smoothing_steps:
            latents = self.smooth(latents, tables)
        return latents, None

    def smooth(self, latents: Latents, tables: LayerTables) -> Latents:
        """Average over neighbours and their edges a few times, then update the vertices (paper, eqs. 3 and 4)."""
        garment, body = propagate(latents, tables, self.config.smoothing_steps)
        world = latents.world
        if world is not None and body is not None:
            world = world._replace(body=world.body + self.smooth_mlp(body))
        return latents._replace(garment=latents.garment + self.smooth_mlp(garment), world=world)


def make_mlp(config: Architecture, input_size: int) -> MLP:
    """Return a perceptron from features or concatenated latents to a latent."""
    size = config.latent_size
    return MLP(input_size, size, size, config.hidden_layers, precision=config.precision)


def pass_messages(
    edge_mlps: dict[str, MLP], world_mlp: MLP, vertex_mlp: MLP, latents: Latents, tables: LayerTables
) -> Latents:
    """Update the edges of some sets and world edges from both ends, then vertices from the sums over their edges.

    e_ij += f_e(v_i, v_j, e_ij) and v_i += f_v(v_i, sum_j f_e set by set, sum_j f_e^w). No concatenation is
    formed: every piece is multiplied by its own rows of the first kernel, vertices before the edges gather them.

    Source: paper, eqs. 1 and 2.
    """
    garment, edges, world, mesh_sum = latents
    size = column = garment.shape[1]
    hidden = vertex_mlp.start(garment, 0, bias=True)
    for name, mlp in edge_mlps.items():
        table = tables.edges[name]
        # Summed before they are added to the edges' part: one kernel gathers both.
        ends = take_receivers(mlp.start(garment, 0, bias=True), table) + take_senders(
            mlp.start(garment, size), table
        )
        messages = mlp.finish(mlp.start(edges[name], 2 * size) + ends)
        message_sum = sum_receivers(messages, table)
        hidden = hidden + vertex_mlp.start(message_sum, column)
        edges = {**edges, name: edges[name] + messages}
        if name == "mesh" and mesh_sum is not None:
            mesh_sum = mesh_sum + message_sum
        column += size
    if world is not None:
        mask, mlp = tables.world_mask, world_mlp
        ends = to_world_edges(mlp.start(garment, 0), mask.shape[0]) + mlp.start(world.body, size)
        to_garment = mask * mlp.finish(ends + mlp.start(world.edges, 2 * size, bias=True))
        hidden = hidden + vertex_mlp.start(sum_world_edges(to_garment, garment.shape[0]), column)
        body, reverse = world.body, world.reverse
        if reverse is not None:
            ends = mlp.start(body, 0) + to_world_edges(mlp.start(garment, size), mask.shape[0])
            to_body = mask * mlp.finish(ends + mlp.start(reverse, 2 * size, bias=True))
            at_body = vertex_mlp.start(body, 0, bias=True) + vertex_mlp.start(to_body, column)
            body, reverse = body + vertex_mlp.finish(at_body), reverse + to_body
        world = WorldLatents(body, world.edges + to_garment, reverse)
    return Latents(garment + vertex_mlp.finish(hidden), edges, world, mesh_sum)


def propagate(
    latents: Latents, tables: LayerTables, num_steps: int
) -> tuple[Float[Array, "vertices latent"], Float[Array, "world_edges latent"] | None]:
    """Smooth vertex latents: p_i = 1 / |N(i)| sum_(j in N(i)) (p_j + e_ij), `num_steps` times.

    Returns those of the garment, and those of the body rows, which are None where these are constant. The mean of
    e_ij is the same in every step and computed once. A vertex without neighbours keeps its latent. A body row has
    one neighbour, the garment vertex at the other end of its world edge.

    Source: paper, eq. 3.
    """
    garment, world, mesh, mask = latents.garment, latents.world, tables.edges["mesh"], tables.world_mask
    degree, edge_sum, count = mesh.degree, cast(Array, latents.mesh_sum), garment.shape[0]
    if world is not None:
        degree = degree + sum_world_edges(mask, count)
        arriving = world.edges + world.body if world.reverse is None else world.edges
        edge_sum = edge_sum + sum_world_edges(arriving * mask, count)
    inverse = jnp.where(degree > 0, 1 / jnp.maximum(degree, 1), 0)
    edge_mean = edge_sum * inverse
    body = None
    if world is None or world.reverse is None:
        for _ in range(num_steps):
            garment = sum_neighbors(garment, mesh) * inverse + edge_mean
    else:
        body = world.body
        for _ in range(num_steps):
            total = sum_neighbors(garment, mesh) + sum_world_edges(body * mask, count)
            body = to_world_edges(garment, mask.shape[0]) + world.reverse
            garment = total * inverse + edge_mean
    return jnp.where(degree > 0, garment, latents.garment), body
