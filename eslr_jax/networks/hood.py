"""HOOD: message passing on the garment's edges and on coarse levels of them.

The steps are shared equally among five stages: mesh and coarse0, coarse0 and coarse1, coarse1 alone, and
back. So a message crosses the garment in few steps. On a stage without the mesh, world edges rest at
vertices that no edge of the stage joins. The third level, coarse2, is encoded and not used, as published;
only a vertex's level reads it.

What differs from the published network: every garment vertex has a body row of its own, at the nearest point
of the body's surface, where HOOD joins it to the nearest body vertex, or to none if that is on a hand; our bodies
are searched without hands. That row's velocity is the body's way to the next frame, as in HOOD's "cvpr" and its
MeshGraphNets; "postcvpr" takes the way since the last one. And the centre of the levels is not random.

With features "gradient" the level's embedding stands behind a vertex's features, and body rows have an encoder
of their own.

Source: Grigorev, Black and Hilliges, "HOOD" (2023); its `models/core/postcvpr.py`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Float, Int

from eslr_jax.networks import features
from eslr_jax.networks.apply import Places
from eslr_jax.networks.architecture import Architecture, make_decoder, stack, world_mask
from eslr_jax.networks.build import COARSE_SETS, NUM_LEVELS, GraphKind, Rows, feature_sizes, join_features
from eslr_jax.networks.dense import kernel_spread
from eslr_jax.networks.eslr import VELOCITY_COLUMNS, GraphModule
from eslr_jax.networks.lsdmp import WorldLatents, make_mlp
from eslr_jax.networks.network import Statistics, network
from eslr_jax.networks.operators import (
    MeshTables,
    coarse_tables,
    mesh_tables,
    sum_receivers,
    take_receivers,
    take_senders,
)

STAGES = (
    ("coarse0", "mesh"),
    ("coarse0", "coarse1"),
    ("coarse1",),
    ("coarse0", "coarse1"),
    ("coarse0", "mesh"),
)
"""Edge sets of the stages, in the order in which vertices read their sums (HOOD)."""


@network("hood")
@dataclasses.dataclass(frozen=True)
class Hood(Architecture):
    """HOOD's hierarchical network; the defaults are those of the published "postcvpr"."""

    steps_per_stage: int = 3  # layers of each of the five stages

    @property
    def garment_options(self) -> dict[str, Any]:
        """Arguments of `assets.load_garment` for a garment that the network reads."""
        return {"has_coarse_edges": True}

    @property
    def graph(self) -> GraphKind:
        """What the network reads of a frame."""
        return super().graph._replace(has_coarse_edges=True, has_reverse_edges=True)

    @property
    def module(self) -> HierarchicalNetwork:
        """The Flax module."""
        return HierarchicalNetwork(self)


class StageLatents(NamedTuple):
    """What passes from layer to layer of a stage."""

    garment: Float[Array, "vertices latent"]
    edges: Rows  # by edge set
    world: WorldLatents | None  # None in a scene without a body


class StageTables(NamedTuple):
    """What is the same in every layer of a stage."""

    edges: dict[str, MeshTables]
    world_mask: Float[Array, "vertices 1"]  # one where a vertex of the stage's levels has a world edge


class HoodLayer(nn.Module):
    """One step of message passing on some edge sets: e += f_e(v_i, v_j, e), v += f_v(v, sums of f_e by set)."""

    config: Hood
    sets: tuple[str, ...] = ()

    def setup(self) -> None:
        """Declare a perceptron per edge set, one of world edges and one of vertices."""
        size = self.config.latent_size
        self.edge_mlps = {name: make_mlp(self.config, 3 * size) for name in self.sets}
        self.world_mlp = make_mlp(self.config, 3 * size)
        self.vertex_mlp = make_mlp(self.config, (2 + len(self.sets)) * size)

    def __call__(self, latents: StageLatents, tables: StageTables):
        """Return the next latents, in the form that `nn.scan` asks for."""
        size, garment, world = self.config.latent_size, latents.garment, latents.world
        vertex, edges = self.vertex_mlp, dict(latents.edges)
        hidden = vertex.start(garment, 0, bias=True)
        for place, name in enumerate(self.sets, 1):
            edge, table = self.edge_mlps[name], tables.edges[name]
            ends = take_receivers(edge.start(garment, 0, bias=True), table) + take_senders(
                edge.start(garment, size), table
            )
            messages = edge.finish(edge.start(edges[name], 2 * size) + ends)
            hidden = hidden + vertex.start(sum_receivers(messages, table), place * size)
            edges[name] = edges[name] + messages
        if world is not None and world.reverse is not None:
            edge, column, mask = self.world_mlp, (1 + len(self.sets)) * size, tables.world_mask
            ends = edge.start(garment, 0) + edge.start(world.body, size)
            to_garment = mask * edge.finish(ends + edge.start(world.edges, 2 * size, bias=True))
            ends = edge.start(world.body, 0) + edge.start(garment, size)
            to_body = mask * edge.finish(ends + edge.start(world.reverse, 2 * size, bias=True))
            at_body = vertex.start(world.body, 0, bias=True) + vertex.start(to_body, column)
            hidden = hidden + vertex.start(to_garment, column)
            world = WorldLatents(
                world.body + vertex.finish(at_body), world.edges + to_garment, world.reverse + to_body
            )
        return StageLatents(garment + vertex.finish(hidden), edges, world), None


class HierarchicalNetwork(GraphModule):
    """The whole network, from a graph's features to a vector per vertex."""

    config: Hood

    def setup(self) -> None:
        """Declare embeddings, encoders, stages and decoder."""
        config, sizes = self.config, feature_sizes(self.config.graph)
        types = 0 if config.reads_gradient else features.NUM_TYPES
        if types:
            self.type_embedding = self.param("type_embedding", kernel_spread(types), (types, types))
        else:
            self.body_encoder = make_mlp(config, sizes["body"])
        self.level_embedding = self.param(
            "level_embedding", kernel_spread(NUM_LEVELS), (NUM_LEVELS, NUM_LEVELS)
        )
        self.garment_encoder = make_mlp(config, sizes["garment"] + types + NUM_LEVELS)
        self.mesh_encoder = make_mlp(config, sizes["mesh"])
        self.coarse_encoders = {name: make_mlp(config, sizes["mesh"]) for name in COARSE_SETS}
        self.world_encoder = make_mlp(config, sizes["world"])
        self.stages = [stack(HoodLayer, config, config.steps_per_stage, sets=sets) for sets in STAGES]
        self.decoder = make_decoder(config)

    def __call__(
        self, graph: jraph.GraphsTuple, places: Places, statistics: Statistics | None = None
    ) -> Float[Array, "vertices outputs"]:
        """Return the raw output for a whole graph; see `EncodeProcessDecode`."""
        return self.process(graph, places, statistics)

    def encode_frame(self, graph: jraph.GraphsTuple) -> jraph.GraphsTuple:
        """Return the graph: this network encodes all of it in every refinement step."""
        return graph

    def encode_refinement(self, encoded: jraph.GraphsTuple, changing: jraph.GraphsTuple) -> jraph.GraphsTuple:
        """Return the graph with the features of a refinement step; see `EncodeProcessDecode`."""
        return join_features(encoded, changing)

    def process(
        self, graph: jraph.GraphsTuple, places: Places, statistics: Statistics | None = None
    ) -> Float[Array, "vertices outputs"]:
        """Encode a whole graph, run all stages and decode."""
        nodes, edges = self.normalized(graph, statistics)
        vertices = garment = self.garment_encoder(nodes["garment"])
        latents = {name: self.coarse_encoders[name](edges[name]) for name in COARSE_SETS}
        latents["mesh"] = self.mesh_encoder(edges["mesh"])
        world = None
        if "world" in edges:
            toward, reverse = (self.world_encoder(edges[name]) for name in ("world", "world_reverse"))
            body_encoder = self.body_encoder if self.config.reads_gradient else self.garment_encoder
            world = WorldLatents(body_encoder(nodes["body"]), toward, reverse)
        tables = {name: coarse_tables(graph, level) for level, name in enumerate(COARSE_SETS)}
        tables["mesh"] = mesh_tables(graph, vertices.dtype)
        for sets, layers in zip(STAGES, self.stages, strict=True):
            mask = world_mask(graph, vertices.dtype)
            if "mesh" not in sets:  # which joins all vertices
                kept = [graph.globals["coarse"][COARSE_SETS.index(name)].is_kept for name in sets]
                mask = jnp.where(jnp.any(jnp.stack(kept), axis=0)[:, None], mask, 0.0)
            state = StageLatents(garment, {name: latents[name] for name in sets}, world)
            state, _ = layers(state, StageTables({name: tables[name] for name in sets}, mask))
            garment, world, latents = state.garment, state.world, latents | state.edges
        return self.decoder(garment)

    def normalized(self, graph: jraph.GraphsTuple, statistics: Statistics | None) -> tuple[Rows, Rows]:
        """Return node and edge features as the encoders read them, with the embedding of a vertex's level."""
        nodes, edges = super().normalized(graph, statistics)
        if not self.config.reads_gradient:
            return nodes, edges
        levels = self.level_embedding.astype(nodes["garment"].dtype)[vertex_levels(graph)]
        return {**nodes, "garment": jnp.concatenate([nodes["garment"], levels], axis=1)}, edges

    def with_types(self, graph: jraph.GraphsTuple) -> Rows:
        """Return the node features with the embeddings of vertex type and level behind the velocity."""
        levels = vertex_levels(graph)
        column = VELOCITY_COLUMNS + features.NUM_TYPES

        def insert(rows: Float[Array, "_ 20"], levels: Int[Array, " _"]) -> Float[Array, "_ 24"]:
            embedding = self.level_embedding.astype(rows.dtype)[levels]
            return jnp.concatenate([rows[:, :column], embedding, rows[:, column:]], axis=1)

        rows = super().with_types(graph)
        return {name: insert(one, levels if name == "garment" else 0 * levels) for name, one in rows.items()}


def vertex_levels(graph: jraph.GraphsTuple) -> Int[Array, " vertices"]:
    """Return the coarsest level that every vertex is on; 0 is the mesh."""
    levels = [jnp.where(level.is_kept, k + 1, 0) for k, level in enumerate(graph.globals["coarse"])]
    return jnp.max(jnp.stack(levels), axis=0)
