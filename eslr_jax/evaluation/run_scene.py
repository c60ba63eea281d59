"""The scene of a run on disk, as its folder tells it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from eslr_jax.assets import prepare_stored
from eslr_jax.contact.self_contact import default_capacity
from eslr_jax.errors import ConfigError
from eslr_jax.evaluation.foreign import foreign_trajectory
from eslr_jax.fabric import garment_material
from eslr_jax.geometry.surface import prepare_surface
from eslr_jax.io.garment import GarmentFile
from eslr_jax.io.run import Run
from eslr_jax.physics.materials import constants_for
from eslr_jax.scene.build import initial_state, scene_terms, start_integrator
from eslr_jax.scene.plan import piece_of_vertices
from eslr_jax.terms.air import blowing
from eslr_jax.terms.damping import Damping
from eslr_jax.types import (
    BodyMotion,
    Garment,
    Material,
    PairCapacity,
    Scene,
    SceneBody,
    Trajectory,
)


def run_garment(run: Run) -> tuple[Garment, Material]:
    """Return the garment and fabric of a run; without its file, frame 0 is the shape at rest."""
    stored = run.garment
    if stored is None:
        first, faces = run.trajectory.positions[0].astype(np.float64), run.trajectory.faces
        one, zero = np.ones((len(first), 1)), np.zeros((len(first), 1), np.int64)
        stored = GarmentFile(first, faces, one, zero, np.zeros(len(first), bool))
    garment = prepare_stored(stored, name=run.name, allow_components=True)
    material = run.trajectory.material
    if material is None:  # a run of an older version
        material = garment_material(run.report.get("fabric", ()), garment, stored)
    return garment, material


def run_scene(run: Run, garment: Garment, material: Material, *, has_contact: bool = True) -> Scene:
    """Return the scene of a run: with the faces that it searched, and pins as they moved.

    Args:
        run: Of `read_run`.
        garment: Its garment, see `run_garment`.
        material: Its fabric.
        has_contact: Model what the cloth met; without it energies of the cloth alone are cheaper.

    Raises:
        ConfigError: The run had energies of its own, which no file holds.
    """
    usual, stored = constants_for(material), run.report.get("constants", {})
    constants = usual.replace(**{name: stored[name] for name in vars(usual) if name in stored})
    trajectory = run.trajectory
    positions, velocities = jnp.asarray(trajectory.positions), jnp.asarray(trajectory.velocities)
    body = None
    if has_contact and trajectory.body is not None and len(trajectory.body.contact_faces):
        track = trajectory.body
        surface = prepare_surface(track.rest_positions, track.contact_faces, boundary=track.contact_boundary)
        has_skin, has_tips = (bool(run.report.get(name)) for name in ("skin_contacts", "tips"))
        places = jnp.asarray(track.positions)[:, surface.vertex_ids]
        body = SceneBody(surface, places, has_skin=has_skin, has_tips=has_tips)
    has_layers = has_contact and bool(run.report.get("self_contact"))
    has_pieces = run.report.get("self_contact") == "pieces"
    capacity = default_capacity(positions.shape[1])  # of runs of an older version
    if pairs := run.report.get("self_contact_pairs"):
        capacity = PairCapacity(pairs=pairs)
    start = initial_state(positions[0], velocities[0]).replace(frame=jnp.int32(run.report.get("settle", 0)))
    ground = jnp.float32(trajectory.ground) if has_contact and trajectory.ground is not None else None
    air, damping = (
        blowing(run.report.get("wind_m_s"), run.report.get("gust", 0.0)),
        run.report.get("damping_s"),
    )
    asked = ([] if air is None else [air]) + ([] if damping is None else [Damping(damping)])
    terms = (*scene_terms(body, has_ground=ground is not None, has_layers=has_layers), *asked)
    own = set(run.report.get("terms", ())) - {term.name for term in terms}
    if has_contact and own:
        raise ConfigError(
            f"{run.name} was simulated with energies of its own ({', '.join(sorted(own))}), which its files "
            "don't hold; score its positions in the scene that was simulated: evaluation.score.score_trajectory"
        )
    return Scene(
        garment=garment,
        material=material,
        constants=constants,
        initial_state=start_integrator(start, run.report.get("integrator", "euler")),
        timestep=jnp.float32(trajectory.timestep),
        body=body,
        pin_targets=positions if bool(np.any(garment.is_pinned)) else None,
        num_frames=trajectory.num_frames,
        self_contact=capacity if has_layers else None,
        pieces=jnp.asarray(piece_of_vertices(garment)) if has_layers and has_pieces else None,
        ground=ground,
        terms=terms,
        substeps=run.report.get("substeps", 1),
    )


def run_trajectory(run: Run, scene: Scene) -> Trajectory:
    """Return the trajectory of a run in its scene, without energies, which no file holds."""
    track = run.trajectory
    # Friction loads and residuals are None in a run of an older version, or somebody else's.
    loads, residuals = track.friction_loads, track.residuals
    own = foreign_trajectory(track.positions, scene, velocities=track.velocities, friction_loads=loads)
    return own if residuals is None else own.replace(residuals=jnp.asarray(residuals))


def run_poses(run: Run, scene: Scene) -> BodyMotion | None:
    """Return the body of a run in motion, all faces obstacles; None where the file lacks it or its joints."""
    track = run.trajectory.body
    if track is None or track.skin is None or scene.body is None:
        return None
    return BodyMotion(
        positions=jnp.asarray(track.positions),
        joint_transforms=jnp.asarray(track.skin.joint_transforms),
        faces=jnp.asarray(track.faces),
        is_obstacle=jnp.ones(len(track.faces), bool),
        timestep=scene.timestep,
        rest_positions=jnp.asarray(track.rest_positions),
        surface=scene.body.surface,
    )
