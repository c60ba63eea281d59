"""Laplacian-smoothed dual message passing.

Symbols of the paper: v (`garment`, `body`), e^m (`mesh`), e^w (`world`, and `world_reverse` from garment to
body), f_e (`mesh_mlp`, `world_mlp`), f_v (`vertex_mlp`), f'_v (`smooth_mlp`), N(i) neighbours of vertex i.

What the paper leaves open follows MeshGraphNet and HOOD, by options of `ModelConfig`. One default differs:
HOOD updates its body vertices, through which garment vertices near the same one hear of each other. Here
every world edge ends at its own nearest point on the body, a row with that one edge, which could only hand a
vertex its own message back; so body rows keep their encoding, and a layer costs a quarter less. `update_body`
restores HOOD's way. The number of weights is the same, the two directions share f_e and both ends share f_v.

Source: paper, eqs. 1-4.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.config import ModelConfig
from eslr_jax.graph.operators import (
    MeshTables,
    WorldTables,
    from_world,
    sum_neighbors,
    sum_receivers,
    take_receivers,
    take_senders,
    to_world,
)
from eslr_jax.models.mlp import MLP


class Latents(NamedTuple):
    """What passes from layer to layer; None where a scene has no body, or its rows are not updated."""

    garment: Float[Array, "vertices latent"]
    mesh: Float[Array, "edges latent"]
    mesh_sum: Float[Array, "vertices latent"]  # of `mesh` over the edges that enter a vertex
    body: Float[Array, "world_edges latent"] | None = None
    world: Float[Array, "world_edges latent"] | None = None  # body to garment
    world_reverse: Float[Array, "world_edges latent"] | None = None  # garment to body


class LsdmpLayer(nn.Module):
    """One layer: message passing (eqs. 1, 2), then Laplacian smoothing (eqs. 3, 4)."""

    config: ModelConfig

    def setup(self) -> None:
        """Declare the four perceptrons."""
        self.mesh_mlp = make_mlp(self.config, 3)
        self.world_mlp = make_mlp(self.config, 3)
        self.vertex_mlp = make_mlp(self.config, 3)
        if self.config.smoothing_steps:
            self.smooth_mlp = make_mlp(self.config, 1)

    def __call__(self, latents: Latents, tables: tuple[MeshTables, WorldTables | None]):
        """Return the next latents, in the form that `nn.scan` asks for."""
        latents = self.pass_messages(latents, *tables)
        if self.config.smoothing_steps:
            latents = self.smooth(latents, *tables)
        return latents, None

    def pass_messages(self, latents: Latents, mesh: MeshTables, world: WorldTables | None) -> Latents:
        """Update edges from both ends, then vertices from the sums over their edges.

        e_ij = f_e(e_ij, v_i, v_j) and v_i = f_v(v_i, sum_j e_ij^m, sum_j e_ij^w); with `residual` both are
        increments. Concatenations are never formed: every piece meets its own rows of the first kernel, the
        vertices before they are gathered by the edges.

        Source: paper, eqs. 1 and 2.
        """
        size, is_residual = self.config.latent_size, self.config.residual
        garment, body = latents.garment, latents.body
        edge = self.mesh_mlp
        ends = take_receivers(edge.start(garment, 0, bias=True), mesh) + take_senders(
            edge.start(garment, size), mesh
        )  # summed first: one kernel gathers both
        mesh_step = edge.finish(edge.start(latents.mesh, 2 * size) + ends)
        mesh_sum = sum_receivers(mesh_step, mesh)
        vertex = self.vertex_mlp
        hidden = vertex.start(garment, 0, bias=True) + vertex.start(mesh_sum, size)
        step = Latents(garment=garment, mesh=mesh_step, mesh_sum=mesh_sum, body=body)
        if world is not None:
            edge, here = self.world_mlp, to_world(garment, world)
            to_garment = edge.start(here, 0) + edge.start(body, size)
            step = step._replace(
                world=edge.finish(to_garment + edge.start(latents.world, 2 * size, bias=True))
            )
            hidden = hidden + from_world(vertex.start(step.world, 2 * size), world)
            if self.config.update_body:
                to_body = edge.start(body, 0) + edge.start(here, size)
                step = step._replace(
                    world_reverse=edge.finish(
                        to_body + edge.start(latents.world_reverse, 2 * size, bias=True)
                    )
                )
                at_body = vertex.start(body, 0, bias=True) + vertex.start(step.world_reverse, 2 * size)
                step = step._replace(body=vertex.finish(at_body))
        step = step._replace(garment=vertex.finish(hidden))
        if not is_residual:
            return step
        keeps_body = world is not None and not self.config.update_body
        return Latents(
            *(
                old if new is None or (keeps_body and name == "body") else old + new
                for name, old, new in zip(Latents._fields, latents, step, strict=True)
            )
        )

    def smooth(self, latents: Latents, mesh: MeshTables, world: WorldTables | None) -> Latents:
        """Average over neighbours and their edges a few times, then update the vertices.

        Source: paper, eqs. 3 and 4.
        """
        garment, body = propagate(latents, mesh, world, self.config)
        garment = self.smooth_mlp(garment)
        updates_body = world is not None and self.config.update_body
        body = self.smooth_mlp(body) if updates_body else latents.body
        if self.config.residual:
            garment = latents.garment + garment
            body = latents.body + body if updates_body else body
        return latents._replace(garment=garment, body=body)


def make_mlp(config: ModelConfig, num_pieces: int) -> MLP:
    """Return a perceptron from a few concatenated latents to one."""
    size = config.latent_size
    return MLP(num_pieces * size, size, size, config.hidden_layers, precision=config.precision)


def propagate(
    latents: Latents, mesh: MeshTables, world: WorldTables | None, config: ModelConfig
) -> tuple[Float[Array, "vertices latent"], Float[Array, "world_edges latent"] | None]:
    """Smooth vertex latents: p_i = 1 / |N(i)| sum_(j in N(i)) (p_j + e_ij), `smoothing_steps` times.

    The mean of e_ij does not change between the steps and is taken once. A vertex without neighbours keeps
    its latent. A body row has one neighbour, the garment vertex at the other end of its world edge.

    Returns:
        Smoothed latents of the garment's vertices, and of the body rows where they are updated.

    Source: paper, eq. 3.
    """
    garment, body = latents.garment, latents.body
    uses_world = world is not None and config.smooth_world_edges
    moves_body = world is not None and config.update_body
    degree, edge_sum = mesh.degree, latents.mesh_sum
    if uses_world:
        degree = degree + world.vertex_mask
        arriving = latents.world if moves_body else latents.world + body
        edge_sum = edge_sum + from_world(arriving, world)
    inverse = jnp.where(degree > 0, 1 / jnp.maximum(degree, 1), 0)
    edge_mean = edge_sum * inverse
    fixed_body = None if moves_body or not uses_world else from_world(body, world) * inverse
    for step in range(config.smoothing_steps):
        adds_edges = config.readd_edges or step == 0
        total = sum_neighbors(garment, mesh)
        if uses_world and moves_body:
            total = total + from_world(body, world)
        smoothed = total * inverse
        if adds_edges:
            smoothed = smoothed + edge_mean
        elif fixed_body is not None:
            smoothed = smoothed + fixed_body
        if moves_body:
            body = to_world(garment, world)
            body = body + latents.world_reverse if adds_edges else body
        garment = smoothed
    return jnp.where(degree > 0, garment, latents.garment), body
