"""Values over a garment to colour it by: stretch, energies, distance to the body."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from eslr_jax.assets import prepare_stored
from eslr_jax.errors import AssetError
from eslr_jax.fabric import garment_material
from eslr_jax.geometry.topology import face_cross_products
from eslr_jax.io.garment import GarmentFile
from eslr_jax.io.run import Run
from eslr_jax.numerics import scatter_corners
from eslr_jax.physics.bending import bending_energy
from eslr_jax.physics.gravity import gravity_energy
from eslr_jax.physics.inertia import inertia_energy, vertex_masses
from eslr_jax.physics.membrane import principal_stretches, stretch_energy
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.types import Garment, Material

FIELDS = ("stretch", "stretch-energy", "bending-energy", "inertia-energy", "gravity-energy", "distance")


class Field(NamedTuple):
    """A value per frame and vertex, with the range that a colour scale should span."""

    values: Float[np.ndarray, "frames vertices"]
    low: float
    high: float
    unit: str


def run_field(run: Run, name: str) -> Field:
    """Return a field of a run.

    `stretch` is the largest principal stretch, averaged over the faces around a vertex; energies are those of the
    frame's minimisation problem, per area; `distance` is to the tangent plane of the nearest body vertex.

    Args:
        run: Of `read_run`.
        name: One of `FIELDS`.

    Raises:
        AssetError: The field is unknown, or the run has no body.
    """
    if name not in FIELDS:
        raise AssetError(f"no field {name!r} to colour by: there are {', '.join(FIELDS)}")
    if name == "distance":
        return _distances(run)
    garment, material = _prepared(run)
    positions = jnp.asarray(run.trajectory.positions)
    if name == "stretch":
        values = np.asarray(_stretches(positions, garment))
        return Field(values, 1.0, max(float(np.quantile(values, 0.999)), 1.05), "")
    timestep = jnp.float32(run.trajectory.timestep)
    velocities = jnp.asarray(run.trajectory.velocities)
    energies = _vertex_energies(name, positions, velocities, timestep, garment, material)
    values = np.asarray(energies) / np.maximum(np.asarray(garment.vertex_areas), 1e-12)
    low, high = np.quantile(values, [0.001, 0.999])
    return Field(values, min(float(low), 0.0), max(float(high), 1e-6), "J/m2")


def _prepared(run: Run) -> tuple[Garment, Material]:
    """Return the garment and fabric of a run; without its file, frame 0 is the shape at rest."""
    stored = run.garment
    if stored is None:
        first, faces = run.trajectory.positions[0].astype(np.float64), run.trajectory.faces
        one, zero = np.ones((len(first), 1)), np.zeros((len(first), 1), np.int64)
        stored = GarmentFile(first, faces, one, zero, np.zeros(len(first), bool))
    garment = prepare_stored(stored, name=run.name, allow_components=True)
    return garment, garment_material(run.report.get("fabric", ()), garment, stored)


@jax.jit
def _stretches(
    positions: Float[Array, "frames vertices 3"], garment: Garment
) -> Float[Array, "frames vertices"]:
    """Return the mean over a vertex' faces of their larger principal stretch, weighted by area."""

    def frame(position: Float[Array, "vertices 3"]) -> Float[Array, " vertices"]:
        larger, _ = principal_stretches(position, garment)
        weights = garment.rest_areas[:, None] * jnp.ones((1, 3))
        total = scatter_corners(weights, garment.face_incidence)
        return scatter_corners(weights * larger[:, None], garment.face_incidence) / jnp.maximum(total, 1e-12)

    return jax.lax.map(frame, positions)


def _vertex_energies(
    name: str,
    positions: Float[Array, "frames vertices 3"],
    velocities: Float[Array, "frames vertices 3"],
    timestep: Float[Array, ""],
    garment: Garment,
    material: Material,
) -> Float[Array, "frames vertices"]:
    """Share an energy out over the vertices [J]; the shares of a frame add up to it, the first frame has none.

    An energy is linear in a factor on every face's thickness, hinge's stiffness or vertex' density, so its
    gradient by the factors is what each element holds.
    """
    gravity = jnp.float32(PhysicsParameters().gravity)  # type: ignore[arg-type]

    def total(factors: Float[Array, " elements"], now, before, velocity) -> Float[Array, ""]:
        if name == "stretch-energy":
            return stretch_energy(now, garment, material.replace(thickness=material.thickness * factors))
        if name == "bending-energy":
            stiffness = material.bending_stiffness * factors
            return bending_energy(now, garment, material.replace(bending_stiffness=stiffness))
        masses = vertex_masses(garment, material.replace(density=material.density * factors))
        if name == "inertia-energy":
            return inertia_energy(now, before + timestep * velocity, masses, timestep)
        return gravity_energy(now, before, masses, gravity)

    sizes = {"stretch-energy": garment.faces.shape[0], "bending-energy": garment.hinges.shape[0]}
    ones = jnp.ones(sizes.get(name, garment.vertex_areas.shape[0]))

    @jax.jit
    def every_frame(positions, velocities):
        def frame(inputs):
            return jax.grad(total)(ones, *inputs)

        return jax.lax.map(frame, (positions[1:], positions[:-1], velocities[:-1]))

    shares = every_frame(positions, velocities)
    if name in sizes:
        corners = 3 if name == "stretch-energy" else 4
        table = garment.face_incidence if corners == 3 else garment.hinge_incidence
        spread = jnp.repeat(shares[:, :, None] / corners, corners, axis=2)
        shares = jax.lax.map(lambda values: scatter_corners(values, table), spread)
    return jnp.concatenate([jnp.zeros_like(shares[:1]), shares])


def _distances(run: Run) -> Field:
    """Return the height of every vertex over the tangent plane of the nearest body vertex [m]."""
    trajectory = run.trajectory
    if trajectory.body_positions is None or trajectory.body_faces is None:
        raise AssetError(f"{run.name} has no body to measure the distance to; colour by something else")
    values = np.empty(trajectory.positions.shape[:2], np.float32)
    faces = trajectory.body_faces
    for frame, (cloth, body) in enumerate(zip(trajectory.positions, trajectory.body_positions, strict=True)):
        normals = np.zeros_like(body)
        crosses = face_cross_products(body, faces)
        for corner in range(3):
            np.add.at(normals, faces[:, corner], crosses)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        _, nearest = cKDTree(body).query(cloth)
        values[frame] = np.einsum("vx,vx->v", cloth - body[nearest], normals[nearest])
    return Field(values, 0.0, 0.06, "m")
