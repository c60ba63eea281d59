"""Encode, process, decode: ESLR, and with fewer parts MeshGraphNet.

The encoders' latents go through a stack of LSDMP layers and, beside it, through a stack of GSA blocks; the
decoder reads both. Without smoothing and attention this is MeshGraphNet as HOOD's baselines have it.

Source: paper, section on the simulation pipeline.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import jraph
from jaxtyping import Array, Float, Int

from eslr_jax.graph import features
from eslr_jax.graph.build import feature_sizes
from eslr_jax.graph.normalizer import Normalizer, normalize
from eslr_jax.graph.operators import (
    MeshTables,
    WorldTables,
    mesh_tables,
    sum_receivers,
)
from eslr_jax.models.branches import TwoBranches, graph_world_tables, stack
from eslr_jax.models.dense import kernel_spread
from eslr_jax.models.lsdmp import Latents, LsdmpLayer
from eslr_jax.models.mlp import MLP
from eslr_jax.types import Garment

VELOCITY_COLUMNS = 3  # HOOD puts the type embedding behind them

Statistics = dict[str, Normalizer]


class Encoded(NamedTuple):
    """Hidden layers of the encoders, as far as a frame's constant features decide them."""

    garment: Float[Array, "vertices hidden"]
    mesh: Float[Array, "edges hidden"]
    body: Float[Array, "world_edges latent"] | None  # finished: nothing about the body changes
    world: Float[Array, "world_edges hidden"] | None
    world_reverse: Float[Array, "world_edges hidden"] | None
    mesh_tables: MeshTables
    world_tables: WorldTables | None


class EncodeProcessDecode(TwoBranches):
    """The whole network, from a graph's features to a vector, and gates, per vertex."""

    def setup(self) -> None:
        """Declare encoders, stacks and decoder."""
        config = self.config
        size, sizes = config.latent_size, feature_sizes(config)

        def encoder(input_size: int) -> MLP:
            return MLP(input_size, size, size, config.hidden_layers, precision=config.precision)

        if config.features == "hood":
            self.type_embedding = self.param(
                "type_embedding", kernel_spread(features.NUM_TYPES), (features.NUM_TYPES, features.NUM_TYPES)
            )
            self.garment_encoder = encoder(sizes["garment"] + features.NUM_TYPES)
        else:
            self.garment_encoder = encoder(sizes["garment"])
            self.body_encoder = encoder(sizes["body"])
        self.mesh_encoder = encoder(sizes["mesh"])
        self.world_encoder = encoder(sizes["world"])
        self.layers = stack(LsdmpLayer, config, config.message_passing_steps)
        self.declare_decoder()

    def __call__(
        self, graph: jraph.GraphsTuple, garment: Garment, statistics: Statistics | None = None
    ) -> Float[Array, "vertices outputs"]:
        """Apply the network to a full graph.

        Args:
            graph: Of `build_graph`.
            garment: The same garment; gives the topology, the embedding and the mask.
            statistics: Of the "garment" (and body), "mesh" and "world" features, for HOOD's kind.
        """
        return self.process(self.encode_frame(graph, garment, statistics), garment)

    def encode_frame(
        self, graph: jraph.GraphsTuple, garment: Garment, statistics: Statistics | None = None
    ) -> Encoded:
        """Return the encoders' first layers on a full graph, or on the features that stay for a frame."""
        nodes, edges = self.normalized(graph, statistics)
        is_hood = self.config.features == "hood"
        has_body = "world" in edges
        body = None
        if has_body:
            body = (self.garment_encoder if is_hood else self.body_encoder)(nodes["body"])
        dtype = nodes["garment"].dtype
        return Encoded(
            garment=self.garment_encoder.start(nodes["garment"], 0, bias=True),
            mesh=self.mesh_encoder.start(edges["mesh"], 0, bias=True),
            body=body,
            world=self.world_encoder.start(edges["world"], 0, bias=True) if has_body else None,
            world_reverse=(
                self.world_encoder.start(edges["world_reverse"], 0, bias=True)
                if "world_reverse" in edges
                else None
            ),
            mesh_tables=mesh_tables(garment, dtype),
            world_tables=graph_world_tables(graph, dtype) if has_body else None,
        )

    def encode_refinement(self, encoded: Encoded, changing: jraph.GraphsTuple) -> Encoded:
        """Add the features of a pass to those of its frame.

        Args:
            encoded: Of `encode_frame` on the frame's features.
            changing: Of `build_refinement_graph`.
        """
        nodes, edges = changing.nodes, changing.edges
        encoded = encoded._replace(
            garment=encoded.garment + self.garment_encoder.start(nodes["garment"], features.NODE_FRAME_SIZE),
            mesh=encoded.mesh + self.mesh_encoder.start(edges["mesh"], features.MESH_FRAME_SIZE),
        )
        if encoded.world is not None:
            world = self.world_encoder.start(edges["world"], features.WORLD_FRAME_SIZE)
            encoded = encoded._replace(world=encoded.world + world)
            if encoded.world_reverse is not None:
                encoded = encoded._replace(world_reverse=encoded.world_reverse + world)
        return encoded

    def process(self, encoded: Encoded, garment: Garment) -> Float[Array, "vertices outputs"]:
        """Finish the encoders, run both stacks and decode."""
        has_body = encoded.world is not None
        vertices = self.garment_encoder.finish(encoded.garment)
        mesh = self.mesh_encoder.finish(encoded.mesh)
        latents = Latents(
            garment=vertices,
            mesh=mesh,
            mesh_sum=sum_receivers(mesh, encoded.mesh_tables),
            body=encoded.body,
            world=self.world_encoder.finish(encoded.world) if has_body else None,
            world_reverse=(
                self.world_encoder.finish(encoded.world_reverse)
                if encoded.world_reverse is not None
                else None
            ),
        )
        latents, _ = self.layers(latents, (encoded.mesh_tables, encoded.world_tables))
        return self.decode(latents.garment, vertices, garment)

    def normalized(
        self, graph: jraph.GraphsTuple, statistics: Statistics | None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return node and edge features as the encoders read them."""
        if self.config.features != "hood":
            return graph.nodes, graph.edges
        if statistics is None:
            raise ValueError('features = "hood" needs the statistics of its normalisers')
        nodes, edges = self.with_types(graph), graph.edges

        def scale(rows, name, num_static):
            changing = rows.shape[1] - num_static
            scaled = normalize(statistics[name], rows[:, :changing])
            return jnp.concatenate([scaled, rows[:, changing:]], axis=1)

        nodes = {name: scale(rows, "garment", features.HOOD_NODE_STATIC) for name, rows in nodes.items()}
        static = {"mesh": features.HOOD_MESH_STATIC}
        edges = {
            name: scale(rows, "mesh" if name == "mesh" else "world", static.get(name, 0))
            for name, rows in edges.items()
        }
        return nodes, edges

    def with_types(self, graph: jraph.GraphsTuple) -> dict[str, Float[Array, "rows 20"]]:
        """Insert the embedding of the vertex types behind the velocity, as HOOD orders its columns."""

        def insert(rows: Float[Array, "rows 11"], types: Int[Array, " rows"]):
            embedding = self.type_embedding.astype(rows.dtype)[types]
            return jnp.concatenate(
                [rows[:, :VELOCITY_COLUMNS], embedding, rows[:, VELOCITY_COLUMNS:]], axis=1
            )

        return {name: insert(rows, graph.globals[f"{name}_type"]) for name, rows in graph.nodes.items()}
