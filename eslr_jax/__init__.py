"""Garment simulation in JAX: message passing with Laplacian smoothing, geodesic attention, physics.

The public names are loaded when they are first used; importing the package does no work.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_PUBLIC = {
    "SimConfig": "eslr_jax.config",
    "TrainConfig": "eslr_jax.config",
    "Network": "eslr_jax.models.network",
    "EslrError": "eslr_jax.errors",
    "Material": "eslr_jax.types",
    "Trajectory": "eslr_jax.types",
    "load_body": "eslr_jax.assets",
    "load_garment": "eslr_jax.assets",
    "load_model": "eslr_jax.assets",
    "load_motion": "eslr_jax.assets",
    "load_trajectory": "eslr_jax.evaluation.run",
    "pose_body": "eslr_jax.body.motion",
    "prepare_garment": "eslr_jax.geometry.prepare",
    "plan_scene": "eslr_jax.scene.plan",
    "prepare_scene": "eslr_jax.scene.plan",
    "rollout": "eslr_jax.simulation.rollout",
    "scene_terms": "eslr_jax.terms",
    "score_trajectory": "eslr_jax.evaluation.score",
    "simulate": "eslr_jax.simulation.simulate",
    "step": "eslr_jax.simulation.rollout",
    "load_scene": "eslr_jax.scene.archive",
    "save_scene": "eslr_jax.scene.archive",
    "simulate_batch": "eslr_jax.simulation.batch",
}

__all__ = ["__version__", *_PUBLIC]

if TYPE_CHECKING:
    from eslr_jax.assets import load_body, load_garment, load_model, load_motion
    from eslr_jax.body.motion import pose_body
    from eslr_jax.config import SimConfig, TrainConfig
    from eslr_jax.errors import EslrError
    from eslr_jax.evaluation.run import load_trajectory
    from eslr_jax.evaluation.score import score_trajectory
    from eslr_jax.geometry.prepare import prepare_garment
    from eslr_jax.models.network import Network
    from eslr_jax.scene.archive import load_scene, save_scene
    from eslr_jax.scene.plan import plan_scene, prepare_scene
    from eslr_jax.simulation.batch import simulate_batch
    from eslr_jax.simulation.rollout import rollout, step
    from eslr_jax.simulation.simulate import simulate
    from eslr_jax.terms import scene_terms
    from eslr_jax.types import Material, Trajectory


def __getattr__(name: str) -> Any:
    """Load a public name."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'eslr_jax' has no attribute {name!r}")
    value = getattr(importlib.import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
