"""Controls: a network without one of its parts, which shows what that part contributes."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from eslr_jax.config import Control
from eslr_jax.errors import ConfigError
from eslr_jax.networks.network import Network
from eslr_jax.types import Garment

EMBEDDING_CONTROLS: tuple[Control, ...] = ("no_embedding", "random_embedding")


def control_network(control: Control, network: Network) -> Network:
    """Return a trained network, one of this package's, without what a control takes away.

    "untrained" has weights of a new network, on the trained one's statistics of features. "no_decoder" has a last
    layer of zeros: what is left are gradient steps, and the guess.

    Raises:
        ConfigError: The network has no such part.
    """
    if control in EMBEDDING_CONTROLS and not getattr(network.config, "attention_blocks", 0):
        raise ConfigError(f"control {control} takes geodesic coordinates away, which only attention reads")
    if control == "untrained":
        return network.replace(params=network.config.new_network().params)
    if control == "no_decoder":
        decoder, last = network.params["decoder"], network.config.hidden_layers
        names = (f"kernel_{last}", f"bias_{last}")
        zeros = {name: jnp.zeros_like(decoder[name]) for name in names}
        return network.replace(params={**network.params, "decoder": {**decoder, **zeros}})
    return network


def control_garment(control: Control, garment: Garment) -> Garment:
    """Return a garment without what a control takes away.

    "no_embedding" has geodesic coordinates of zero, "random_embedding" normal numbers of the same spread, equal
    for equal garments however they are padded.
    """
    embedding = garment.geodesic_embedding
    if control == "no_embedding":
        return garment.replace(geodesic_embedding=jnp.zeros_like(embedding))
    if control == "random_embedding":
        is_real = garment.vertex_mask[:, None]
        # One key a vertex, so that padding does not change what is drawn.
        keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(0)))(jnp.arange(len(embedding)))
        noise = jax.vmap(lambda key: jax.random.normal(key, embedding.shape[1:]))(keys)
        spread = jnp.std(embedding, axis=0, keepdims=True, where=is_real)
        return garment.replace(geodesic_embedding=jnp.where(is_real, noise * spread, 0.0))
    return garment
