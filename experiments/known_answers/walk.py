"""What the error of a walk consists of, in millimetres: tolerance, timestep, mesh, each by its refinement."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from eslr_jax import SimConfig, load_body, load_garment, load_motion, pose_body, prepare_scene, rollout_scene
from eslr_jax.mesh.closest import closest_points
from eslr_jax.simulation.simulate import raise_for_status
from eslr_jax.terms import FAST

CLIP, FPS = "cmu_016_32", 30.0
_FINEST = 400  # iterations that stand for none left to do


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
