"""Named configurations, and the functions that make, apply and count a network's weights.

A network's weights are a dictionary: "params" are trained, "constants" are the random directions of the
attention, "statistics" are the normalisers of HOOD's features and of the output. Only "params" belongs in
an optimiser.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
import jraph
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.config import COARSE_SETS, ModelConfig
from eslr_jax.errors import CheckpointError
from eslr_jax.graph import features, normalizer
from eslr_jax.graph.build import Rows, Topology, feature_sizes
from eslr_jax.models.attention import orthogonal_projection
from eslr_jax.models.branches import Places
from eslr_jax.models.hood import NUM_LEVELS, HierarchicalNetwork
from eslr_jax.models.network import Encoded, EncodeProcessDecode, Statistics
from eslr_jax.models.smoothing import EncodedVertices, SmoothingNetwork
from eslr_jax.types import CoarseEdges, Garment

Params = dict[str, Any]
AnyEncoded = Encoded | EncodedVertices | jraph.GraphsTuple  # the hierarchical network encodes in every step

PAPER = ModelConfig()
SMALL = ModelConfig(
    message_passing_steps=1,
    attention_blocks=1,
    latent_size=32,
    attention_size=32,
    attention_features=64,
    attention_kernel="softmax",
    attention_norm=True,
    attention_feedforward=True,
    features="gradient",
    output="subspace",
    output_scale=0.005,
    refinement_steps=12,
    remat="none",
)


def _without_smoothing(config: ModelConfig) -> ModelConfig:
    return dataclasses.replace(config, smoothing_steps=0)


def _without_attention(config: ModelConfig) -> ModelConfig:
    return dataclasses.replace(config, attention_blocks=0)


# One step as the solver's initial guess: it costs three to four iterations and saves more.
SMOOTH = dataclasses.replace(
    _without_attention(SMALL), edge_latents=False, smoothing_steps=2, output="descent", refinement_steps=1
)
# The paper's network scaled to 1k vertices. Garments are 21 hops across at 1k, and some 60 in the paper. The
# ratio of layers to hops, and that of width to layers, are the paper's. One application a frame, HOOD's
# features, an acceleration.
SHALLOW = dataclasses.replace(
    PAPER,
    message_passing_steps=5,
    attention_blocks=2,
    latent_size=64,
    attention_size=32,
    attention_features=110,  # floor(32 ln 32)
    remat="none",
)
# HOOD's published networks, which update body rows: MeshGraphNet, "fine15", and the hierarchical "postcvpr".
FINE = dataclasses.replace(_without_attention(_without_smoothing(PAPER)), update_body=True)
HOOD = dataclasses.replace(FINE, hierarchical=True)
MODELS: dict[str, ModelConfig] = {
    "eslr-15": PAPER,
    "eslr-10": dataclasses.replace(PAPER, message_passing_steps=10, attention_blocks=3),
    "lsdmp-15": _without_attention(PAPER),
    "gsa-15": _without_smoothing(PAPER),
    "mgn-15": FINE,
    "mgn-48": dataclasses.replace(FINE, message_passing_steps=48),
    "hood": HOOD,
    "eslr-5": SHALLOW,
    "lsdmp-5": _without_attention(SHALLOW),
    "gsa-5": _without_smoothing(SHALLOW),
    "mgn-5": _without_attention(_without_smoothing(SHALLOW)),
    "hood-5": dataclasses.replace(
        _without_attention(_without_smoothing(SHALLOW)), hierarchical=True, update_body=True
    ),
    "mgn-16": dataclasses.replace(_without_attention(_without_smoothing(SHALLOW)), message_passing_steps=16),
    "eslr-small": SMALL,
    "lsdmp-small": _without_attention(SMALL),
    "gsa-small": _without_smoothing(SMALL),
    "mgn-small": _without_attention(_without_smoothing(SMALL)),
    "smooth-small": SMOOTH,
}


def make_network(config: ModelConfig) -> EncodeProcessDecode | SmoothingNetwork:
    """Return the module that a configuration describes."""
    if config.hierarchical:
        return HierarchicalNetwork(config)
    return EncodeProcessDecode(config) if config.edge_latents else SmoothingNetwork(config)


def init_model(config: ModelConfig, seed: int = 0) -> Params:
    """Return new weights, which fit any garment.

    Args:
        config: Architecture; its own seed is that of the random attention directions.
        seed: Seed of the initial weights.
    """
    params = jax.jit(lambda: _declare(config))()
    params["params"] = draw_weights(params["params"], seed)
    if config.attention_blocks:
        directions = orthogonal_projection(config.attention_features, config.attention_size, config.seed)
        params["constants"] = {"projection": jnp.asarray(directions, jnp.float32)}
    return params


def draw_weights(spreads: Params, seed: int) -> Params:
    """Return weights as modules declare them, with the kernels drawn; see `dense.kernel_spread`.

    Args:
        spreads: Weights of a module's `init`.
        seed: Of the normal numbers that kernels are multiplied by.
    """
    generator = np.random.default_rng(seed)

    def draw(path, spread):
        is_kernel = not any(word in path[-1].key for word in ("bias", "scale"))
        return spread * generator.standard_normal(spread.shape, np.float32) if is_kernel else spread

    return jax.tree_util.tree_map_with_path(draw, spreads)


def apply_model(
    config: ModelConfig, params: Params, graph: jraph.GraphsTuple, garment: Garment
) -> Float[Array, "vertices outputs"]:
    """Return the network's raw output; see `scale_output`.

    Args:
        config: Architecture; static.
        params: Weights.
        graph: Graph of `build_graph` with the same config.
        garment: The graph's garment, for its geodesic embedding and vertex mask.
    """
    return make_network(config).apply(_variables(params), graph, _places(garment), params["statistics"])


def encode_frame(config: ModelConfig, params: Params, graph: jraph.GraphsTuple) -> AnyEncoded:
    """Return what all refinement steps of a frame share.

    Args:
        config: Architecture with features "gradient"; static.
        params: Weights.
        graph: Graph of `build_frame_graph`.
    """
    return make_network(config).apply(_variables(params), graph, method="encode_frame")


def apply_refinement(
    config: ModelConfig,
    params: Params,
    encoded: AnyEncoded,
    changing: jraph.GraphsTuple,
    garment: Garment,
) -> Float[Array, "vertices outputs"]:
    """Return the raw output of one refinement step; equals `apply_model` on the joined graph.

    Args:
        config: Architecture with features "gradient"; static.
        params: Weights.
        encoded: Result of `encode_frame`.
        changing: Graph of `build_refinement_graph`.
        garment: The graph's garment, for its geodesic embedding and vertex mask.
    """

    def run(module: Any):
        return module.process(module.encode_refinement(encoded, changing), _places(garment))

    return make_network(config).apply(_variables(params), method=run)


def scale_output(
    config: ModelConfig, params: Params, output: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """Return the output's vectors in physical units: metres, or metres per frame squared for "acceleration".

    Args:
        config: Architecture; static.
        params: Weights.
        output: First three columns of the raw output, shape [vertices, 3].

    Source: HOOD's output normaliser, applied backwards, for accelerations.
    """
    if config.output != "acceleration":
        return output * config.output_scale
    return normalizer.inverse(params["statistics"]["output"], output)


def measure_statistics(
    config: ModelConfig,
    params: Params,
    graph: jraph.GraphsTuple,
    garment: Garment,
    acceleration: Float[Array, "vertices 3"] | None = None,
) -> Statistics:
    """Return the statistics of one graph, which training merges into those of the network.

    Args:
        config: Architecture; static. Features "gradient" are not normalised.
        params: Weights.
        graph: Graph of `build_graph`.
        garment: The graph's garment, for its masks.
        acceleration: Target accelerations [m per frame^2], shape [vertices, 3]; in HOOD those of the skinned
            garment. None leaves out the output's statistics.

    Source: HOOD's `utils/normalization.py`.
    """
    measured: Statistics = {}
    if config.features == "hood":
        nodes = make_network(config).apply(_variables(params), graph, method="with_types")
        nodes = jax.lax.stop_gradient(nodes)
        edges = cast(Rows, graph.edges)
        masks = {"garment": garment.vertex_mask, "mesh": garment.edge_mask}
        coarse = cast(Topology, graph.globals).get("coarse", ())
        masks |= {name: level.edge_mask for name, level in zip(COARSE_SETS, coarse, strict=False)}
        world = {name: rows for name, rows in edges.items() if name.startswith("world")}
        mesh = {name: rows for name, rows in edges.items() if name not in world}
        groups = (
            ("garment", nodes, features.HOOD_NODE_STATIC),
            ("mesh", mesh, features.HOOD_MESH_STATIC),
            ("world", world, 0),
        )
        for name, group, num_static in groups:
            if group:
                rows = jnp.concatenate(list(group.values()))
                mask = jnp.concatenate(
                    [masks[kind] if kind in masks else graph.globals["world_mask"] for kind in group]
                )
                measured[name] = normalizer.measure(rows[:, : rows.shape[1] - num_static], mask)
    if config.output == "acceleration" and acceleration is not None:
        measured["output"] = normalizer.measure(acceleration, garment.vertex_mask)
    return measured


def merge_statistics(params: Params, measured: Statistics) -> Params:
    """Return weights whose normalisers include what `measure_statistics` measured."""
    seen = params["statistics"]
    merged = {name: normalizer.merge(seen[name], new) for name, new in measured.items()}
    return {**params, "statistics": {**seen, **merged}}


def count_parameters(params: Params) -> int:
    """Return the number of trained weights."""
    return sum(leaf.size for leaf in jax.tree.leaves(params["params"]))


def check_params(config: ModelConfig, params: Params) -> None:
    """Compare the shapes of weights with an architecture; nothing is computed, and tracers are accepted.

    Raises:
        CheckpointError: A weight is missing, unknown, or of another shape.
    """
    expected, given = _expected_shapes(config), _shapes(params)
    for name in sorted(expected.keys() | given.keys()):
        if expected.get(name) != given.get(name):
            raise CheckpointError(
                f"these weights are for another architecture: {name} is {given.get(name, 'missing')}, "
                f"expected {expected.get(name, 'absent')}; load weights and configuration of the same model"
            )


@functools.cache
def _expected_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Return the shape of every array of an architecture by its path."""
    return _shapes(jax.eval_shape(lambda: _declare(config)))


def _shapes(params: Params) -> dict[str, tuple[int, ...]]:
    """Return the shape of every array by its path."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {jax.tree_util.keystr(path): np.shape(leaf) for path, leaf in leaves}


def _declare(config: ModelConfig) -> Params:
    """Return weights as their modules declare them, before anything is drawn; see `dense.kernel_spread`."""
    statistics = _new_statistics(config)
    graph, places = _example(config)
    variables = make_network(config).init(jax.random.key(0), graph, places, statistics)
    return {**variables, "statistics": statistics}


def _variables(params: Params) -> Params:
    """Return what the module itself reads."""
    return {name: params[name] for name in ("params", "constants") if name in params}


def _places(garment: Garment) -> Places:
    """Return embedding and mask of a garment's vertices."""
    return Places(garment.geodesic_embedding, garment.vertex_mask)


def _new_statistics(config: ModelConfig) -> Statistics:
    """Return empty normalisers for what the configuration normalises."""
    statistics = {}
    if config.features == "hood":
        sizes = feature_sizes(config)
        embedded = features.NUM_TYPES + (NUM_LEVELS if config.hierarchical else 0)
        statistics["garment"] = normalizer.init_normalizer(
            sizes["garment"] + embedded - features.HOOD_NODE_STATIC
        )
        statistics["mesh"] = normalizer.init_normalizer(sizes["mesh"] - features.HOOD_MESH_STATIC)
        statistics["world"] = normalizer.init_normalizer(sizes["world"])
    if config.output == "acceleration":
        statistics["output"] = normalizer.init_normalizer(3)
    return statistics


def _example(config: ModelConfig) -> tuple[jraph.GraphsTuple, Places]:
    """Return the smallest graph that touches every weight: one edge, two body points."""
    sizes, zeros, pair = feature_sizes(config), functools.partial(jnp.zeros, dtype=jnp.float32), jnp.arange(2)
    worlds = ("world", "world_reverse") if config.update_body else ("world",)
    graph = jraph.GraphsTuple(
        nodes={"garment": zeros((2, sizes["garment"])), "body": zeros((2, sizes["body"]))},
        edges={"mesh": zeros((2, sizes["mesh"])), **{name: zeros((2, sizes["world"])) for name in worlds}},
        senders={"mesh": pair[::-1], **dict.fromkeys(worlds, pair)},
        receivers={"mesh": pair, **dict.fromkeys(worlds, pair)},
        globals={
            "reverse_edges": pair[::-1],
            "incoming_edges": pair[:, None],
            "garment_type": jnp.zeros(2, jnp.int32),
            "body_type": jnp.zeros(2, jnp.int32),
            "world_mask": jnp.ones(2, bool),
        },
        n_node=None,
        n_edge=None,
    )
    if config.hierarchical:
        level = CoarseEdges(pair[::-1], pair, pair[::-1], jnp.ones(2, bool), jnp.ones(2, bool))
        for name in COARSE_SETS:
            graph.edges[name] = graph.edges["mesh"]
            graph.senders[name], graph.receivers[name] = level.senders, level.receivers
        graph.globals["coarse"] = (level,) * len(COARSE_SETS)
    return graph, Places(zeros((2, config.embedding_size)), jnp.ones(2, bool))
