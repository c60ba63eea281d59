"""Refinement: a few gradient steps on the potential a frame, each corrected by the network.

A step goes along the preconditioned gradient and along the last correction, each with a gate per vertex, and
along what the network adds. So a new network is plain preconditioned descent. Its layers are those of
`networks.eslr`.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

from eslr_jax.networks.architecture import Architecture, TwoBranches
from eslr_jax.networks.eslr import EncodeProcessDecode
from eslr_jax.networks.network import network


@dataclasses.dataclass(frozen=True)
class GatedRefinement(Architecture):
    """Options of a network that takes gradient steps."""

    correction_scale: float = 0.005  # [m] per unit of output that moves the guess
    # "subspace" takes the combination of the three directions that minimises the potential, "descent" their sum.
    output: Literal["descent", "subspace"] = "subspace"
    refinement_steps: int = 12  # per frame, gradient recomputed between

    has_gates: ClassVar[bool] = True

    @property
    def is_combined(self) -> bool:
        """Whether a step minimises over its directions."""
        return self.output == "subspace"


@network("refinement")
@dataclasses.dataclass(frozen=True)
class Refinement(GatedRefinement, TwoBranches):
    """Messages, smoothings and attention in every step."""

    latent_size: int = 32  # a quarter of the paper's
    remat: Literal["layers", "products", "none"] = "none"  # what a backward pass computes again
    message_passing_steps: int = 1  # layers
    attention_blocks: int = 1  # GSA blocks; 0 leaves the branch out
    attention_size: int = 32  # q, k, v width, one head
    attention_features: int = 64  # random features

    module_class = EncodeProcessDecode
    is_attention_normed: ClassVar[bool] = True
