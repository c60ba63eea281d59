"""Checks of shapes and types in the tests: every function of a kernel room holds what its annotations say."""

from __future__ import annotations

from collections.abc import Callable

from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

KERNELS = [
    "eslr_jax.numerics",
    "eslr_jax.pose.lbs",
    "eslr_jax.contact",
    "eslr_jax.networks",
    "eslr_jax.solver",
    "eslr_jax.terms",
    "eslr_jax.simulation.scene",
    "eslr_jax.simulation.frame",
    "eslr_jax.simulation.stepper",
    "eslr_jax.simulation.rollout",
    "eslr_jax.training.loss",
]


_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float


def check(function: Callable) -> Callable:
    """Return the function with its arguments and its result checked.

    Constructors are let through: JAX fills pytrees with axes, masks and shapes as it maps over them.
    """
    return function if function.__name__ == "__init__" else _checked(function)


def check_kernels() -> None:
    """Check the kernel rooms from here on; call this before they are imported."""
    install_import_hook(KERNELS, "shapes.check")
