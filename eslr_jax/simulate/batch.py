"""Rollouts of several scenes at once: one compiled function for all, on one device or on many."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from eslr_jax.config import SimConfig
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.simulate.scan import simulate_scene
from eslr_jax.types import Scene, Trajectory

SCENES = "scenes"  # axis of the device mesh


def stack_scenes(scenes: list[Scene]) -> Scene:
    """Stack scenes along a new leading axis.

    Args:
        scenes: Garments padded to one bucket, one searched body surface, like frame counts; either all have
            pin targets, or none.

    Raises:
        ValueError: The scenes differ in structure or in shape.
    """
    first = jax.tree.structure(scenes[0])
    if any(jax.tree.structure(scene) != first for scene in scenes):
        raise ValueError("scenes differ in what they model or in their number of frames; stack like ones")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)


@partial(jax.jit, static_argnames=("config", "batch_size", "mesh"))
def simulate_scenes(
    params: Any,
    scenes: Scene,
    parameters: PhysicsParameters,
    config: SimConfig,
    *,
    batch_size: int = 1,
    mesh: Mesh | None = None,
) -> Trajectory:
    """Simulate stacked scenes; the trajectories come back stacked.

    Args:
        params: Weights of the network; None for the physics simulator.
        scenes: Of `stack_scenes`.
        parameters: Physical constants, the same for all; traced.
        config: Choices that shape the compiled step; static.
        batch_size: Scenes that go through a step together (vmap); the others wait (lax.map). One is fastest
            on a CPU, whose cores one garment keeps busy; a GPU wants as many as its memory holds.
        mesh: Devices to spread the scenes over evenly, with one axis named `SCENES`; static.
    """

    def run(params: Any, scenes: Scene, parameters: PhysicsParameters) -> Trajectory:
        def one(scene: Scene) -> Trajectory:
            return simulate_scene(params, scene, parameters, config)

        return jax.lax.map(one, scenes, batch_size=batch_size)

    if mesh is None:
        return run(params, scenes, parameters)
    spread, everywhere = PartitionSpec(SCENES), PartitionSpec()
    sharded = jax.shard_map(
        run, mesh=mesh, in_specs=(everywhere, spread, everywhere), out_specs=spread, check_vma=False
    )
    return sharded(params, scenes, parameters)
