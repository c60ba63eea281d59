"""Garment simulation in JAX: message passing with Laplacian smoothing, geodesic attention, physics.

The public names are loaded when they are first used; importing the package does no work.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

_NAMES = {
    "config": "SimConfig TrainConfig",
    "errors": "AssetError CapacityError CheckpointError ConfigError EslrError MeshError MissingExtraError "
    "MotionError NonFiniteError Status",
    "types": "Material Trajectory",
    "mesh.prepare": "prepare_garment",
    "networks.network": "Network",
    "pipeline.assets": "load_body load_garment load_model load_motion",
    "pipeline.report.run": "load_trajectory",
    "pipeline.report.score": "score_trajectory",
    "pose.motion": "pose_body",
    "simulation.archive": "load_scene save_scene",
    "simulation.batch": "simulate_batch",
    "simulation.plan": "plan_scene prepare_scene prepare_scenes",
    "simulation.rollout": "rollout rollout_scene step",
    "simulation.simulate": "simulate",
    "terms": "scene_terms",
}
_PUBLIC = {name: f"eslr_jax.{module}" for module, names in _NAMES.items() for name in names.split()}

__all__ = ["__version__", *_PUBLIC]

if TYPE_CHECKING:
    from eslr_jax.config import SimConfig, TrainConfig
    from eslr_jax.errors import (
        AssetError,
        CapacityError,
        CheckpointError,
        ConfigError,
        EslrError,
        MeshError,
        MissingExtraError,
        MotionError,
        NonFiniteError,
        Status,
    )
    from eslr_jax.mesh.prepare import prepare_garment
    from eslr_jax.networks.network import Network
    from eslr_jax.pipeline.assets import load_body, load_garment, load_model, load_motion
    from eslr_jax.pipeline.report.run import load_trajectory
    from eslr_jax.pipeline.report.score import score_trajectory
    from eslr_jax.pose.motion import pose_body
    from eslr_jax.simulation.archive import load_scene, save_scene
    from eslr_jax.simulation.batch import simulate_batch
    from eslr_jax.simulation.plan import plan_scene, prepare_scene, prepare_scenes
    from eslr_jax.simulation.rollout import rollout, rollout_scene, step
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
