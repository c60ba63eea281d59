"""What every network has behind its encoders: stacks of layers, and the decoder."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Float

from eslr_jax.networks.architecture import Architecture
from eslr_jax.networks.attention import orthogonal_projection
from eslr_jax.networks.build import Topology
from eslr_jax.networks.mlp import MLP

CORRECTION_GAIN = 0.02  # a new network hardly moves the guess that it corrects


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

    is_attention_normed: ClassVar[bool] = False  # see `gsa.GsaBlock`

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
    """Return the decoder of latents of one or more branches, into a vector and gates.

    Args:
        config: Architecture.
        num_branches: Whose latents stand side by side.
    """
    size = config.latent_size
    return MLP(
        num_branches * size,
        size,
        5 if config.has_gates else 3,
        config.hidden_layers,
        norm=False,
        output_gain=CORRECTION_GAIN if config.reads_gradient else 1.0,
        precision=config.precision,
    )


def stack(module: type[nn.Module], config: Architecture, length: int, **attributes: Any) -> nn.Module:
    """Return `length` copies of a module, each with its own weights, compiled once.

    `Architecture.remat` says what the backward pass keeps of a layer: everything ("none" is recomputed), the
    results of its matrix products ("products"), or its inputs alone ("layers": a third of the memory, for a
    quarter more time).

    Args:
        module: Class of the module, with the configuration as its first attribute.
        config: Architecture.
        length: Number of copies.
        **attributes: Other attributes of the module.
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


def world_mask(graph: jraph.GraphsTuple, dtype) -> Float[Array, "vertices 1"]:
    """Return one for every vertex with a world edge, zero for the others; zeros without a body."""
    rows = graph.nodes["garment"].shape[0]
    mask = cast(Topology, graph.globals).get("world_mask", jnp.zeros(rows, bool))
    return mask.astype(dtype)[:, None]
