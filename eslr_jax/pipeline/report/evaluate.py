"""Evaluate a network on a split: optimality gap, and free rollouts; and without one of its parts (host)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from eslr_jax.config import Control, EvaluationOptions, SimConfig
from eslr_jax.errors import ConfigError, Status
from eslr_jax.mesh.prepare import pad_alike
from eslr_jax.networks.network import Network
from eslr_jax.pipeline.assets import load_body, load_garment, load_motion, load_splits, split_clips
from eslr_jax.pipeline.report.gap import ITERATIONS, GapOptions, OptimalityGap, gap_medians, measure_gap
from eslr_jax.pipeline.report.metrics import extremes, measure_frames
from eslr_jax.pipeline.report.report import mean_energies
from eslr_jax.pose.motion import back_and_forth, pose_body, still_motion
from eslr_jax.simulation.batch import simulate_scenes
from eslr_jax.simulation.plan import prepare_scene, shared_surface
from eslr_jax.simulation.simulate import good_frames, hold_last, raise_for_status
from eslr_jax.terms import FAST
from eslr_jax.types import Garment, Scene, Trajectory

EMBEDDING_CONTROLS: tuple[Control, ...] = ("no_embedding", "random_embedding")
_TRUTH_ITERATIONS = 300  # of the rollout that supplies teacher-forced states
_REFERENCE_ITERATIONS = 30  # of the solver's free rollouts, 0.2 % of the initial gap
_STILL_FRAMES = 120  # of the rest pose with lowered arms, for the drift
_STILL_ARM_ANGLE = -20.0  # [degrees] from the rest pose
_REACH = 0.06  # [m] of cloth, within which a body vertex counts as covered


def evaluate(
    network: Network,
    options: EvaluationOptions,
    *,
    iterations: int = 0,
    on_scene: Callable[[int, int, str], None] = lambda done, total, label: None,
) -> dict[str, Any]:
    """Evaluate a network; a garment's rollouts on all clips go together, see `simulate_scenes`.

    `iterations` are those of the solver behind the network. `on_scene` is called after each garment and clip
    with the count, the total and a label.

    Returns:
        Plain values: teacher-forced and on-policy gap [J] beside that of L-BFGS from the same states, and
        the measures of free rollouts; per garment and clip under `scenes`.

    Raises:
        ConfigError: There is no such split, or it is empty; or iterations are negative.
    """
    if iterations < 0:
        raise ConfigError(f"iterations = {iterations}; give 0 or more")
    garments = options.garments or tuple(load_splits()["garments"]["train"])
    clips = options.clips or split_clips(options.split)
    config = SimConfig(iterations=iterations, tolerance=0.0)
    body = load_body()
    scenes, forced, policy = [], [], []
    drifts: dict[str, float | None] = {}
    total = len(garments) * len(clips)
    # Padded to one bucket: all scenes then share one compiled rollout.
    load = partial(load_garment, vertices=options.vertices, **network.garment_options)  # type: ignore[arg-type]
    cloths = pad_alike([load(name) for name in garments])
    if options.control is not None:
        network = control_network(options.control, network)
        cloths = [control_garment(options.control, cloth) for cloth in cloths]
    surface = shared_surface(cloths, body)
    motions = [load_motion(clip) for clip in clips]

    def scenes_of(cloth: Garment, num_frames: int) -> list[Scene]:
        tracks = [back_and_forth(motion, num_frames) for motion in motions]
        poses = [pose_body(body, track, num_frames=num_frames) for track in tracks]
        return [prepare_scene(cloth, one, surface=surface, terms=FAST) for one in poses]

    for garment, cloth in zip(garments, cloths, strict=True):
        if options.gap_frames:
            worn = scenes_of(cloth, options.gap_frames)
            compared = GapOptions(every=options.every, refined=(config.iterations,))
            truth = SimConfig(iterations=_TRUTH_ITERATIONS, tolerance=0.0)
            # From the optimum's states, and from those of the network's own rollout.
            for stepper, steps, gaps in ((None, truth, forced), (network, config, policy)):
                for scene, trajectory in zip(worn, _roll(stepper, worn, steps), strict=True):
                    gaps.append(jax.device_get(measure_gap(network, trajectory, scene, compared)))
        worn = scenes_of(cloth, options.rollout_frames)
        free = _roll(network, worn, config)
        optima = _roll(None, worn, SimConfig(iterations=_REFERENCE_ITERATIONS, tolerance=0.0))
        for clip, scene, one, optimum in zip(clips, worn, free, optima, strict=True):
            apart = distance_mm(one, optimum, scene)
            row = {"garment": garment, "clip": clip, **measure_rollout(one, scene), "distance_mm": apart}
            scenes.append(row | {"optimum": measure_rollout(optimum, scene)})
            on_scene(len(scenes), total, f"{garment} {clip}")
        still = still_motion(body, _STILL_FRAMES, arm_angle=_STILL_ARM_ANGLE)
        resting = prepare_scene(cloth, pose_body(body, still), surface=surface, terms=FAST)
        drifts[garment] = _drift(network, resting, config)
    known = [drift for drift in drifts.values() if drift is not None]
    largest = max(known) if len(known) == len(drifts) else None
    return {
        "split": None if options.clips else options.split,
        "vertices": options.vertices,
        "garments": list(garments),
        "clips": list(clips),
        **({**_summarize(forced), "on_policy": _summarize(policy)} if forced else {}),
        "rollout": _pool_rollouts(scenes) | {"drift_mm_s": largest, "drift_mm_s_of": drifts},
        "scenes": scenes,
    }


def _roll(network: Network | None, scenes: list[Scene], config: SimConfig) -> list[Trajectory]:
    """Simulate all frames of scenes; a network's rollout that goes wrong stands still from there on."""
    trajectories = simulate_scenes(network, scenes, config=config)
    if network is None:
        for trajectory in trajectories:
            raise_for_status(trajectory)
    return [hold_last(one, scene.num_frames) for one, scene in zip(trajectories, scenes, strict=True)]


def _summarize(measured: list[OptimalityGap]) -> dict[str, Any]:
    """Return medians over all frames of all scenes: joules, and relative to the frame's own initial gap."""
    whole: OptimalityGap = jax.tree.map(lambda *parts: np.concatenate(parts), *measured)
    return {
        "frames": len(whole.optimum),
        **gap_medians(whole, next(iter(whole.refined.values()))),
        "lbfgs": {str(count): gap_medians(whole, whole.solver[count]) for count in ITERATIONS},
    }


def distance_mm(trajectory: Trajectory, reference: Trajectory, scene: Scene) -> float:
    """Return how far two rollouts of a scene are apart: mean over vertices and simulated frames [mm]."""
    apart = np.asarray(trajectory.positions)[1:] - np.asarray(reference.positions)[1:]
    return float(np.linalg.norm(apart[:, np.asarray(scene.garment.vertex_mask)], axis=-1).mean() * 1e3)


def measure_rollout(trajectory: Trajectory, scene: Scene) -> dict[str, Any]:
    """Return plain measures of a trajectory; `num_frames` are those before the first bad one.

    Raises:
        ConfigError: The scene has no body, against which penetration and coverage are measured.
    """
    if scene.body is None:
        raise ConfigError("penetration and coverage are measured against a body; give a scene with one")
    measures = jax.device_get(measure_frames(trajectory.positions, scene))
    is_real = np.asarray(scene.garment.vertex_mask)
    positions = np.asarray(trajectory.positions)[:, is_real]
    jerk = np.diff(positions, n=3, axis=0) / float(scene.timestep) ** 3
    skin = np.asarray(scene.body.positions)[-1]
    apart, _ = cKDTree(positions[-1]).query(skin, distance_upper_bound=_REACH)
    return {
        "finite": bool(np.isfinite(positions).all())
        and Status.NON_FINITE not in Status(int(trajectory.status)),
        "num_frames": good_frames(trajectory).num_frames,
        **mean_energies(trajectory),
        **extremes(measures, is_real),
        "jitter_m_s3": float(np.median(np.linalg.norm(jerk, axis=-1))),
        "coverage": float(np.isfinite(apart).mean()),
    }


def _drift(network: Network, scene: Scene, config: SimConfig) -> float | None:
    """Return the sideways speed of the garment's centre on a still body, over the last second [mm/s].

    None where the rollout went wrong: it stands still from there on.
    """
    (trajectory,) = _roll(network, [scene], config)
    if Status(int(trajectory.status)) != Status.OK:
        return None
    areas = np.asarray(scene.garment.vertex_areas)
    centre = np.einsum("v,tvc->tc", areas / areas.sum(), np.asarray(trajectory.positions))
    frames = round(1.0 / float(scene.timestep))
    moved = centre[-1] - centre[-1 - frames]
    return float(np.hypot(moved[0], moved[2]) * 1e3)


def _pool_rollouts(scenes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return means, and the worst where a bar is on the worst; `optimum` holds the same of the solver."""

    def all_of(name: str) -> list[Any]:
        return [scene[name] for scene in scenes]

    terms = all_of("terms")
    pooled = {
        "finite": all(all_of("finite")),
        **{name: float(np.max(all_of(name))) for name in ("stretch_p99", "penetration_p999_mm")},
        **{name: float(np.mean(all_of(name))) for name in ("total", "jitter_m_s3", "coverage")},
        "terms": {name: float(np.mean([one[name] for one in terms])) for name in terms[0]},
    }
    if "optimum" in scenes[0]:
        best = _pool_rollouts(all_of("optimum"))
        ratios = [scene["coverage"] / max(scene["optimum"]["coverage"], 1e-9) for scene in scenes]
        pooled["coverage_worst_ratio"] = float(np.min(ratios))
        pooled |= {"distance_mm": float(np.mean(all_of("distance_mm"))), "optimum": best}
    return pooled


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
