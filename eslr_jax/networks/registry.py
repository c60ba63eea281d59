"""Named networks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from eslr_jax.config import from_dict
from eslr_jax.errors import ConfigError
from eslr_jax.networks.architecture import Architecture
from eslr_jax.networks.eslr import Eslr
from eslr_jax.networks.hood import Hood
from eslr_jax.networks.network import System, find_system
from eslr_jax.networks.refinement import Refinement
from eslr_jax.networks.smoothing import Smoothing

PAPER = Eslr()
# The paper's network scaled to 1k vertices. Garments are 21 hops across at 1k, and some 60 in the paper. The
# ratio of layers to hops, and that of width to layers, are the paper's. One application a frame, HOOD's
# features, an acceleration.
SHALLOW = Eslr(
    message_passing_steps=5,
    attention_blocks=2,
    latent_size=64,
    attention_size=32,
    attention_features=110,  # floor(32 ln 32)
    remat="none",
)
SMALL = Refinement()
# HOOD's MeshGraphNet "fine15", which updates body rows.
FINE = Eslr(smoothing_steps=0, attention_blocks=0, update_body=True)


def _plain(config: Any) -> Any:
    """Return MeshGraphNet: neither smoothing nor attention."""
    return dataclasses.replace(config, smoothing_steps=0, attention_blocks=0)


MODELS: dict[str, Architecture] = {
    "eslr-15": PAPER,
    "eslr-10": dataclasses.replace(PAPER, message_passing_steps=10, attention_blocks=3),
    "lsdmp-15": dataclasses.replace(PAPER, attention_blocks=0),
    "gsa-15": dataclasses.replace(PAPER, smoothing_steps=0),
    "mgn-15": FINE,
    "mgn-48": dataclasses.replace(FINE, message_passing_steps=48),
    "hood": Hood(),
    "eslr-5": SHALLOW,
    "lsdmp-5": dataclasses.replace(SHALLOW, attention_blocks=0),
    "gsa-5": dataclasses.replace(SHALLOW, smoothing_steps=0),
    "mgn-5": _plain(SHALLOW),
    "hood-5": Hood(steps_per_stage=1, latent_size=64, remat="none"),
    "mgn-16": dataclasses.replace(_plain(SHALLOW), message_passing_steps=16),
    "eslr-small": SMALL,
    "lsdmp-small": dataclasses.replace(SMALL, attention_blocks=0),
    "gsa-small": dataclasses.replace(SMALL, smoothing_steps=0),
    "mgn-small": _plain(SMALL),
    "smooth-small": Smoothing(),
}


def read_system(values: Any) -> System:
    """Return the system that plain values describe.

    Args:
        values: A name, or a table with a name as `base` and values that differ from it. The name is one of
            `MODELS`, or that of a registered system; MODULE:NAME for one's own.

    Raises:
        ConfigError: There is no such name, or an option is unknown or impossible.
    """
    if not isinstance(values, str | Mapping):
        raise ConfigError(f"the model is {values!r}; give a name or a table")
    given = {"base": values} if isinstance(values, str) else dict(values)
    name = given.pop("base", None)
    if not isinstance(name, str):
        raise ConfigError('the model has no base; add one, such as base = "eslr-small"')
    if name in MODELS:
        return from_dict(type(MODELS[name]), dataclasses.asdict(MODELS[name]) | given, where="model.")
    system = find_system(name)
    if system is None:
        raise ConfigError(
            f"unknown model {name!r}; there are {', '.join(MODELS)}, and MODULE:NAME for a class of your own, "
            'marked by @network("NAME")'
        )
    return from_dict(system, given, where="model.")
