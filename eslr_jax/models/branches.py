"""What every network has behind its encoders: stacks of layers, the attention branch beside them, the decoder."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Float

from eslr_jax.config import ModelConfig
from eslr_jax.errors import ConfigError
from eslr_jax.graph.operators import WorldTables, world_tables
from eslr_jax.models.attention import orthogonal_projection
from eslr_jax.models.gsa import GsaBlock
from eslr_jax.models.mlp import MLP
from eslr_jax.types import Garment

CORRECTION_GAIN = 0.02  # a new network then hardly changes the guess that it corrects
OUTPUT_SIZE = {"acceleration": 3, "correction": 3, "descent": 5, "subspace": 5}  # a vector, and two gates


class TwoBranches(nn.Module):
    """A network whose decoder reads a stack of layers and, with `attention_blocks`, one of GSA blocks."""

    config: ModelConfig

    def declare_decoder(self) -> None:
        """Declare the attention branch and the decoder; for `setup`."""
        config, size = self.config, self.config.latent_size
        if config.attention_blocks:
            self.blocks = stack(GsaBlock, config, config.attention_blocks)
            self.projection = self.variable("constants", "projection", _projection, config)
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
        garment: Garment,
    ) -> Float[Array, "vertices outputs"]:
        """Run the attention branch and decode.

        Args:
            processed: Vertex latents behind the stack of layers.
            encoded: Those of the encoder, which the attention starts from.
            garment: Gives the embedding and the mask.
        """
        config = self.config
        hidden = self.decoder.start(processed, 0, bias=True)
        if config.attention_blocks:
            _check_embedding(config, garment)
            inputs = (garment.geodesic_embedding, garment.vertex_mask, self.projection.value)
            attended, _ = self.blocks(encoded, inputs)
            hidden = hidden + self.decoder.start(attended, config.latent_size)
        return self.decoder.finish(hidden)


def stack(module: type[nn.Module], config: ModelConfig, length: int) -> nn.Module:
    """Return `length` copies of a module with their own weights, compiled once.

    Of a layer, the backward pass keeps everything ("none" is recomputed), the results of its matrix products
    ("products"), or its inputs alone ("layers": a third of the memory, for a quarter more time).
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
    return scanned(config)


def graph_world_tables(graph: jraph.GraphsTuple, dtype) -> WorldTables:
    """Return the tables of a graph's world edges."""
    entries = graph.globals
    return world_tables(entries["world_slot"], graph.receivers["world"], entries["world_mask"], dtype)


def _check_embedding(config: ModelConfig, garment: Garment) -> None:
    """Compare the garment's geodesic embedding with the one that the network expects.

    Raises:
        ConfigError: They have different numbers of coordinates.
    """
    size = garment.geodesic_embedding.shape[1]
    if size != config.embedding_size:
        raise ConfigError(
            f"the garment has {size} geodesic coordinates and the model embedding_size = "
            f"{config.embedding_size}; prepare the garment with that embedding_size"
        )


def _projection(config: ModelConfig) -> Float[Array, "features size"]:
    """Return the random directions of the attention, the same in every block."""
    directions = orthogonal_projection(config.attention_features, config.attention_size, config.seed)
    return jnp.asarray(directions, jnp.float32)
