"""A scene of this package in Blender's cloth modifier, where `BLENDER_PYTHON` names a Python with `bpy`.

Blender is GPL, https://www.blender.org; measured in version 5.0.1. It runs in a process of its own, from a start
without velocity through all frames: it can't be set into a state that moves, so only its own rollouts are
measured. There is no damping. Self-contact is on in scenes that model it.

What its numbers mean was measured, on sheets that fall, hang, bend and slide:

- Time: gravity counts 0.001 m per frame^2 for every m/s^2, so a frame is sqrt(0.001) s long; `time_scale` makes
  it ours.
- Tension: every edge is a spring of 1000 T / l, with the mean edge length l. A lattice of equilateral triangles
  with such springs has the strip stiffness 2 / sqrt(3) of theirs, so T = sqrt(3) / 2 E h l / 1000.
- Bending: the force at a hinge's tip is 100 / 3 k l theta. Rest angles are those of the rest shape, ours flat.
- Friction: 1 % of the body's number. Cloth and body each have a distance; both add up to ours.

Fabric by part becomes one fabric, its mean. Lengths at rest are those of the mesh that carries the pins, so a
pinned garment has to start with its lengths at rest.
"""

import dataclasses
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from hard_cases import Simulator
from jaxtyping import Float
from newton_cloth import LAYER_THICKNESS, prepare_cloth, springs, strip_stiffness

from eslr_jax.errors import EslrError, MissingExtraError
from eslr_jax.pipeline.formats.animated import AnimatedMesh
from eslr_jax.pipeline.formats.point_cache import write_pc2
from eslr_jax.pipeline.report.score import foreign_trajectory
from eslr_jax.terms import Collision, Friction, Gravity
from eslr_jax.terms.contact import keeps_layers
from eslr_jax.terms.term import contact_thickness
from eslr_jax.types import Scene

# Steps per frame, rounds of collision per step: in peers.json the least gap on its own rollout.
BEST = (45, 2)
SECONDS_PER_FRAME = 1e-3**0.5  # of Blender's cloth, whatever the frame rate
_BODY_DISTANCE = 1e-3  # [m]; the least that Blender takes
_SAME = 1e-3  # relative: lengths that count as those at rest


@dataclasses.dataclass(frozen=True)
class BlenderRun:
    """A rollout of Blender's."""

    positions: Float[np.ndarray, "frames vertices 3"]  # [m]; padding stays where it starts
    wall: Float[np.ndarray, " steps"]  # [ms]
    processor: Float[np.ndarray, " steps"]  # [ms]
    version: str


def blender_python() -> str | None:
    """Return the Python that has `bpy`, or None."""
    return os.environ.get("BLENDER_PYTHON")


def run_blender(scene: Scene, effort: tuple[int, int]) -> BlenderRun:
    """Simulate a scene in Blender, with so many steps per frame and rounds of collision per step.

    Raises:
        EslrError: The scene can't be carried over, or Blender failed; the message holds the last line it wrote.
    """
    cloth = prepare_cloth(scene.garment, scene.material)
    body, friction = scene.term(Collision) or Collision(), scene.term(Friction) or Friction()
    first, rows = scene.initial_state, cloth.vertices
    start = np.asarray(first.position, np.float32)[rows]
    edges, _ = springs(cloth)
    lengths, start_lengths = (
        np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1) for x in (cloth.rest, start)
    )
    if cloth.is_pinned.any() and not np.allclose(start_lengths, lengths, rtol=_SAME):
        raise EslrError("Blender takes lengths at rest from the mesh with the pins, which is deformed here")
    if scene.body is None and np.asarray(first.velocity)[rows].any():
        raise EslrError("Blender starts cloth without velocity")
    stretch = strip_stiffness(cloth.shear, cloth.area_stiffness)
    distance = float(contact_thickness(scene.garment, body.thickness))
    arrays = {
        "start": start, "faces": cloth.faces, "is_pinned": cloth.is_pinned, "frames": scene.num_frames,
        "quality": effort[0], "collision_quality": effort[1],
        "time_scale": float(scene.timestep) / SECONDS_PER_FRAME,
        "gravity": float(scene.term(Gravity).acceleration),
        "mass": cloth.masses[cloth.masses > 0].mean(),
        "tension": 3**0.5 / 2 * stretch.mean() * lengths.mean() / 1e3,
        "bending": 0.03 * (cloth.bending / cloth.hinge_areas).mean(),
        "distance": max(distance - _BODY_DISTANCE, _BODY_DISTANCE), "body_distance": _BODY_DISTANCE,
        "friction": 100.0 * float(friction.coefficient),
    }  # fmt: skip
    if keeps_layers(scene):
        arrays["layer_distance"] = float(contact_thickness(scene.garment, LAYER_THICKNESS))
    if cloth.is_pinned.any():
        below = np.repeat(start[None], scene.num_frames, axis=0)
        below[:, cloth.is_pinned] = np.asarray(scene.pin_targets)[:, rows[cloth.is_pinned]]
    else:  # the start, then the rest shape for its lengths
        below = np.stack([start, cloth.rest])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        timestep = float(scene.timestep)
        write_pc2(folder / "cloth.pc2", [AnimatedMesh("cloth", below, cloth.faces)], timestep)
        if scene.body is not None:
            body, faces = np.asarray(scene.body.positions), np.asarray(scene.body.surface.faces)
            write_pc2(folder / "body.pc2", [AnimatedMesh("body", body, faces)], timestep)
            arrays |= {"body_start": body[0], "body_faces": faces}
        np.savez(folder / "scene.npz", **arrays)  # type: ignore[arg-type]
        command = [str(blender_python()), str(Path(__file__).with_name("blender_worker.py")), name]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if not (folder / "out.npz").exists():
            lines = (done.stderr.strip() or done.stdout.strip() or "no word").splitlines()
            raise EslrError(f"Blender failed: {lines[-1]}")
        with np.load(folder / "out.npz") as out:
            positions = np.repeat(np.asarray(first.position)[None], scene.num_frames, axis=0)
            positions[:, rows] = out["positions"]
            return BlenderRun(positions, out["wall"], out["processor"], str(out["version"]))


def blender_simulator(effort: tuple[int, int]) -> Simulator:
    """Return Blender's cloth as a simulator of the hard cases, with an effort as for `run_blender`."""
    if blender_python() is None:
        raise MissingExtraError("BLENDER_PYTHON names no Python with bpy; see peers.py for how to install it")
    return Simulator(
        f"Blender, {effort[0]}x{effort[1]}",
        lambda scene: foreign_trajectory(run_blender(scene, effort).positions, scene),
    )
