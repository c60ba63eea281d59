"""Node and edge features: HOOD's, and scaled ones that carry the gradient of the potential.

HOOD's features are raw and go through running statistics inside the model. Those of the "gradient" kind are
divided by fixed physical scales instead, or by the garment's mean rest edge length where a quantity grows
with the mesh spacing, so that one model serves a garment meshed at 1k and at 4k vertices. They are clipped at
`CLIP`: a vertex thrown far away gives a large input, not an unbounded one.

Source: HOOD's `models/baselines.py` and `utils/connectivity.py` for the first kind.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.numerics import safe_norm, safe_normalize, sum_incident, vertex_normals
from eslr_jax.physics.inertia import vertex_masses
from eslr_jax.types import Contacts, Garment, Material

LAME_MU_RANGE = (15909.0, 63636.0)  # [Pa] (HOOD, training range)
LAME_LAMBDA_RANGE = (3535.414406069427, 93333.73508005822)  # [Pa] (HOOD)
BENDING_RANGE = (6.370782056371576e-8, 1.3139737991266374e-3)  # [J] (HOOD)
REGULAR_TIMESTEP = 1 / 30  # [s] (HOOD)
LEAST_GRAVITY = 1.0  # [m/s^2]; keeps the unit of force where a scene has no weight

CLIP = 5.0  # scaled features outside are cut off
VELOCITY_SCALE = 0.02  # [m per frame], 0.6 m/s at 30 frames a second
DENSITY_SCALE = 0.2  # [kg/m^2], a light cotton
EDGE_LENGTH_SCALE = 0.02  # [m]
BODY_OFFSET_SCALE = 0.02  # [m]
DISTANCE_SCALE = 0.01  # [m], signed distance to the body
CONTACT_SCALE = 0.002  # [m], width of the contact energy
GUESS_SCALE = 0.01  # [m], push-out and corrections
STRAIN_SCALE = 0.1
STEP_SCALE = 0.1  # of the mean rest edge length

TYPE_GARMENT, TYPE_BODY, TYPE_BODY_OMITTED, TYPE_PINNED = range(4)  # HOOD's vertex types
NUM_TYPES = 9  # rows and columns of HOOD's embedding table
HOOD_NODE_SIZE = 11  # + 9 embedding columns = 20
HOOD_NODE_STATIC = 3  # last columns, which are not normalised
HOOD_MESH_SIZE, HOOD_MESH_STATIC = 12, 3
HOOD_WORLD_SIZE = 9
HOOD_WORLD_VECTORS = 8  # leading columns are (vector, norm) pairs


def clip(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Cut off at plus and minus `CLIP`."""
    return jnp.clip(x, -CLIP, CLIP)


def to_vertices(
    values: Float[Array, "*shape"],
    garment: Garment,
    weights: Float[Array, " items"],
    incidence: Int[Array, "vertices degree"],
    corners: int,
) -> Float[Array, " vertices"]:
    """Average a material value onto vertices; a scalar is repeated.

    Args:
        values: A scalar, or one value per item.
        garment: Garment whose vertices are meant.
        weights: Weight of every item, shape [items]; items of weight zero do not count.
        incidence: Items of every vertex, see `sum_incident`.
        corners: Corners of an item.
    """
    num_vertices = garment.vertex_areas.shape[0]
    if values.ndim == 0:
        return jnp.broadcast_to(values, (num_vertices,))
    sums = sum_incident(jnp.stack([values * weights, weights], axis=1), incidence, corners=corners)
    mean = jnp.sum(values * weights) / jnp.maximum(jnp.sum(weights), 1e-30)
    return jnp.where(sums[:, 1] > 0, sums[:, 0] / jnp.where(sums[:, 1] > 0, sums[:, 1], 1), mean)


def material_inputs(garment: Garment, material: Material) -> Float[Array, "vertices 3"]:
    """Return bending stiffness, mu and lambda per vertex, scaled to 0..1 over HOOD's training ranges.

    Bending and mu on a logarithmic scale, lambda on a linear one; values outside of the range leave 0..1.

    Source: HOOD's `runners/utils/material.py`.
    """
    hinge_weights = (garment.hinge_rest_areas > 0).astype(garment.rest_areas.dtype)
    bending = to_vertices(
        material.bending_stiffness, garment, hinge_weights, garment.hinge_incidence, garment.hinges.shape[1]
    )
    mu, lam = (
        to_vertices(value, garment, garment.rest_areas, garment.face_incidence, 3)
        for value in (material.lame_mu, material.lame_lambda)
    )

    def log_scale(x, low, high):
        return (jnp.log(jnp.maximum(x, 1e-30)) - jnp.log(low)) / (jnp.log(high) - jnp.log(low))

    low, high = LAME_LAMBDA_RANGE
    return jnp.stack(
        [log_scale(bending, *BENDING_RANGE), log_scale(mu, *LAME_MU_RANGE), (lam - low) / (high - low)],
        axis=1,
    )


def log_positive(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the logarithm, and zero where `x` is not positive (a padded vertex has no mass)."""
    return jnp.log(jnp.where(x > 0, x, 1))


def mean_edge_length(garment: Garment) -> Float[Array, ""]:
    """Return the mean length of the rest mesh's edges [m]."""
    rest = garment.rest_positions[garment.senders] - garment.rest_positions[garment.receivers]
    total = jnp.sum(jnp.where(garment.edge_mask, safe_norm(rest), 0))
    return total / jnp.maximum(jnp.sum(garment.edge_mask.astype(rest.dtype)), 1)


def timestep_input(timestep: Float[Array, ""]) -> Float[Array, ""]:
    """Return log10 of the timestep over a thirtieth of a second: 0 for a regular frame, 1 for the first."""
    return jnp.log10(timestep / REGULAR_TIMESTEP)


# --- HOOD ---------------------------------------------------------------------------------------------------


def hood_garment_features(
    garment: Garment,
    material: Material,
    position: Float[Array, "vertices 3"],
    velocity: Float[Array, "vertices 3"],
    timestep: Float[Array, ""],
) -> Float[Array, "vertices 11"]:
    """Velocity 3 [m per frame], normal 3, timestep [s], ln mass [ln kg], material inputs 3.

    The model inserts the embedding of the vertex type behind the velocity: 20 columns.
    """
    column = jnp.broadcast_to(timestep, (position.shape[0], 1))
    mass = log_positive(vertex_masses(garment, material))[:, None]
    normals = vertex_normals(position, garment.faces, garment.face_incidence)
    return jnp.concatenate([velocity, normals, column, mass, material_inputs(garment, material)], axis=1)


def hood_body_features(
    velocity: Float[Array, "world_edges 3"],
    normals: Float[Array, "world_edges 3"],
    timestep: Float[Array, ""],
) -> Float[Array, "world_edges 11"]:
    """The same columns for body points; mass and material are -1."""
    num_rows = velocity.shape[0]
    column = jnp.broadcast_to(timestep, (num_rows, 1))
    return jnp.concatenate([velocity, normals, column, -jnp.ones((num_rows, 4), velocity.dtype)], axis=1)


def hood_mesh_features(
    garment: Garment, material: Material, position: Float[Array, "vertices 3"], timestep: Float[Array, ""]
) -> Float[Array, "edges 12"]:
    """Sender minus receiver 3 [m], its norm, the same at rest 4, timestep [s], material inputs 3."""
    current = position[garment.senders] - position[garment.receivers]
    rest = garment.rest_positions[garment.senders] - garment.rest_positions[garment.receivers]
    inputs = material_inputs(garment, material)
    return jnp.concatenate(
        [
            current,
            safe_norm(current, keepdims=True),
            rest,
            safe_norm(rest, keepdims=True),
            jnp.broadcast_to(timestep, (current.shape[0], 1)),
            (inputs[garment.senders] + inputs[garment.receivers]) / 2,
        ],
        axis=1,
    )


def hood_world_features(
    position: Float[Array, "world_edges 3"],
    points: Float[Array, "world_edges 3"],
    next_points: Float[Array, "world_edges 3"],
    timestep: Float[Array, ""],
) -> Float[Array, "world_edges 9"]:
    """Garment minus body point 3 [m], its norm, the same with the body's next frame 4, timestep [s]."""
    now, later = position - points, position - next_points
    return jnp.concatenate(
        [
            now,
            safe_norm(now, keepdims=True),
            later,
            safe_norm(later, keepdims=True),
            jnp.broadcast_to(timestep, (now.shape[0], 1)),
        ],
        axis=1,
    )


def hood_reverse_signs(dtype) -> Float[Array, " 9"]:
    """Return what turns the features of a world edge into those of its opposite: vectors change sign."""
    return jnp.array([-1, -1, -1, 1, -1, -1, -1, 1, 1], dtype)


# --- gradient -----------------------------------------------------------------------------------------------
# Every kind of row has features that stay for a frame, and features that change from pass to pass.

NODE_FRAME_SIZE, NODE_REFINEMENT_SIZE = 14, 18
MESH_FRAME_SIZE, MESH_REFINEMENT_SIZE = 8, 4
WORLD_FRAME_SIZE, WORLD_REFINEMENT_SIZE = 10, 2
BODY_FRAME_SIZE = 10


def frame_node_features(
    garment: Garment,
    material: Material,
    position: Float[Array, "vertices 3"],
    velocity: Float[Array, "vertices 3"],
    timestep: Float[Array, ""],
    edge_length: Float[Array, ""],
) -> Float[Array, "vertices 14"]:
    """Velocity 3, normal 3, timestep, density, area over squared spacing, spacing, pinned, material 3."""
    num_vertices = position.shape[0]
    density = jnp.broadcast_to(material.density, (num_vertices,))
    area = garment.vertex_areas / edge_length**2
    scalars = [
        jnp.broadcast_to(timestep_input(timestep), (num_vertices,)),
        jnp.log(density / DENSITY_SCALE),
        clip(log_positive(area)),
        jnp.broadcast_to(jnp.log(edge_length / EDGE_LENGTH_SCALE), (num_vertices,)),
        garment.is_pinned.astype(position.dtype),
    ]
    return jnp.concatenate(
        [
            clip(velocity / VELOCITY_SCALE),
            vertex_normals(position, garment.faces, garment.face_incidence),
            jnp.stack(scalars, axis=1),
            material_inputs(garment, material),
        ],
        axis=1,
    )


def refinement_node_features(
    garment: Garment,
    material: Material,
    guess: Float[Array, "vertices 3"],
    inertial_guess: Float[Array, "vertices 3"],
    gradient: Float[Array, "vertices 3"],
    step: Float[Array, "vertices 3"],
    weight: Float[Array, " vertices"],
    edge_length: Float[Array, ""],
    correction: Float[Array, "vertices 3"] | None,
    previous_gradient: Float[Array, "vertices 3"] | None,
) -> Float[Array, "vertices 18"]:
    """Push-out 3, force 3 and its size, descent step 3 and its size, last correction 3, last force 3 and size.

    A force f enters by direction and asinh(|f| / (m g)) / 2, with at least `LEAST_GRAVITY` for g. The step
    is in units of a tenth of the mesh spacing, through tanh; its size through log1p. What the first pass does
    not know is zero.
    """
    if correction is None:
        correction = jnp.zeros_like(guess)
    if previous_gradient is None:
        previous_gradient = jnp.zeros_like(guess)
    mass = vertex_masses(garment, material)
    heaviness = jnp.maximum(jnp.maximum(weight, LEAST_GRAVITY * mass), 1e-12)[:, None]

    def force_features(force):
        size = jnp.arcsinh(safe_norm(force, keepdims=True) / heaviness) / 2
        return safe_normalize(force) * size, size

    scaled = step / (STEP_SCALE * edge_length)
    force, force_size = force_features(-gradient)
    previous, previous_size = force_features(-previous_gradient)
    return jnp.concatenate(
        [
            clip((guess - inertial_guess) / GUESS_SCALE),
            force,
            force_size,
            jnp.tanh(scaled),
            jnp.log1p(safe_norm(scaled, keepdims=True)) / 2,
            clip(correction / GUESS_SCALE),
            previous,
            previous_size,
        ],
        axis=1,
    )


def frame_mesh_features(
    garment: Garment, position: Float[Array, "vertices 3"], edge_length: Float[Array, ""]
) -> Float[Array, "edges 8"]:
    """Sender minus receiver 3 and the same at rest 3, in mesh spacings; rest length less one; strain."""
    current = position[garment.senders] - position[garment.receivers]
    rest = garment.rest_positions[garment.senders] - garment.rest_positions[garment.receivers]
    rest_length = safe_norm(rest, keepdims=True)
    return jnp.concatenate(
        [
            clip(current / edge_length),
            clip(rest / edge_length),
            clip(rest_length / edge_length - 1),
            _strain(current, rest_length),
        ],
        axis=1,
    )


def refinement_mesh_features(
    garment: Garment, guess: Float[Array, "vertices 3"], edge_length: Float[Array, ""]
) -> Float[Array, "edges 4"]:
    """Sender minus receiver at the guess 3, in mesh spacings, and its strain."""
    rest = garment.rest_positions[garment.senders] - garment.rest_positions[garment.receivers]
    vector = guess[garment.senders] - guess[garment.receivers]
    return jnp.concatenate(
        [clip(vector / edge_length), _strain(vector, safe_norm(rest, keepdims=True))], axis=1
    )


def _strain(vector: Float[Array, "edges 3"], rest_length: Float[Array, "edges 1"]) -> Float[Array, "edges 1"]:
    """Return the relative change of length over `STRAIN_SCALE`; zero where padded."""
    length = safe_norm(vector, keepdims=True)
    is_real = rest_length > 0
    return clip(jnp.where(is_real, length / jnp.where(is_real, rest_length, 1) - 1, 0) / STRAIN_SCALE)


def frame_world_features(
    position: Float[Array, "world_edges 3"], contacts: Contacts, inertial_guess: Float[Array, "world_edges 3"]
) -> Float[Array, "world_edges 10"]:
    """Offset from the body point now and at the next frame, with norms 8; two signed distances."""
    now, later = position - contacts.points, position - contacts.next_points
    return clip(
        jnp.concatenate(
            [
                now / BODY_OFFSET_SCALE,
                safe_norm(now, keepdims=True) / BODY_OFFSET_SCALE,
                later / BODY_OFFSET_SCALE,
                safe_norm(later, keepdims=True) / BODY_OFFSET_SCALE,
                contacts.distances[:, None] / DISTANCE_SCALE,
                plane_distance(inertial_guess, contacts) / DISTANCE_SCALE,
            ],
            axis=1,
        )
    )


def refinement_world_features(
    guess: Float[Array, "world_edges 3"], contacts: Contacts
) -> Float[Array, "world_edges 2"]:
    """Signed distance of the guess to the body's next tangent plane, coarse and in contact widths."""
    distance = plane_distance(guess, contacts)
    return clip(jnp.concatenate([distance / DISTANCE_SCALE, distance / CONTACT_SCALE], axis=1))


def plane_distance(
    position: Float[Array, "world_edges 3"], contacts: Contacts
) -> Float[Array, "world_edges 1"]:
    """Return the signed distance [m] to the tangent plane at the body's next frame."""
    return jnp.sum((position - contacts.next_points) * contacts.next_normals, axis=1, keepdims=True)


def frame_body_features(
    velocity: Float[Array, "world_edges 3"], contacts: Contacts, timestep: Float[Array, ""]
) -> Float[Array, "world_edges 10"]:
    """Velocity of the body point 3, its normal now 3 and at the next frame 3, timestep."""
    return jnp.concatenate(
        [
            clip(velocity / VELOCITY_SCALE),
            contacts.normals,
            contacts.next_normals,
            jnp.broadcast_to(timestep_input(timestep), (velocity.shape[0], 1)),
        ],
        axis=1,
    )
