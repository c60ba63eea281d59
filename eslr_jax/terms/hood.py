"""Energy set `hood`: HOOD's published losses with every quirk, so that its tables can be compared.

`eslr_jax.terms` lists the differences from set `consistent` side by side. HOOD's code has three variants of
the same six terms, which use different frames of the body:

| criterion    | collision: nearest centroid | collision: planes | friction: body motion | weight, eps |
|--------------|-----------------------------|-------------------|-----------------------|-------------|
| `postcvpr`   | x_t on the body at t        | at t + 1          | t - 1 to t, one late  | 5e3, 2 mm   |
| `cvpr`       | x_t on the body at t - 1    | at t, one late    | t - 1 to t, one late  | 5e3, 2 mm   |
| `metric`     | x_{t+1} on the body at t + 1| at t + 1          | t to t + 1            | 1, 1 mm     |

The first two train; the last makes the tables. Torch's norms have a zero gradient at zero, and so have these.

Source: HOOD (arXiv 2212.07242), repository at 9bc1076: criterions/{cvpr,postcvpr,aux}, utils/metrics.py.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax.config import Criterion
from eslr_jax.numerics import components, cross3, dot3, masked_sum, safe_norm, safe_normalize, sub3
from eslr_jax.terms.bending import hinge_corners, hinge_energies
from eslr_jax.terms.gravity import gravity_energies
from eslr_jax.terms.inertia import inertia_energies
from eslr_jax.terms.stretch import stretch_energy
from eslr_jax.terms.term import vertex_masses
from eslr_jax.types import Garment, Material

_CHUNK = 64  # garment vertices whose distances to all faces are held at once
_FLOOR_AXIS = 2  # friction's "floor normal" is z although gravity acts along y
_SINE_FLOOR = 1e-4  # added under the root of friction's slope factor


@struct.dataclass
class HoodParameters:
    """Constants of HOOD's losses; the defaults are those of training before its collision ramp."""

    collision_weight: Float[Array, ""] | float = 5e3  # [J/m^3] per vertex
    collision_thickness: Float[Array, ""] | float = 2e-3  # [m]
    friction_coefficient: Float[Array, ""] | float = 0.5
    friction_radius: Float[Array, ""] | float = 3e-3  # compared with squared distances: 5.5 cm in truth
    gravity: Float[Array, ""] | float = 9.81  # [m/s^2]


METRIC_PARAMETERS = HoodParameters(collision_weight=1.0, collision_thickness=1e-3)
"""Constants of HOOD's tables (configs/aux/metrics.yaml)."""


@struct.dataclass
class BodyFrames:
    """A body around one step; all its faces take part, hands included."""

    previous: Float[Array, "body_vertices 3"]  # at t - 1 [m]
    current: Float[Array, "body_vertices 3"]  # at t [m]
    next: Float[Array, "body_vertices 3"]  # at t + 1 [m]
    faces: Int[Array, "body_faces 3"]  # counter-clockwise seen from outside


@struct.dataclass
class HoodProblem:
    """What HOOD's losses of one step depend on besides the predicted positions."""

    current: Float[Array, "vertices 3"]  # at t [m]
    previous: Float[Array, "vertices 3"]  # at t - 1 [m]; `current` where HOOD starts with zero velocity
    bodies: BodyFrames | None  # None: no body
    garment: Garment
    material: Material  # HOOD keeps the thickness at 0.47 mm whatever the fabric
    timestep: Float[Array, ""] | float  # 1/30 s, and 1/3 s in HOOD's first step [s]
    parameters: HoodParameters  # `METRIC_PARAMETERS` for the criterion `metric`


def collision_weight(iteration: Int[Array, ""] | int) -> Float[Array, ""]:
    """Return HOOD's weight after this many training samples: 5e3 up to 50k, rising to 5e5 at 150k [J/m^3]."""
    ramp = jnp.clip((jnp.asarray(iteration, jnp.float32) - 50_000) / 100_000, 0.0, 1.0)
    return 5e3 + (5e5 - 5e3) * ramp


class _FacePlanes(NamedTuple):
    """Centroids and unit normals of a body's faces."""

    centers: Float[Array, "body_faces 3"]
    normals: Float[Array, "body_faces 3"]


def _face_planes(body: Float[Array, "body_vertices 3"], faces: Int[Array, "body_faces 3"]) -> _FacePlanes:
    a, b, c = (components(body[faces[:, k]]) for k in range(3))
    normals = jnp.stack(cross3(sub3(c, b), sub3(a, b)), axis=-1)
    return _FacePlanes(body[faces].mean(axis=1), safe_normalize(normals))


def nearest_centroid(
    query: Float[Array, "vertices 3"], centers: Float[Array, "body_faces 3"]
) -> tuple[Int[Array, " vertices"], Float[Array, " vertices"]]:
    """Return the nearest face centroid of every point and its squared distance [m^2]; brute force.

    Neither result carries a gradient; of several nearest the first is taken.
    """
    query, centers = jax.lax.stop_gradient((query, centers))
    others = components(centers)

    def nearest(point: Array) -> tuple[Array, Array]:
        offset = tuple(other - point[axis] for axis, other in enumerate(others))
        squared = dot3(offset, offset)  # type: ignore[arg-type]
        least = jnp.min(squared)
        # XLA's argmin is slow on a CPU.
        index = jnp.min(jnp.where(squared <= least, jnp.arange(squared.shape[0]), squared.shape[0] - 1))
        return index.astype(jnp.int32), least

    return jax.lax.map(nearest, query, batch_size=_CHUNK)


def hood_friction_energy(
    position: Float[Array, "vertices 3"], problem: HoodProblem, criterion: Criterion
) -> Float[Array, ""]:
    """Return mu g sum_v m_v s_v |Delta_T| [J] over the vertices near the body.

    Delta is the cloth's motion minus that of the body face that is nearest before the motion. Delta_T is Delta
    without its part along the mean of two normals (not normalised again), that of this face and that of the face
    that is nearest after the motion, and s = sqrt(|1 - cos^2(Delta_T, z)| + 1e-4).
    """
    bodies, parameters = problem.bodies, problem.parameters
    if bodies is None:
        return jnp.zeros((), position.dtype)
    is_metric = criterion == "metric"
    before = _face_planes(bodies.current if is_metric else bodies.previous, bodies.faces)
    after = _face_planes(bodies.next if is_metric else bodies.current, bodies.faces)
    first, first_squared = nearest_centroid(problem.current, before.centers)
    last, last_squared = nearest_centroid(position, after.centers)
    is_near = (first_squared < parameters.friction_radius) & (last_squared < parameters.friction_radius)
    motion = position - problem.current - (after.centers[first] - before.centers[first])
    normal = 0.5 * (before.normals[first] + after.normals[last])
    tangential = motion - jnp.sum(motion * normal, axis=-1, keepdims=True) * normal
    cosine = safe_normalize(tangential)[:, _FLOOR_AXIS]
    slope = jnp.sqrt(jnp.abs(1.0 - cosine * cosine) + _SINE_FLOOR)
    per_vertex = vertex_masses(problem.garment, problem.material) * slope * safe_norm(tangential)
    return parameters.friction_coefficient * parameters.gravity * masked_sum(per_vertex, is_near)


def criterion_depths(
    position: Float[Array, "vertices 3"], problem: HoodProblem, criterion: Criterion
) -> Float[Array, " vertices"]:
    """Return max(eps - d, 0) [m], d the height over the plane of the face with the nearest centroid.

    The criterion says of which frames are the vertices whose nearest centroid is looked for, the body on which it
    is looked for, and the body whose planes count. Zero without a body.
    """
    bodies = problem.bodies
    if bodies is None:
        return jnp.zeros(position.shape[0], position.dtype)
    query, search_body, body = {
        "postcvpr": (problem.current, bodies.current, bodies.next),
        "cvpr": (problem.current, bodies.previous, bodies.current),
        "metric": (position, bodies.next, bodies.next),
    }[criterion]
    nearest, _ = nearest_centroid(query, _face_planes(search_body, bodies.faces).centers)
    planes = _face_planes(body, bodies.faces)
    height = jnp.sum((position - planes.centers[nearest]) * planes.normals[nearest], axis=-1)
    return jnp.maximum(problem.parameters.collision_thickness - height, 0.0)


def hood_terms(
    position: Float[Array, "vertices 3"], problem: HoodProblem, *, criterion: Criterion = "postcvpr"
) -> dict[str, Float[Array, ""]]:
    """Return HOOD's six losses [J] of one step, by name.

    Sums go over vertices, faces and edges, without means; gravity counts from the world's origin. In the two
    training criteria pinned vertices have already moved when the losses are taken: they add a constant to
    inertia.

    `position` are the predicted vertices at t + 1 [m], and `criterion` is static, see the module.
    """
    garment, material, parameters = problem.garment, problem.material, problem.parameters
    masses = vertex_masses(garment, material)
    if criterion != "metric":
        is_pinned = garment.is_pinned[:, None]
        fixed = jax.lax.stop_gradient(position)
        problem = problem.replace(
            previous=jnp.where(is_pinned, problem.current, problem.previous),
            current=jnp.where(is_pinned, fixed, problem.current),
        )
        position = jnp.where(is_pinned, fixed, position)
    guess = problem.current + (problem.current - problem.previous)
    depth = criterion_depths(position, problem, criterion)
    hinges = hinge_corners(position, garment)
    timestep = jnp.asarray(problem.timestep, position.dtype)
    return {
        "stretch": stretch_energy(position, garment, material),
        "bending": jnp.sum(hinge_energies(hinges, garment, material, use_current_length=True)),
        "inertia": jnp.sum(inertia_energies(position, guess, masses, timestep)),
        "gravity": jnp.sum(gravity_energies(position, None, masses, parameters.gravity)),
        "collision": parameters.collision_weight * masked_sum(depth * depth * depth, garment.vertex_mask),
        "friction": hood_friction_energy(position, problem, criterion),
    }
