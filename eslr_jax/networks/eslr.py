"""Encode, process, decode: ESLR, and with fewer parts MeshGraphNet.

The encoders' latents go through a stack of LSDMP layers and, beside it, through a stack of GSA blocks; the
decoder reads both. Without smoothing and attention, and with `Eslr.update_body`, this is MeshGraphNet as
in HOOD's baselines; without `update_body` body rows keep their encoding.

Source: paper, section on the simulation pipeline.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Float, Int

from eslr_jax.errors import ConfigError
from eslr_jax.networks import features
from eslr_jax.networks.apply import Places
from eslr_jax.networks.architecture import TwoBranches, make_decoder, stack, world_mask
from eslr_jax.networks.build import GraphKind, Rows, feature_sizes
from eslr_jax.networks.dense import kernel_spread
from eslr_jax.networks.gsa import GsaBlock
from eslr_jax.networks.lsdmp import Latents, LayerTables, LsdmpLayer, WorldLatents, make_mlp
from eslr_jax.networks.network import Statistics, network
from eslr_jax.networks.normalizer import normalize
from eslr_jax.networks.operators import mesh_tables, sum_receivers
from eslr_jax.types import Normalizer

VELOCITY_COLUMNS = 3  # HOOD puts the type embedding behind them


class Encoded(NamedTuple):
    """Hidden layers of the encoders, as far as a frame's constant features decide them.

    Body rows are finished: they have no features that change.
    """

    garment: Float[Array, "vertices hidden"]
    mesh: Float[Array, "edges hidden"]
    tables: LayerTables
    world: WorldLatents | None  # None in a scene without a body


class GraphModule(nn.Module):
    """A module that reads HOOD's features through their normalisers, with an embedding of the vertex type."""

    config: Any

    def normalized(self, graph: jraph.GraphsTuple, statistics: Statistics | None) -> tuple[Rows, Rows]:
        """Return node and edge features as the encoders read them.

        Raises:
            ValueError: The features are HOOD's and `statistics` is None.
        """
        if self.config.reads_gradient:
            return graph.nodes, graph.edges
        if statistics is None:
            raise ValueError("HOOD's features need the statistics of their normalisers")

        def scale(
            rows: Float[Array, "_ features"], normalizer: Normalizer, num_static: int
        ) -> Float[Array, "_ features"]:
            changing = rows.shape[1] - num_static
            scaled = normalize(normalizer, rows[:, :changing])
            return jnp.concatenate([scaled, rows[:, changing:]], axis=1)

        nodes = {
            name: scale(rows, statistics["garment"], features.HOOD_NODE_STATIC)
            for name, rows in self.with_types(graph).items()
        }
        edges = {
            name: scale(rows, statistics["world"], 0)
            if name.startswith("world")
            else scale(rows, statistics["mesh"], features.HOOD_MESH_STATIC)
            for name, rows in cast(Rows, graph.edges).items()
        }
        return nodes, edges

    def with_types(self, graph: jraph.GraphsTuple) -> Rows:
        """Return the node features with the embedding of the vertex type behind the velocity, as in HOOD."""

        def insert(rows: Float[Array, "_ 11"], types: Int[Array, " _"]) -> Float[Array, "_ 20"]:
            embedding = self.type_embedding.astype(rows.dtype)[types]
            return jnp.concatenate(
                [rows[:, :VELOCITY_COLUMNS], embedding, rows[:, VELOCITY_COLUMNS:]], axis=1
            )

        nodes = cast(Rows, graph.nodes)
        return {name: insert(rows, graph.globals[f"{name}_type"]) for name, rows in nodes.items()}


class EncodeProcessDecode(GraphModule):
    """The whole network, from a graph's features to a vector, and gates, per vertex."""

    config: TwoBranches

    def setup(self) -> None:
        """Declare encoders, stacks and decoder."""
        config, sizes = self.config, feature_sizes(self.config.graph)
        if not config.reads_gradient:
            self.type_embedding = self.param(
                "type_embedding",
                kernel_spread(features.NUM_TYPES),
                (features.NUM_TYPES, features.NUM_TYPES),
            )
            self.garment_encoder = make_mlp(config, sizes["garment"] + features.NUM_TYPES)
        else:
            self.garment_encoder = make_mlp(config, sizes["garment"])
            self.body_encoder = make_mlp(config, sizes["body"])
        self.mesh_encoder = make_mlp(config, sizes["mesh"])
        self.world_encoder = make_mlp(config, sizes["world"])
        self.layers = stack(LsdmpLayer, config, config.message_passing_steps)
        if config.attention_blocks:
            self.blocks = stack(GsaBlock, config, config.attention_blocks)
            shape = (config.attention_features, config.attention_size)
            self.projection = self.variable("constants", "projection", jnp.zeros, shape)
        self.decoder = make_decoder(config, 2 if config.attention_blocks else 1)

    def __call__(
        self, graph: jraph.GraphsTuple, places: Places, statistics: Statistics | None = None
    ) -> Float[Array, "vertices outputs"]:
        """Return the raw output for a whole graph; `statistics` are the normalisers of HOOD's features."""
        return self.process(self.encode_frame(graph, statistics), places)

    def encode_frame(self, graph: jraph.GraphsTuple, statistics: Statistics | None = None) -> Encoded:
        """Return the encoders' first layers, for a whole graph or for the features that stay for a frame."""
        nodes, edges = self.normalized(graph, statistics)
        dtype = nodes["garment"].dtype
        world = None
        if "world" in edges:
            body_encoder = self.body_encoder if self.config.reads_gradient else self.garment_encoder
            first_layers = {
                name: self.world_encoder.start(edges[name], 0, bias=True)
                for name in ("world", "world_reverse")
                if name in edges
            }
            world = WorldLatents(
                body=body_encoder(nodes["body"]),
                edges=first_layers["world"],
                reverse=first_layers.get("world_reverse"),
            )
        return Encoded(
            garment=self.garment_encoder.start(nodes["garment"], 0, bias=True),
            mesh=self.mesh_encoder.start(edges["mesh"], 0, bias=True),
            tables=LayerTables(mesh_tables(graph, dtype), world_mask(graph, dtype)),
            world=world,
        )

    def encode_refinement(self, encoded: Encoded, changing: jraph.GraphsTuple) -> Encoded:
        """Add the features of a refinement step, of `build_refinement_graph`, to those of its frame."""
        nodes, edges, world = changing.nodes, changing.edges, encoded.world
        if world is not None:
            rows = self.world_encoder.start(edges["world"], features.WORLD_FRAME_SIZE)
            reverse = None if world.reverse is None else world.reverse + rows
            world = world._replace(edges=world.edges + rows, reverse=reverse)
        return encoded._replace(
            garment=encoded.garment + self.garment_encoder.start(nodes["garment"], features.NODE_FRAME_SIZE),
            mesh=encoded.mesh + self.mesh_encoder.start(edges["mesh"], features.MESH_FRAME_SIZE),
            world=world,
        )

    def process(self, encoded: Encoded, places: Places) -> Float[Array, "vertices outputs"]:
        """Finish the encoders, run both stacks and decode.

        Raises:
            ConfigError: The garment has another number of geodesic coordinates than the network reads.
        """
        config = self.config
        vertices = self.garment_encoder.finish(encoded.garment)
        mesh = self.mesh_encoder.finish(encoded.mesh)
        world = None
        if encoded.world is not None:
            finish, given = self.world_encoder.finish, encoded.world
            reverse = None if given.reverse is None else finish(given.reverse)
            world = WorldLatents(given.body, finish(given.edges), reverse)
        latents = Latents(vertices, mesh, sum_receivers(mesh, encoded.tables.mesh), world)
        latents, _ = self.layers(latents, encoded.tables)
        hidden = self.decoder.start(latents.garment, 0, bias=True)
        if config.attention_blocks:
            size = places.embedding.shape[1]
            if size != config.embedding_size:
                raise ConfigError(
                    f"the garment has {size} geodesic coordinates and the model embedding_size = "
                    f"{config.embedding_size}; prepare the garment with that embedding_size"
                )
            attended, _ = self.blocks(vertices, (*places, self.projection.value))
            hidden = hidden + self.decoder.start(attended, config.latent_size)
        return self.decoder.finish(hidden)


@network("eslr")
@dataclasses.dataclass(frozen=True)
class Eslr(TwoBranches):
    """The paper's network; the defaults are its 15-layer model (4,753,108 parameters)."""

    update_body: bool = False  # open: layers update body rows as HOOD does, see models.lsdmp
    world_edges: int = 1  # of a vertex, at most: pairs within `world_edge_radius` (paper: all of them)

    @property
    def graph(self) -> GraphKind:
        """What the network reads of a frame."""
        return super().graph._replace(has_reverse_edges=self.update_body, world_edges=self.world_edges)

    @property
    def module(self) -> EncodeProcessDecode:
        """The Flax module."""
        return EncodeProcessDecode(self)
