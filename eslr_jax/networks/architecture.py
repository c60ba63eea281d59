"""What the networks of this package share: options, new weights, stacks of layers, and how they predict."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, Literal, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.config import check_numbers
from eslr_jax.errors import CheckpointError
from eslr_jax.networks import features, normalizer
from eslr_jax.networks.apply import Places, predict_acceleration, refine
from eslr_jax.networks.attention import orthogonal_projection
from eslr_jax.networks.build import COARSE_SETS, NUM_LEVELS, GraphKind, Topology, feature_sizes
from eslr_jax.networks.dense import MLP
from eslr_jax.networks.network import Example, Network, Prediction, Statistics, System
from eslr_jax.terms.term import FrameProblem
from eslr_jax.types import ClothState, CoarseEdges

START_GAIN = 0.02  # a new network hardly moves what it corrects or accelerates
_MAY_BE_ZERO = ("smoothing_steps", "attention_blocks", "hidden_layers", "seed")


@dataclasses.dataclass(frozen=True)
class Architecture(System):
    """Options of every network on a garment's graph.

    Without `correction_scale` it predicts an acceleration, as in the paper, from `features`: HOOD's, or these and
    the state that it integrates. With it, it reads scaled features with the potential's gradient, and moves the
    solver's initial guess.
    """

    latent_size: int = 128  # channels of vertices and edges (HOOD)
    hidden_layers: int = 2  # hidden layers of every MLP (HOOD)
    correction_scale: float | None = None  # [m] per unit of output that moves the solver's guess
    features: Literal["hood", "state"] = "hood"  # of an acceleration, see `networks.features`
    world_edge_radius: float = 0.03  # [m] (HOOD)
    precision: Literal["float32", "bfloat16"] = "float32"  # operands of the large products
    # What a backward pass computes again: whole layers, all but their products, or nothing.
    remat: Literal["layers", "products", "none"] = "products"

    module_class: ClassVar[Callable[[Any], nn.Module]]  # an `eslr.GraphModule`
    has_gates: ClassVar[bool] = False  # the output has two of them behind the vector
    is_combined: ClassVar[Any] = False  # a refinement step minimises over its directions

    def __post_init__(self) -> None:
        """Raise a ValueError that names the field of an impossible value."""
        check_numbers(self, may_be_zero=_MAY_BE_ZERO)

    @property
    def form(self) -> str:
        """What it predicts, in words."""
        if self.correction_scale is None:
            return "an acceleration, which Euler integrates (the paper's form)"
        return f"corrections of the solver's guess, {self.refinement_steps} a frame"

    @property
    def reads_gradient(self) -> bool:
        """Whether the potential's gradient is among the inputs."""
        return self.correction_scale is not None

    @property
    def graph(self) -> GraphKind:
        """What the network reads of a frame."""
        reads_state = self.features == "state" and not self.reads_gradient
        return GraphKind(self.reads_gradient, reads_state, world_edge_radius=self.world_edge_radius)

    def draw_constants(self) -> dict[str, Any]:
        """Return arrays that are not trained."""
        return {}

    def new_network(self, seed: int = 0, example: Example | None = None) -> Network:
        """Return a network with new weights, which fits any garment; see `System`."""

        @jax.jit
        def declare() -> Any:
            return self.module_class(self).init(jax.random.key(0), *_example(self))["params"]

        return Network(draw_weights(declare(), seed), self, _new_statistics(self), self.draw_constants())

    def predict(
        self, network: Network, problem: FrameProblem, state: ClothState, *, detach: bool
    ) -> Prediction:
        """Return the prediction for a frame; see `Network.predict`."""
        if self.reads_gradient:
            return refine(network, problem, state, detach=detach)
        return predict_acceleration(network, problem, state)

    def check(self, network: Network) -> None:
        """Raise a CheckpointError where shapes of weights don't fit the architecture; nothing is computed."""
        expected, given = _expected_shapes(self), _shapes(network)
        for name in sorted(expected.keys() | given.keys()):
            if expected.get(name) != given.get(name):
                raise CheckpointError(
                    f"these weights are for another architecture: {name} is {given.get(name, 'missing')}, "
                    f"expected {expected.get(name, 'absent')}; load the weights of this one"
                )


def draw_weights(spreads: dict[str, Any], seed: int) -> dict[str, Any]:
    """Return weights of a module's `init` with the kernels drawn; see `dense.kernel_spread`."""
    generator = np.random.default_rng(seed)

    def draw(path, spread):
        is_kernel = not any(word in path[-1].key for word in ("bias", "scale"))
        return spread * generator.standard_normal(spread.shape, np.float32) if is_kernel else spread

    return jax.tree_util.tree_map_with_path(draw, spreads)


@functools.cache
def _expected_shapes(config: Architecture) -> dict[str, tuple[int, ...]]:
    """Return the shape of every array of an architecture by its path."""
    return _shapes(jax.eval_shape(config.new_network))


def _shapes(network: Network) -> dict[str, tuple[int, ...]]:
    leaves = jax.tree_util.tree_leaves_with_path(network.parts)
    return {jax.tree_util.keystr(path): np.shape(leaf) for path, leaf in leaves}


def _new_statistics(config: Architecture) -> Statistics:
    """Return empty normalisers for what the configuration normalises."""
    if config.reads_gradient:
        return {}
    sizes = feature_sizes(config.graph)
    columns = {kind: sizes[kind] - static for kind, static in features.HOOD_STATIC.items()}
    columns["garment"] += features.NUM_TYPES + (NUM_LEVELS if config.graph.has_coarse_edges else 0)
    return {name: normalizer.init_normalizer(count) for name, count in (columns | {"output": 3}).items()}


def _example(config: Architecture) -> tuple[jraph.GraphsTuple, Statistics, Places]:
    """Return what a module reads: the smallest graph that touches every weight, one edge, two body points."""
    kind = config.graph
    sizes, zeros, pair = feature_sizes(kind), functools.partial(jnp.zeros, dtype=jnp.float32), jnp.arange(2)
    worlds = ("world", "world_reverse") if kind.has_reverse_edges else ("world",)
    edges = dict.fromkeys(
        ("mesh", *(COARSE_SETS if kind.has_coarse_edges else ())), zeros((2, sizes["mesh"]))
    )
    level = CoarseEdges(pair[::-1], pair, pair[::-1], jnp.ones(2, bool), jnp.ones(2, bool))
    graph = jraph.GraphsTuple(
        nodes={"garment": zeros((2, sizes["garment"])), "body": zeros((2, sizes["body"]))},
        edges={**edges, **dict.fromkeys(worlds, zeros((2, sizes["world"])))},
        senders={**dict.fromkeys(edges, pair[::-1]), **dict.fromkeys(worlds, pair)},
        receivers=dict.fromkeys((*edges, *worlds), pair),
        globals={
            "reverse_edges": pair[::-1],
            "incoming_edges": pair[:, None],
            "garment_type": jnp.zeros(2, jnp.int32),
            "body_type": jnp.zeros(2, jnp.int32),
            "world_mask": jnp.ones(2, bool),
            "coarse": (level,) * (len(edges) - 1),
        },
        n_node=jnp.array([2]),
        n_edge={name: jnp.array([2]) for name in (*edges, *worlds)},
    )
    width = getattr(config, "embedding_size", 0)  # what attention reads, where there is any
    return graph, _new_statistics(config), Places(zeros((2, width)), jnp.ones(2, bool))


@dataclasses.dataclass(frozen=True)
class TwoBranches(Architecture):
    """Options of a network whose decoder reads a stack of LSDMP layers and one of GSA blocks.

    The paper is silent on the fields marked "open". Their defaults fit its parameter counts, or else follow
    MeshGraphNet and HOOD. `networks.lsdmp` lists the open points that are no options.
    """

    message_passing_steps: int = 15  # LSDMP or MeshGraphNet layers (paper, Table V)
    smoothing_steps: int = 3  # Laplacian smoothings per layer (paper, eq. 3); 0 is MeshGraphNet
    attention_blocks: int = 4  # GSA blocks; 0 leaves the branch out
    attention_size: int = 64  # open: q, k, v width, one head; fits the paper's parameter count
    attention_features: int = 266  # open: random features, floor(64 ln 64), the Performer default
    embedding_size: int = 8  # open: k of the geodesic embedding
    embedding_mode: Literal["raw", "canonical", "landmarks"] = "canonical"  # axes of the embedding
    seed: int = 0  # of the random attention features

    is_attention_normed: ClassVar[bool] = False  # see `attention.GsaBlock`

    @property
    def garment_options(self) -> dict[str, Any]:
        """Arguments of `assets.load_garment` for a garment that the network reads."""
        return {"embedding_size": self.embedding_size, "embedding_mode": self.embedding_mode}

    def draw_constants(self) -> dict[str, Any]:
        """Return the random directions of the attention."""
        if not self.attention_blocks:
            return {}
        directions = orthogonal_projection(self.attention_features, self.attention_size, self.seed)
        return {"projection": jnp.asarray(directions, jnp.float32)}


def make_decoder(config: Architecture, num_branches: int = 1) -> MLP:
    """Return the decoder of the latents of one or more branches, side by side, into a vector and gates."""
    size = config.latent_size
    return MLP(
        num_branches * size,
        size,
        5 if config.has_gates else 3,
        config.hidden_layers,
        norm=False,
        output_gain=START_GAIN if config.reads_gradient or config.graph.reads_state else 1.0,
        precision=config.precision,
    )


def stack(module: type[nn.Module], config: Architecture, length: int, **attributes: Any) -> nn.Module:
    """Return `length` copies of a module, each with its own weights, compiled once.

    `Architecture.remat` says what the backward pass keeps of a layer: everything ("none" is recomputed), the
    results of its matrix products ("products"), or its inputs alone ("layers": a third of the memory, for a
    quarter more time). The module's first attribute is the configuration.
    """
    if config.remat != "none":
        keeps = jax.checkpoint_policies.dots_saveable if config.remat == "products" else None
        module = nn.remat(module, prevent_cse=False, policy=keeps)
    scanned = nn.scan(
        module,
        variable_axes={"params": 0},
        split_rngs={"params": True},
        in_axes=nn.broadcast,
        length=length,
    )
    return scanned(config, **attributes)


def world_mask(graph: jraph.GraphsTuple, dtype) -> Float[Array, "world_edges 1"]:
    """Return one for every world edge within reach, zero for the others; zeros without a body."""
    rows = graph.nodes["garment"].shape[0]
    mask = cast(Topology, graph.globals).get("world_mask", jnp.zeros(rows, bool))
    return mask.astype(dtype)[:, None]
