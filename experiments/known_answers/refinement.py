"""How far motions are from finer ones: a walk by tolerance, timestep and mesh; a strip by the integrator's order.

The strip swings without folds, in frames that are solved to rounding.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax import SimConfig, load_body, load_garment, load_motion, pose_body, prepare_scene, rollout_scene
from eslr_jax.mesh.closest import closest_points
from eslr_jax.simulation.scene import Integrator
from eslr_jax.simulation.simulate import raise_for_status
from eslr_jax.terms import FAST
from known_answers.strip import strip

CLIP, FPS = "cmu_016_32", 30.0
_FINEST = 400  # iterations that stand for none left to do
_SECONDS = 0.4  # of the swing
_FRAME = 0.1  # [s]
_PARTS = (2, 4, 8, 16)  # of it, each of which is a step
_FINEST_PARTS = 64
_TURN = 0.5  # [rad/s], about the upper end; faster, the pull outwards would make it ring


class Refinement(NamedTuple):
    """How far a rollout is from the same one with one thing refined."""

    what: str
    setting: str
    reference: str
    rms_mm: float  # over vertices and frames
    p99_mm: float


def run(garment: str, vertices: str, frames: int, *, iterations: int, steps: int = 1, integrator="bdf2"):
    """Return positions [m] and faces of a walk at 30 frames a second, each of so many steps of iterations."""
    cloth = load_garment(garment, vertices=vertices)
    poses = pose_body(load_body(), load_motion(CLIP), fps=FPS * steps, num_frames=(frames - 1) * steps + 1)
    scene = prepare_scene(cloth, poses, integrator=integrator, terms=FAST)
    # Traced, so that all numbers of iterations share a program.
    trajectory = rollout_scene(None, scene, SimConfig(iterations=_FINEST), jnp.int32(iterations))
    raise_for_status(trajectory)
    return np.asarray(trajectory.positions, np.float64)[::steps], np.asarray(cloth.faces)


def _apart(found: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Return the distance of the same vertices [mm], rms and for 99 %, without frame 0."""
    return _summary(np.linalg.norm(found[1:] - reference[1:], axis=-1))


def _off_surface(found: np.ndarray, reference: np.ndarray, faces: np.ndarray) -> tuple[float, float]:
    """Return the distance of vertices from another mesh [mm], rms and for 99 %; sliding along it is not seen."""
    distances = []
    for points, surface in zip(found[1:], reference[1:], strict=True):
        nearest, weights = closest_points(points, surface, faces)
        at = np.einsum("pk,pkx->px", weights, surface[faces[nearest]])
        distances.append(np.linalg.norm(points - at, axis=1))
    return _summary(np.array(distances))


def _summary(distance: np.ndarray) -> tuple[float, float]:
    return 1e3 * float(np.sqrt(np.mean(distance**2))), 1e3 * float(np.quantile(distance, 0.99))


def refine(is_smoke: bool, garment: str = "tshirt") -> Iterator[Refinement]:
    """Yield how far a walk is from itself with more iterations, smaller steps and a finer mesh."""
    frames = 4 if is_smoke else 31
    best, faces = run(garment, "1k", frames, iterations=_FINEST)
    for iterations in (20,) if is_smoke else (10, 20, 40, 100):
        found, _ = run(garment, "1k", frames, iterations=iterations)
        yield Refinement("tolerance", f"{iterations} iterations", f"{_FINEST}", *_apart(found, best))
    if is_smoke:  # the others run the same code
        return
    finest = 8
    for integrator in ("euler", "bdf2"):
        reference, _ = run(garment, "1k", frames, iterations=100, steps=finest, integrator=integrator)
        for steps in (1, 2, 4):
            found, _ = run(garment, "1k", frames, iterations=100, steps=steps, integrator=integrator)
            label = f"{integrator}, 1/{FPS * steps:g} s"
            yield Refinement("timestep", label, f"1/{FPS * finest:g} s", *_apart(found, reference))
    for coarse, fine in (("1k", "4k"), ("4k", "10k")):
        found, _ = run(garment, coarse, frames, iterations=200)
        reference, faces = run(garment, fine, frames, iterations=200)
        yield Refinement("mesh", coarse, fine, *_off_surface(found, reference, faces))


class Order(NamedTuple):
    """How far a swing is from the same one in finer steps."""

    integrator: str
    timestep_ms: float
    rms_mm: float  # over vertices, at the end
    order: float | None  # by which the error fell since the step before


def orders(is_smoke: bool) -> Iterator[Order]:
    """Yield the error at each timestep, against BDF2 in the finest one."""
    hanging = strip("euler", frames=61, is_pinned=True, timestep=0.1, tilt=0.0)
    rest = rollout_scene(None, hanging, SimConfig(iterations=100)).positions[-1]
    best = _end(rest, "bdf2", 8 if is_smoke else _FINEST_PARTS)
    for integrator in ("euler", "bdf2"):
        before = None
        for parts in _PARTS[:1] if is_smoke else _PARTS:
            away = np.linalg.norm(_end(rest, integrator, parts) - best, axis=1)
            error = 1e3 * float(np.sqrt(np.mean(away**2)))
            order = None if before is None else float(np.log2(before / error))
            yield Order(integrator, 1e3 * _FRAME / parts, error, order)
            before = error


def _end(rest: jax.Array, integrator: Integrator, parts: int) -> np.ndarray:
    """Return where a strip ends [m] that hung at rest and was pushed, with frames in so many parts.

    It hangs stretched by its weight. Let go unstretched, it would ring in modes that are faster than a timestep.
    """
    timestep = _FRAME / parts
    scene = strip(
        integrator, frames=round(_SECONDS / timestep) + 1, is_pinned=True, timestep=timestep, tilt=0.0
    )
    turning = jnp.zeros_like(rest).at[:, 2].set(-_TURN * rest[:, 1])
    start = scene.initial_state.replace(position=rest, velocity=turning)
    trajectory = rollout_scene(None, scene.replace(initial_state=start), SimConfig(iterations=100))
    return np.asarray(trajectory.positions[-1], np.float64)
