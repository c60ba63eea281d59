"""Networks applied to a graph, and the statistics of its features."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Bool, Float

from eslr_jax.networks import features, normalizer
from eslr_jax.networks.build import COARSE_SETS, Rows, Topology
from eslr_jax.networks.network import Network, Statistics
from eslr_jax.types import Garment


class Places(NamedTuple):
    """Where the garment's vertices lie on it."""

    embedding: Float[Array, "vertices embedding"]  # geodesic embedding [m]
    mask: Bool[Array, " vertices"]  # vertices that are not padding


def apply_model(
    network: Network, graph: jraph.GraphsTuple, garment: Garment
) -> Float[Array, "vertices outputs"]:
    """Return the network's raw output; see `scale_output`.

    Args:
        network: The network.
        graph: Graph of `build_graph`, of the network's kind.
        garment: The graph's garment, for its geodesic embedding and vertex mask.
    """
    return _call(network, graph, _places(garment), network.statistics)


def encode_frame(network: Network, graph: jraph.GraphsTuple) -> Any:
    """Return what all refinement steps of a frame share.

    Args:
        network: One that reads the potential's gradient.
        graph: Graph of `build_frame_graph`.
    """
    return _call(network, graph, method="encode_frame")


def apply_refinement(
    network: Network, encoded: Any, changing: jraph.GraphsTuple, garment: Garment
) -> Float[Array, "vertices outputs"]:
    """Return the raw output of one refinement step; equals `apply_model` on the joined graph.

    Args:
        network: One that reads the potential's gradient.
        encoded: Result of `encode_frame`.
        changing: Graph of `build_refinement_graph`.
        garment: The graph's garment, for its geodesic embedding and vertex mask.
    """

    def run(module: Any):
        return module.process(module.encode_refinement(encoded, changing), _places(garment))

    return _call(network, method=run)


def _call(network: Network, *args: Any, **options: Any) -> Any:
    """Apply a network's module."""
    weights = {"params": network.params}
    if network.constants:
        weights["constants"] = network.constants
    return network.config.module.apply(weights, *args, **options)


def scale_output(network: Network, output: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Return the output's vectors in physical units: metres, or for an acceleration metres per frame squared.

    Args:
        network: The network.
        output: First three columns of the raw output, shape [vertices, 3].

    Source: HOOD's output normaliser, applied backwards, for accelerations.
    """
    if network.config.reads_gradient:
        return output * network.config.correction_scale
    return normalizer.inverse(network.statistics["output"], output)


def measure_statistics(
    network: Network, graph: jraph.GraphsTuple, garment: Garment, acceleration: Float[Array, "vertices 3"]
) -> Statistics:
    """Return the statistics of one graph; none for features that are not normalised.

    Args:
        network: The network.
        graph: Graph of `build_graph`.
        garment: The graph's garment, for its masks.
        acceleration: Target accelerations [m per frame^2], shape [vertices, 3]; in HOOD those of the skinned
            garment.

    Source: HOOD's `utils/normalization.py`.
    """
    measured: Statistics = {}
    if network.config.reads_gradient:
        return measured
    nodes = jax.lax.stop_gradient(_call(network, graph, method="with_types"))
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
    measured["output"] = normalizer.measure(acceleration, garment.vertex_mask)
    return measured


def merge_statistics(network: Network, measured: Statistics) -> Network:
    """Return a network whose normalisers include what was measured."""
    seen = network.statistics
    merged = {name: normalizer.merge(seen[name], new) for name, new in measured.items()}
    return network.replace(statistics={**seen, **merged})


def _places(garment: Garment) -> Places:
    """Return embedding and mask of a garment's vertices."""
    return Places(garment.geodesic_embedding, garment.vertex_mask)
