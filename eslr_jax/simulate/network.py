"""The network as a stepper."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float

from eslr_jax.config import ModelConfig
from eslr_jax.physics.problem import FrameProblem
from eslr_jax.types import ClothState, Garment, Material


def network_step(
    params: Any,
    garment: Garment,
    material: Material,
    problem: FrameProblem,
    state: ClothState,
    config: ModelConfig,
) -> Float[Array, "vertices 3"]:
    """TODO."""
    raise NotImplementedError
