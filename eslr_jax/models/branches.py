"""What every network has behind its encoders: stacks of layers, the attention branch beside them, the decoder."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Bool, Float

from eslr_jax.config import ModelConfig
from eslr_jax.errors import ConfigError
from eslr_jax.graph.build import Topology
from eslr_jax.models.gsa import GsaBlock
from eslr_jax.models.mlp import MLP

CORRECTION_GAIN = 0.02  # a new network hardly moves the guess that it corrects
OUTPUT_SIZE = {"acceleration": 3, "correction": 3, "descent": 5, "subspace": 5}  # a vector, and two gates


class Places(NamedTuple):
    """Where the garment's vertices lie on it."""

    embedding: Float[Array, "vertices embedding"]  # geodesic embedding [m]
    mask: Bool[Array, " vertices"]  # vertices that are not padding


class TwoBranches(nn.Module):
    """A network whose decoder reads a stack of layers and, with `attention_blocks`, one of GSA blocks."""

    config: ModelConfig

    def declare_decoder(self) -> None:
        """Declare the attention branch and the decoder; for `setup`."""
        config, size = self.config, self.config.latent_size
        if config.attention_blocks:
            self.blocks = stack(GsaBlock, config, config.attention_blocks)
            shape = (config.attention_features, config.attention_size)
            self.projection = self.variable("constants", "projection", jnp.zeros, shape)
        self.decoder = MLP(
            2 * size if config.attention_blocks else size,
            size,
            OUTPUT_SIZE[config.output],
            config.hidden_layers,
            norm=False,
            output_gain=1.0 if config.output == "acceleration" else CORRECTION_GAIN,
            precision=config.precision,
        )

    def decode(
        self,
        processed: Float[Array, "vertices latent"],
        encoded: Float[Array, "vertices latent"],
        places: Places,
    ) -> Float[Array, "vertices outputs"]:
        """Run the attention branch and decode.

        Args:
            processed: Vertex latents behind the stack of layers, shape [vertices, latent].
            encoded: Vertex latents of the encoder, from which attention starts, shape [vertices, latent].
            places: Embedding and mask of the vertices.

        Raises:
            ConfigError: The garment has another number of geodesic coordinates than the network reads.
        """
        config = self.config
        hidden = self.decoder.start(processed, 0, bias=True)
        if config.attention_blocks:
            size = places.embedding.shape[1]
            if size != config.embedding_size:
                raise ConfigError(
                    f"the garment has {size} geodesic coordinates and the model embedding_size = "
                    f"{config.embedding_size}; prepare the garment with that embedding_size"
                )
            attended, _ = self.blocks(encoded, (*places, self.projection.value))
            hidden = hidden + self.decoder.start(attended, config.latent_size)
        return self.decoder.finish(hidden)


def stack(module: type[nn.Module], config: ModelConfig, length: int, **attributes: Any) -> nn.Module:
    """Return `length` copies of a module, each with its own weights, compiled once.

    `ModelConfig.remat` says what the backward pass keeps of a layer: everything ("none" is recomputed), the
    results of its matrix products ("products"), or its inputs alone ("layers": a third of the memory, for a
    quarter more time).

    Args:
        module: Class of the module, with `ModelConfig` as its first attribute.
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
