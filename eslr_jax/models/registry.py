"""Named configurations, and the functions that make, apply and count a network's weights.

A network's weights are a plain dictionary: "params" are trained, "constants" are the random directions of the
attention, "statistics" the normalisers of HOOD's features and of the output. Only "params" belongs in an
optimiser.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import jraph
import numpy as np
from jaxtyping import Array, Bool, Float

from eslr_jax.config import ModelConfig
from eslr_jax.errors import CheckpointError
from eslr_jax.graph import features, normalizer
from eslr_jax.graph.build import feature_sizes
from eslr_jax.models.network import Encoded, EncodeProcessDecode
from eslr_jax.models.smoothing import EncodedVertices, SmoothingNetwork
from eslr_jax.types import Garment

Params = dict[str, Any]

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


MEDIUM = dataclasses.replace(
    SMALL, message_passing_steps=2, latent_size=64, attention_size=64, refinement_steps=4
)
DEEP = dataclasses.replace(
    MEDIUM, message_passing_steps=6, attention_blocks=2, refinement_steps=1, remat="products"
)
# One pass as a start for the solver: it costs three to four of its iterations and saves more.
SMOOTH = dataclasses.replace(
    _without_attention(SMALL), edge_latents=False, smoothing_steps=2, output="descent", refinement_steps=1
)
MODELS: dict[str, ModelConfig] = {
    "eslr-15": PAPER,
    "eslr-10": dataclasses.replace(PAPER, message_passing_steps=10, attention_blocks=3),
    "lsdmp-15": _without_attention(PAPER),
    "gsa-15": _without_smoothing(PAPER),
    "mgn-15": _without_attention(_without_smoothing(PAPER)),
    "mgn-48": dataclasses.replace(_without_attention(_without_smoothing(PAPER)), message_passing_steps=48),
    "eslr-small": SMALL,
    "lsdmp-small": _without_attention(SMALL),
    "gsa-small": _without_smoothing(SMALL),
    "mgn-small": _without_attention(_without_smoothing(SMALL)),
    "smooth-small": SMOOTH,
    "eslr-medium": MEDIUM,
    "mgn-medium": _without_attention(_without_smoothing(MEDIUM)),
    "eslr-deep": DEEP,
    "mgn-deep": _without_attention(_without_smoothing(DEEP)),
}


def make_network(config: ModelConfig) -> EncodeProcessDecode | SmoothingNetwork:
    """Return the module that a configuration describes."""
    return EncodeProcessDecode(config) if config.edge_latents else SmoothingNetwork(config)


def init_model(config: ModelConfig, seed: int = 0) -> Params:
    """Return new weights; they fit any garment.

    Args:
        config: Architecture.
        seed: Of the initial weights; that of the random attention directions is `config.seed`.
    """
    graph, garment = _example(config)
    statistics = _new_statistics(config)
    module = make_network(config)
    weights = jax.jit(lambda key: module.init(key, graph, garment, statistics))(jax.random.key(0))
    generator = np.random.default_rng(seed)

    def draw(path, spread):
        is_kernel = not any(word in path[-1].key for word in ("bias", "scale"))
        return spread * generator.standard_normal(spread.shape, np.float32) if is_kernel else spread

    trained = jax.tree_util.tree_map_with_path(draw, weights["params"])
    return {**weights, "params": trained, "statistics": statistics}


def apply_model(
    config: ModelConfig, params: Params, graph: jraph.GraphsTuple, garment: Garment
) -> Float[Array, "vertices outputs"]:
    """Return the network's raw output, see `scale_output`.

    Args:
        config: Architecture; static.
        params: Weights of `init_model`.
        graph: Of `build_graph` with the same config.
        garment: The same garment.
    """
    return make_network(config).apply(_variables(params), graph, garment, params["statistics"])


def encode_frame(
    config: ModelConfig, params: Params, frame: jraph.GraphsTuple, garment: Garment
) -> Encoded | EncodedVertices:
    """Do once per frame what does not change between its passes.

    Args:
        config: Architecture, with `features` "gradient"; static.
        params: Weights.
        frame: Of `build_frame_graph`.
        garment: The same garment.
    """
    return make_network(config).apply(_variables(params), frame, garment, method="encode_frame")


def apply_refinement(
    config: ModelConfig,
    params: Params,
    encoded: Encoded | EncodedVertices,
    changing: jraph.GraphsTuple,
    garment: Garment,
) -> Float[Array, "vertices outputs"]:
    """Return the raw output of one pass; equals `apply_model` on the joined graph.

    Args:
        config: Architecture, with `features` "gradient"; static.
        params: Weights.
        encoded: Of `encode_frame`.
        changing: Of `build_refinement_graph`.
        garment: The same garment.
    """

    def run(module: EncodeProcessDecode | SmoothingNetwork):
        return module.process(module.encode_refinement(encoded, changing), garment)

    return make_network(config).apply(_variables(params), method=run)


def scale_output(
    config: ModelConfig, params: Params, output: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """Return the output's vectors in physical units: metres, or for "acceleration" metres per frame squared.

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
) -> dict[str, normalizer.Normalizer]:
    """Return what the normalisers see in one graph; training only.

    Args:
        config: Architecture; static. Features of the "gradient" kind have no statistics.
        params: Weights.
        graph: Of `build_graph`.
        garment: The same garment.
        acceleration: Target accelerations [m per frame^2], those of the skinned garment in HOOD.

    Source: HOOD's `utils/normalization.py`.
    """
    measured = {}
    if config.features == "hood":
        nodes = make_network(config).apply(_variables(params), graph, method="with_types")
        nodes = jax.lax.stop_gradient(nodes)
        masks = {"garment": garment.vertex_mask, "mesh": garment.edge_mask}
        masks.update(dict.fromkeys(("body", "world", "world_reverse"), graph.globals.get("world_mask")))
        groups = (
            ("garment", nodes, features.HOOD_NODE_STATIC),
            ("mesh", {"mesh": graph.edges["mesh"]}, features.HOOD_MESH_STATIC),
            ("world", {name: rows for name, rows in graph.edges.items() if name != "mesh"}, 0),
        )
        for name, group, num_static in groups:
            if group:
                rows, mask = _stack_rows(group, masks)
                measured[name] = normalizer.measure(rows[:, : rows.shape[1] - num_static], mask)
    if config.output == "acceleration" and acceleration is not None:
        measured["output"] = normalizer.measure(acceleration, garment.vertex_mask)
    return measured


def merge_statistics(params: Params, measured: dict[str, normalizer.Normalizer]) -> Params:
    """Return weights whose normalisers have also seen what `measure_statistics` measured."""
    seen = params["statistics"]
    merged = {name: normalizer.merge(seen[name], new) for name, new in measured.items()}
    return {**params, "statistics": {**seen, **merged}}


def count_parameters(params: Params) -> int:
    """Return the number of trained weights."""
    return sum(leaf.size for leaf in jax.tree.leaves(params["params"]))


def check_params(config: ModelConfig, params: Params) -> None:
    """Compare weights with an architecture before they reach compiled code.

    Raises:
        CheckpointError: A weight is missing, unknown, or of another shape.
    """
    expected = _shapes(jax.eval_shape(lambda: init_model(config)))  # nothing is compiled or computed
    given = _shapes(params)
    for name in sorted(expected.keys() | given.keys()):
        if expected.get(name) != given.get(name):
            raise CheckpointError(
                f"these weights are for another architecture: {name} is {given.get(name, 'missing')}, "
                f"expected {expected.get(name, 'absent')}; load weights and configuration of the same model"
            )


def _shapes(params: Params) -> dict[str, tuple[int, ...]]:
    """Return the shape of every array by its path."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {jax.tree_util.keystr(path): np.shape(leaf) for path, leaf in leaves}


def _variables(params: Params) -> Params:
    """Return what the module itself reads."""
    return {name: params[name] for name in ("params", "constants") if name in params}


def _stack_rows(
    group: dict[str, Float[Array, "_ features"]], masks: dict[str, Bool[Array, " _"]]
) -> tuple[Float[Array, "rows features"], Bool[Array, " rows"]]:
    """Put rows that share a normaliser on top of each other."""
    return jnp.concatenate(list(group.values())), jnp.concatenate([masks[name] for name in group])


def _new_statistics(config: ModelConfig) -> dict[str, normalizer.Normalizer]:
    """Return empty normalisers for what the configuration normalises."""
    statistics = {}
    if config.features == "hood":
        sizes = feature_sizes(config)
        statistics["garment"] = normalizer.init_normalizer(
            sizes["garment"] + features.NUM_TYPES - features.HOOD_NODE_STATIC
        )
        statistics["mesh"] = normalizer.init_normalizer(sizes["mesh"] - features.HOOD_MESH_STATIC)
        statistics["world"] = normalizer.init_normalizer(sizes["world"])
    if config.output == "acceleration":
        statistics["output"] = normalizer.init_normalizer(3)
    return statistics


def _example(config: ModelConfig) -> tuple[jraph.GraphsTuple, Garment]:
    """Return the smallest graph and garment that touch every weight: one edge, two body points."""
    sizes = feature_sizes(config)
    zeros, pair = jnp.zeros, jnp.arange(2)
    names = {"world", "world_reverse"} if config.update_body else {"world"}
    graph = jraph.GraphsTuple(
        nodes={"garment": zeros((2, sizes["garment"])), "body": zeros((2, sizes["body"]))},
        edges={"mesh": zeros((2, sizes["mesh"])), **{name: zeros((2, sizes["world"])) for name in names}},
        senders={"mesh": pair[::-1], **dict.fromkeys(names, pair)},
        receivers={"mesh": pair, **dict.fromkeys(names, pair)},
        globals={
            "garment_type": zeros(2, jnp.int32),
            "body_type": zeros(2, jnp.int32),
            "world_mask": jnp.ones(2, bool),
            "world_slot": pair,
        },
        n_node=None,
        n_edge=None,
    )
    garment = Garment(
        rest_positions=zeros((2, 3)),
        faces=zeros((0, 3), jnp.int32),
        rest_areas=zeros(0),
        inverse_rest_frames=zeros((0, 2, 2)),
        hinges=zeros((0, 4), jnp.int32),
        hinge_rest_areas=zeros(0),
        hinge_rest_angles=zeros(0),
        vertex_areas=jnp.ones(2),
        senders=pair[::-1],
        receivers=pair,
        reverse_edges=pair[::-1],
        neighbors=pair[::-1, None],
        neighbor_mask=jnp.ones((2, 1), bool),
        face_incidence=zeros((2, 0), jnp.int32),
        hinge_incidence=zeros((2, 0), jnp.int32),
        edge_mask=jnp.ones(2, bool),
        vertex_mask=jnp.ones(2, bool),
        geodesic_embedding=zeros((2, config.embedding_size)),
        skin_weights=jnp.ones((2, 1)),
        skin_indices=zeros((2, 1), jnp.int32),
        is_pinned=zeros(2, bool),
    )
    return graph, garment
