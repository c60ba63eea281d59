"""Several scenes at once: one compiled function for all, on one device or on many (host)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from eslr_jax.config import SimConfig
from eslr_jax.errors import ConfigError
from eslr_jax.mesh.padding import choose_bucket
from eslr_jax.networks.network import Network, check_network
from eslr_jax.simulation.plan import prepare_scenes
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.simulation.scene import Integrator
from eslr_jax.simulation.simulate import check_scene, enlarge_buffers, hold_last, simulate
from eslr_jax.terms import Term
from eslr_jax.types import BodyMotion, Garment, Material, Scene, Trajectory

SCENES = "scenes"  # axis of the device mesh
_SIDE_BY_SIDE = 64  # scenes on a GPU: there 64 T-shirts take 1.6 times as long as one


def simulate_batch(
    params: Network | None,
    garments: Sequence[Garment],
    poses: Sequence[BodyMotion],
    *,
    config: SimConfig | None = None,
    material: Material | Sequence[Material] | None = None,
    terms: tuple[Term, ...] | None = None,
    integrator: Integrator = "euler",
    substeps: int = 1,
    starts_at_rest: bool = False,
    batch_size: int | None = None,
    devices: Sequence[Any] | None = None,
) -> list[Trajectory]:
    """Simulate garment i on motion i for every i; scenes of like size share one compiled rollout.

    Garments are padded to the bucket of their vertex count, and those of one bucket are simulated together, see
    `simulate_scenes`. Frames that tear cloth are left as they are, other than by `simulate`.

    Args:
        params: A network, or None.
        garments: Of `load_garment` or `prepare_garment`; any sizes.
        poses: As many motions, of `pose_body`.
        config: Iterations and tolerance; the solver alone by default.
        material: Fabric of all, or one for each; isotropic and the same all over a garment. By default each
            garment has its own, of its file, or else cotton.
        terms: What to model where one of the scenes needs it; by default `scene_terms()`.
        integrator: How time is stepped.
        substeps: Number of equal parts in which a frame is simulated.
        starts_at_rest: Frame 0 stands still; else it moves as the body does.
        batch_size: Scenes per step on a device, see `rollout_scenes`; by default what is fast there.
        devices: Of `jax.devices()`, to spread the scenes over; by default the first alone.

    Returns:
        Trajectories in the order given, with the vertices of each garment. Their status is not checked, since
        one bad scene shall not cost the others; see `raise_for_status`.

    Raises:
        ConfigError: There are not as many motions or fabrics as garments; or `params` is no network; or a
            fabric, a constant or a timestep is out of its physical range.
        CheckpointError: The weights are for another architecture.
        MotionError: A motion has fewer than two frames.
    """
    config = config or SimConfig()
    check_network(params)
    materials = list(material) if isinstance(material, Sequence) else [material] * len(garments)
    if not len(garments) == len(poses) == len(materials):
        raise ConfigError(
            f"{len(garments)} garments, {len(poses)} motions and {len(materials)} fabrics; give one motion for "
            "each garment, and one fabric for all or one for each"
        )
    done: dict[int, Trajectory] = {}
    for group in _group_alike(garments, poses):
        scenes = prepare_scenes(
            [garments[i] for i in group],
            [poses[i] for i in group],
            [materials[i] for i in group],
            terms=terms,
            integrator=integrator,
            substeps=substeps,
            starts_at_rest=starts_at_rest,
        )
        together = simulate_scenes(params, scenes, config=config, batch_size=batch_size, devices=devices)
        for i, one in zip(group, together, strict=True):
            count = garments[i].vertex_mask.shape[0]  # without the rows that padding added
            done[i] = one.replace(
                positions=one.positions[:, :count],
                velocities=one.velocities[:, :count],
                friction_loads=one.friction_loads[:, :count],
            )
    return [done[i] for i in range(len(garments))]


def simulate_scenes(
    params: Network | None,
    scenes: Sequence[Scene],
    *,
    config: SimConfig | None = None,
    batch_size: int | None = None,
    devices: Sequence[Any] | None = None,
) -> list[Trajectory]:
    """Simulate scenes; those of the same shapes share one compiled rollout and go through it together.

    Args:
        params: A network, or None.
        scenes: Of `prepare_scene` or `prepare_scenes`.
        config: Iterations and tolerance; the solver alone by default.
        batch_size: Scenes per step on a device, see `rollout_scenes`; by default what is fast there.
        devices: Of `jax.devices()`, to spread the scenes over; by default the first alone.

    Returns:
        Trajectories in the order given; their status is not checked. A scene whose buffers were too small is
        simulated again by itself.

    Raises:
        MotionError: A scene has fewer than two frames.
        ConfigError: `params` is no network; or a fabric, a constant or a timestep is out of its physical range.
        CheckpointError: The weights are for another architecture.
    """
    config, devices = config or SimConfig(), list(devices or [])
    check_network(params)
    for scene in scenes:
        check_scene(scene)
    if batch_size is None:
        batch_size = 1 if jax.default_backend() == "cpu" else _SIDE_BY_SIDE
    mesh = Mesh(np.array(devices), (SCENES,)) if devices else None
    groups: dict[Any, list[int]] = {}
    for i, scene in enumerate(scenes):
        key = jax.tree.structure(scene), *(np.shape(leaf) for leaf in jax.tree.leaves(scene))
        groups.setdefault(key, []).append(i)
    done: dict[int, Trajectory] = {}
    for group in groups.values():
        # Devices get equal shares: the last scene is repeated, and what is simulated twice is dropped.
        missing = -len(group) % max(len(devices), 1)
        stacked = stack_scenes([scenes[i] for i in group + group[-1:] * missing])
        together = rollout_scenes(params, stacked, config, batch_size=batch_size, mesh=mesh)
        for row, i in enumerate(group):
            one = jax.tree.map(lambda leaf, row=row: leaf[row], together)
            if (larger := enlarge_buffers(scenes[i], one.demands)) is not None:
                one = simulate(params, larger, config=config, raises=False).trajectory
                one = hold_last(one, scenes[i].num_frames)  # it ends where something else goes wrong
            done[i] = one
    return [done[i] for i in range(len(scenes))]


def _group_alike(garments: Sequence[Garment], poses: Sequence[BodyMotion]) -> list[list[int]]:
    """Group scenes that can be stacked: like sizes of garments, frame counts and bodies."""
    groups: dict[tuple, list[int]] = {}
    for i, (garment, motion) in enumerate(zip(garments, poses, strict=True)):
        # The faces that are searched are those near the garments on the first body at rest.
        shape = (motion.faces, motion.is_obstacle, motion.rest_positions)
        body = hash(tuple(np.asarray(part).tobytes() for part in shape))
        columns = (garment.skin_weights.shape[1], garment.geodesic_embedding.shape[1])
        kept = (*columns, garment.coarse is None, garment.is_recut)  # what padding leaves as it is
        key = (choose_bucket(garment).vertices, motion.positions.shape[0], body, kept)
        groups.setdefault(key, []).append(i)
    return list(groups.values())


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
def rollout_scenes(
    params: Network | None, scenes: Scene, config: SimConfig, *, batch_size: int = 1, mesh: Mesh | None = None
) -> Trajectory:
    """Simulate stacked scenes; the trajectories come back stacked.

    Args:
        params: A network, or None.
        scenes: Of `stack_scenes`.
        config: Iterations and tolerance; static.
        batch_size: Scenes that go through a step together (vmap); the others wait (lax.map). One is fastest
            on a CPU, whose cores one garment keeps busy; a GPU wants as many as its memory holds.
        mesh: Devices to spread the scenes over evenly, with one axis named `SCENES`; static.
    """

    def run(params: Network | None, scenes: Scene) -> Trajectory:
        size = None if batch_size == 1 else batch_size  # of one, lax.map would make a batch all the same
        return jax.lax.map(lambda scene: rollout_scene(params, scene, config), scenes, batch_size=size)

    if mesh is None:
        return run(params, scenes)
    spread, everywhere = PartitionSpec(SCENES), PartitionSpec()
    sharded = jax.shard_map(run, mesh=mesh, in_specs=(everywhere, spread), out_specs=spread, check_vma=False)
    return sharded(params, scenes)
