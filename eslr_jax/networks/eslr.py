"""Encode, process, decode: ESLR, and with fewer parts MeshGraphNet.

The encoders' latents go through a stack of LSDMP layers and, beside it, through a stack of GSA blocks; the
decoder reads both. Without smoothing and attention, and with `Eslr.update_body`, this is MeshGraphNet as
in HOOD's baselines; without `update_body` body rows keep their encoding.

Source: paper, section on the simulation pipeline.
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Float, Int

from eslr_jax.errors import ConfigError
from eslr_jax.networks import features
from eslr_jax.networks.apply import Places
from eslr_jax.networks.architecture import TwoBranches, make_decoder, stack, world_mask
from eslr_jax.networks.attention import GsaBlock
from eslr_jax.networks.build import GraphKind, Rows, feature_sizes, normalizer_of
from eslr_jax.networks.dense import kernel_spread
from eslr_jax.networks.lsdmp import Latents, LayerTables, LsdmpLayer, WorldLatents, make_mlp
from eslr_jax.networks.network import Statistics, network
from eslr_jax.networks.normalizer import normalize
from eslr_jax.networks.operators import mesh_tables, sum_receivers

VELOCITY_COLUMNS = 3  # HOOD puts the type embedding behind them


class GraphModule(nn.Module):
    """A module with what `networks.apply` calls.

    It also has `encode(graph, statistics)`, which returns what all refinement steps of a frame share, and
    `process(encoded, places, changing=None)`, which returns the raw output, shape [vertices, outputs]; `changing`
    holds the features of a refinement step, of `build_refinement_graph`.
    """

    config: Any

    def declare_encoders(self, more_columns: int = 0) -> None:
        """Declare encoders, that of a vertex with `more_columns`, and HOOD's embedding of the vertex type."""
        config, sizes = self.config, feature_sizes(self.config.graph)
        types = 0 if config.reads_gradient else features.NUM_TYPES
        if types:
            self.type_embedding = self.param("type_embedding", kernel_spread(types), (types, types))
        else:
            self.body_encoder = make_mlp(config, sizes["body"])
        self.garment_encoder = make_mlp(config, sizes["garment"] + types + more_columns)
        self.mesh_encoder = make_mlp(config, sizes["mesh"])
        self.world_encoder = make_mlp(config, sizes["world"])

    def __call__(
        self, graph: jraph.GraphsTuple, statistics: Statistics, places: Places
    ) -> Float[Array, "vertices outputs"]:
        """Return the raw output for a whole graph; `statistics` are the normalisers of HOOD's features."""
        return self.process(self.encode(graph, statistics), places)

    def normalized(self, graph: jraph.GraphsTuple, statistics: Statistics) -> tuple[Rows, Rows]:
        """Return node and edge features as the encoders read them: HOOD's with embedded types, and normalised."""
        if self.config.reads_gradient:
            return graph.nodes, graph.edges

        def scaled(name: str, rows: Float[Array, "_ features"]) -> Float[Array, "_ features"]:
            kind = normalizer_of(name)
            changing = rows.shape[1] - features.HOOD_STATIC[kind]
            return jnp.concatenate(
                [normalize(statistics[kind], rows[:, :changing]), rows[:, changing:]], axis=1
            )

        nodes = {name: scaled(name, rows) for name, rows in self.with_types(graph).items()}
        return nodes, {name: scaled(name, rows) for name, rows in cast(Rows, graph.edges).items()}

    def with_types(self, graph: jraph.GraphsTuple) -> Rows:
        """Return the node features with the embedding of the vertex type behind the velocity, as in HOOD."""
        return {
            name: embedded(rows, VELOCITY_COLUMNS, self.type_embedding, graph.globals[f"{name}_type"])
            for name, rows in cast(Rows, graph.nodes).items()
        }


def embedded(
    rows: Float[Array, "_ features"], column: int, table: Float[Array, "types size"], types: Int[Array, " _"]
) -> Float[Array, "_ more_features"]:
    """Return rows with the embedding of their types, of a table, in front of a column."""
    return jnp.concatenate([rows[:, :column], table.astype(rows.dtype)[types], rows[:, column:]], axis=1)


class EncodeProcessDecode(GraphModule):
    """The whole network, from a graph's features to a vector, and gates, per vertex."""

    config: TwoBranches

    def setup(self) -> None:
        """Declare encoders, stacks and decoder."""
        config = self.config
        self.declare_encoders()
        self.layers = stack(LsdmpLayer, config, config.message_passing_steps)
        if config.attention_blocks:
            self.blocks = stack(GsaBlock, config, config.attention_blocks)
            shape = (config.attention_features, config.attention_size)
            self.projection = self.variable("constants", "projection", jnp.zeros, shape)
        self.decoder = make_decoder(config, 2 if config.attention_blocks else 1)

    def encode(self, graph: jraph.GraphsTuple, statistics: Statistics) -> tuple[Latents, LayerTables]:
        """Return the encoders' first layers, for a whole graph or for the features that stay for a frame.

        Body rows are finished: they have no features that change.
        """
        nodes, edges = self.normalized(graph, statistics)
        dtype = nodes["garment"].dtype
        world = None
        if "world" in edges:
            body_encoder = self.body_encoder if self.config.reads_gradient else self.garment_encoder
            toward, reverse = (
                self.world_encoder.start(edges[name], 0, bias=True) if name in edges else None
                for name in ("world", "world_reverse")
            )
            world = WorldLatents(body_encoder(nodes["body"]), toward, reverse)
        garment = self.garment_encoder.start(nodes["garment"], 0, bias=True)
        hidden = Latents(garment, {"mesh": self.mesh_encoder.start(edges["mesh"], 0, bias=True)}, world)
        return hidden, LayerTables({"mesh": mesh_tables(graph, dtype)}, world_mask(graph, dtype))

    def process(
        self,
        encoded: tuple[Latents, LayerTables],
        places: Places,
        changing: jraph.GraphsTuple | None = None,
    ) -> Float[Array, "vertices outputs"]:
        """Finish the encoders, run both stacks and decode; a ConfigError where the embedding has another size."""
        config, (hidden, tables) = self.config, encoded
        garment, mesh, world = hidden.garment, hidden.edges["mesh"], hidden.world
        along = () if world is None else (world.edges, world.reverse)
        if changing is not None:
            nodes, edges = changing.nodes, changing.edges
            garment = garment + self.garment_encoder.start(nodes["garment"], features.NODE_FRAME_SIZE)
            mesh = mesh + self.mesh_encoder.start(edges["mesh"], features.MESH_FRAME_SIZE)
            if world is not None:
                rows = self.world_encoder.start(edges["world"], features.WORLD_FRAME_SIZE)
                along = jax.tree.map(lambda given: given + rows, along)
        vertices, mesh = self.garment_encoder.finish(garment), self.mesh_encoder.finish(mesh)
        if world is not None:
            world = WorldLatents(world.body, *jax.tree.map(self.world_encoder.finish, along))
        mesh_sum = sum_receivers(mesh, tables.edges["mesh"]) if config.smoothing_steps else None
        latents, _ = self.layers(Latents(vertices, {"mesh": mesh}, world, mesh_sum), tables)
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

    module_class = EncodeProcessDecode
    update_body: bool = False  # open: layers update body rows as HOOD does, see models.lsdmp
    world_edges: int = 1  # of a vertex, at most: pairs within `world_edge_radius` (paper: all of them)

    @property
    def graph(self) -> GraphKind:
        """What the network reads of a frame."""
        return super().graph._replace(has_reverse_edges=self.update_body, world_edges=self.world_edges)
