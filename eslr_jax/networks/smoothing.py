"""A network that smooths vertex latents and sends no messages: the cheapest refinement step.

It keeps Laplacian smoothing of LSDMP and leaves out the edges, whose perceptrons take three quarters of the
time (six edges to a vertex). With the potential's gradient as an input, a vertex knows what its springs,
hinges and contacts want. The features of a vertex's world edge and of its body point join its own.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Float

from eslr_jax.networks import features
from eslr_jax.networks.apply import Places
from eslr_jax.networks.architecture import make_decoder, stack, world_mask
from eslr_jax.networks.build import feature_sizes
from eslr_jax.networks.eslr import GraphModule
from eslr_jax.networks.lsdmp import LayerTables, make_mlp
from eslr_jax.networks.network import Statistics, network
from eslr_jax.networks.operators import MeshTables, mesh_tables, sum_neighbors
from eslr_jax.networks.refinement import GatedRefinement


class SmoothingLayer(nn.Module):
    """v_i += f_v(v_i, p_i^1, ..., p_i^K), where p^k is the mean of p^(k-1) over the neighbours and p^0 is v.

    Source: paper, eq. 3 without its edges; all K smoothings are read, not the last alone.
    """

    config: Smoothing

    def setup(self) -> None:
        """Declare the perceptron."""
        self.vertex_mlp = make_mlp(self.config, (1 + self.config.smoothing_steps) * self.config.latent_size)

    def __call__(self, latents: Float[Array, "vertices latent"], tables: MeshTables):
        """Return the next latents, in the form that `nn.scan` asks for."""
        inverse = jnp.where(tables.degree > 0, 1 / jnp.maximum(tables.degree, 1), 0)
        hidden, smoothed = self.vertex_mlp.start(latents, 0, bias=True), latents
        for step in range(1, self.config.smoothing_steps + 1):
            smoothed = sum_neighbors(smoothed, tables) * inverse
            hidden = hidden + self.vertex_mlp.start(smoothed, step * self.config.latent_size)
        return latents + self.vertex_mlp.finish(hidden), None


class SmoothingNetwork(GraphModule):
    """The whole network."""

    config: Smoothing

    def setup(self) -> None:
        """Declare encoder, stacks and decoder."""
        config, sizes = self.config, feature_sizes(self.config.graph)
        self.body_column = sizes["garment"]  # of the encoder's input
        self.world_column = sizes["garment"] + sizes["body"]
        self.encoder = make_mlp(config, self.world_column + sizes["world"])
        self.layers = stack(SmoothingLayer, config, config.layers)
        self.decoder = make_decoder(config)

    def encode(self, graph: jraph.GraphsTuple, statistics: Statistics) -> tuple[Array, LayerTables]:
        """Return the encoder's first layer, for a whole graph or for the features that stay for a frame."""
        nodes = graph.nodes["garment"]
        hidden, mask = self.encoder.start(nodes, 0, bias=True), world_mask(graph, nodes.dtype)
        if "world" in graph.edges:
            rows = self.encoder.start(graph.nodes["body"], self.body_column)
            rows = rows + self.encoder.start(graph.edges["world"], self.world_column)
            hidden = hidden + rows * mask
        return hidden, LayerTables({"mesh": mesh_tables(graph, nodes.dtype)}, mask)

    def process(
        self,
        encoded: tuple[Array, LayerTables],
        places: Places,
        changing: jraph.GraphsTuple | None = None,
    ) -> Float[Array, "vertices outputs"]:
        """Finish the encoder, run the layers and decode."""
        hidden, tables = encoded
        if changing is not None:
            hidden = hidden + self.encoder.start(changing.nodes["garment"], features.NODE_FRAME_SIZE)
            if "world" in changing.edges:
                column = self.world_column + features.WORLD_FRAME_SIZE
                hidden = hidden + self.encoder.start(changing.edges["world"], column) * tables.world_mask
        vertices = self.encoder.finish(hidden)
        processed, _ = self.layers(vertices, tables.edges["mesh"])
        return self.decoder(processed)


@network("smoothing")
@dataclasses.dataclass(frozen=True)
class Smoothing(GatedRefinement):
    """Smoothings without messages; by default one step as the solver's initial guess.

    That costs three to four iterations and saves more.
    """

    module_class = SmoothingNetwork
    latent_size: int = 32  # a quarter of the paper's
    remat: Literal["layers", "products", "none"] = "none"  # what a backward pass computes again
    layers: int = 1  # each a perceptron behind the smoothings
    smoothing_steps: int = 2  # per layer
    output: Literal["descent", "subspace"] = "descent"  # sum or best combination of a step's directions
    refinement_steps: int = 1  # per frame, gradient recomputed between
