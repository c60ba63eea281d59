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
from typing import Any, cast

import flax.linen as nn
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Float, Int

from eslr_jax.networks import features
from eslr_jax.networks.apply import Places
from eslr_jax.networks.architecture import Architecture, make_decoder, stack, world_mask
from eslr_jax.networks.build import COARSE_SETS, NUM_LEVELS, GraphKind, Rows, feature_sizes, join_features
from eslr_jax.networks.dense import kernel_spread
from eslr_jax.networks.eslr import VELOCITY_COLUMNS, GraphModule, embedded
from eslr_jax.networks.lsdmp import Latents, LayerTables, WorldLatents, make_mlp, pass_messages
from eslr_jax.networks.network import Statistics, network
from eslr_jax.networks.operators import coarse_tables, mesh_tables

STAGES = (
    ("coarse0", "mesh"),
    ("coarse0", "coarse1"),
    ("coarse1",),
    ("coarse0", "coarse1"),
    ("coarse0", "mesh"),
)
"""Edge sets of the stages, in the order in which vertices read their sums (HOOD)."""


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

    def __call__(self, latents: Latents, tables: LayerTables):
        """Return the next latents, in the form that `nn.scan` asks for."""
        edge_mlps = {name: self.edge_mlps[name] for name in self.sets}  # in the order of their columns
        return pass_messages(edge_mlps, self.world_mlp, self.vertex_mlp, latents, tables), None


class HierarchicalNetwork(GraphModule):
    """The whole network, from a graph's features to a vector per vertex."""

    config: Hood

    def setup(self) -> None:
        """Declare embeddings, encoders, stages and decoder."""
        config = self.config
        self.declare_encoders(NUM_LEVELS)
        self.level_embedding = self.param(
            "level_embedding", kernel_spread(NUM_LEVELS), (NUM_LEVELS, NUM_LEVELS)
        )
        columns = feature_sizes(config.graph)["mesh"]
        self.coarse_encoders = {name: make_mlp(config, columns) for name in COARSE_SETS}
        self.stages = [stack(HoodLayer, config, config.steps_per_stage, sets=sets) for sets in STAGES]
        self.decoder = make_decoder(config)

    def encode(self, graph: jraph.GraphsTuple, statistics: Statistics) -> jraph.GraphsTuple:
        """Return the graph with its features as the encoders read them, all of them in every refinement step."""
        nodes, edges = self.normalized(graph, statistics)
        return graph._replace(nodes=nodes, edges=edges)

    def process(
        self, graph: jraph.GraphsTuple, places: Places, changing: jraph.GraphsTuple | None = None
    ) -> Float[Array, "vertices outputs"]:
        """Encode a whole graph, run all stages and decode."""
        graph = graph if changing is None else join_features(graph, changing)
        nodes, edges = cast(Rows, graph.nodes), cast(Rows, graph.edges)
        if self.config.reads_gradient:
            levels = self.level_embedding.astype(nodes["garment"].dtype)[vertex_levels(graph)]
            nodes = {**nodes, "garment": jnp.concatenate([nodes["garment"], levels], axis=1)}
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
            state = Latents(garment, {name: latents[name] for name in sets}, world)
            state, _ = layers(state, LayerTables({name: tables[name] for name in sets}, mask))
            garment, world, latents = state.garment, state.world, latents | state.edges
        return self.decoder(garment)

    def with_types(self, graph: jraph.GraphsTuple) -> Rows:
        """Return the node features with the embeddings of vertex type and level behind the velocity."""
        levels = vertex_levels(graph)
        column = VELOCITY_COLUMNS + features.NUM_TYPES
        return {
            name: embedded(rows, column, self.level_embedding, levels if name == "garment" else 0 * levels)
            for name, rows in super().with_types(graph).items()
        }


def vertex_levels(graph: jraph.GraphsTuple) -> Int[Array, " vertices"]:
    """Return the coarsest level that every vertex is on; 0 is the mesh."""
    levels = [jnp.where(level.is_kept, k + 1, 0) for k, level in enumerate(graph.globals["coarse"])]
    return jnp.max(jnp.stack(levels), axis=0)


@network("hood")
@dataclasses.dataclass(frozen=True)
class Hood(Architecture):
    """HOOD's hierarchical network; the defaults are those of the published "postcvpr"."""

    module_class = HierarchicalNetwork
    steps_per_stage: int = 3  # layers of each of the five stages

    @property
    def garment_options(self) -> dict[str, Any]:
        """Arguments of `assets.load_garment` for a garment that the network reads."""
        return {"has_coarse_edges": True}

    @property
    def graph(self) -> GraphKind:
        """What the network reads of a frame."""
        return super().graph._replace(has_coarse_edges=True, has_reverse_edges=True)
