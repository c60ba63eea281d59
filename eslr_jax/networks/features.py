"""What a graph is built from, and its features: HOOD's, these with the state, or scaled ones with the gradient.

HOOD's features are raw, and the model normalises them by running statistics. They leave strain, how neighbours
move against each other and the depth in the body to products of inputs; the kind "state" has these too. Features
of the kind "gradient", of the potential, are divided by fixed physical scales. What grows with the mesh spacing
is divided by the garment's mean rest edge length, so that one model serves a garment at 1k and at 4k vertices.
They are clipped at `CLIP`: a vertex thrown far away gives a large input, but a bounded one.

Source: HOOD's `models/baselines.py` and `utils/connectivity.py` for the first kind.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax.fabric.materials import COTTON
from eslr_jax.networks.operators import to_world_edges
from eslr_jax.numerics import safe_norm, safe_normalize, sum_incident, vertex_normals
from eslr_jax.terms.term import vertex_masses
from eslr_jax.types import CoarseEdges, Contacts, Garment, Material

DENSITY_RANGE = (0.0434, 0.7)  # [kg/m^2] (HOOD, training range)
LAME_MU_RANGE = (15909.0, 63636.0)  # [Pa] (HOOD)
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
HOOD_MESH_SIZE, HOOD_WORLD_SIZE = 12, 9
HOOD_STATIC = {"garment": 3, "mesh": 3, "world": 0}  # last columns, which are not normalised
STATE_MESH_SIZE, STATE_WORLD_SIZE = 5, 2  # columns of the kind "state" beside HOOD's


@struct.dataclass
class GraphInputs:
    """State of a garment and of the body beside it, at a frame.

    Lengths are in metres. Velocities are in metres per frame, the unit of HOOD's features. Pinned vertices
    already have their next target as `position`, and their way to it as `velocity`.
    `contacts` is None in a scene without a body. It has a row per world edge, and all vertices have as many world
    edges: all their first ones, then all their second ones.
    """

    position: Float[Array, "vertices 3"]  # [m]
    velocity: Float[Array, "vertices 3"]  # [m per frame]
    timestep: Float[Array, ""]  # [s]
    contacts: Contacts | None
    inertial_guess: Float[Array, "vertices 3"]  # where inertia alone leads [m]
    weight: Float[Array, " vertices"]  # m g [N]


@struct.dataclass
class RefinementInputs(GraphInputs):
    """The same at one refinement step of a frame; the last two are zero at the first one."""

    guess: Float[Array, "vertices 3"]  # what the step corrects [m]
    gradient: Float[Array, "vertices 3"]  # of the potential at `guess` [N]
    step: Float[Array, "vertices 3"]  # preconditioned step down that gradient [m]
    correction: Float[Array, "vertices 3"]  # that led to `guess` [m]
    previous_gradient: Float[Array, "vertices 3"]  # before that correction [N]


def clip(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Cut off at plus and minus `CLIP`."""
    return jnp.clip(x, -CLIP, CLIP)


def to_vertices(
    values: Float[Array, "*shape"],
    weights: Float[Array, " items"],
    incidence: Int[Array, "vertices degree"],
    corners: int,
) -> Float[Array, " vertices"]:
    """Return a material constant of items, faces or hinges, as weighted means around every vertex.

    `values` are of all items or a scalar, which is repeated; `corners` is the number of vertices of an item, see
    `numerics.sum_incident`. A vertex without items has the mean over all.
    """
    if values.ndim == 0:
        return jnp.broadcast_to(values, (incidence.shape[0],))
    sums = sum_incident(jnp.stack([values * weights, weights], axis=1), incidence, corners=corners)
    mean = jnp.sum(values * weights) / jnp.maximum(jnp.sum(weights), 1e-30)
    return jnp.where(sums[:, 1] > 0, sums[:, 0] / jnp.where(sums[:, 1] > 0, sums[:, 1], 1), mean)


def sheet_constants(material: Material) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Return mu and lambda [Pa] of a sheet of HOOD's thickness that stretches as this one does."""
    ratio = jnp.asarray(material.thickness) / float(COTTON.thickness)
    return material.lame_mu * ratio, material.lame_lambda * ratio


def material_inputs(garment: Garment, material: Material) -> Float[Array, "vertices 3"]:
    """Return bending stiffness, mu and lambda of every vertex, scaled to 0..1 over HOOD's training ranges.

    Bending stiffness and mu have a logarithmic scale, lambda a linear one. A fabric outside the ranges gives
    values outside 0..1. Mu and lambda are those of a sheet of HOOD's thickness that stretches alike.

    Source: HOOD's `runners/utils/material.py`.
    """
    hinge_weights = (garment.hinge_rest_areas > 0).astype(garment.rest_areas.dtype)
    bending = to_vertices(
        material.bending_stiffness, hinge_weights, garment.hinge_incidence, garment.hinges.shape[1]
    )
    mu, lam = (
        to_vertices(value, garment.rest_areas, garment.face_incidence, 3)
        for value in sheet_constants(material)
    )

    def log_scale(x, low, high):
        return (jnp.log(jnp.maximum(x, 1e-30)) - jnp.log(low)) / (jnp.log(high) - jnp.log(low))

    low, high = LAME_LAMBDA_RANGE
    return jnp.column_stack(
        [log_scale(bending, *BENDING_RANGE), log_scale(mu, *LAME_MU_RANGE), (lam - low) / (high - low)]
    )


def with_norm(vectors: Float[Array, "rows 3"]) -> Float[Array, "rows 4"]:
    """Return vectors with their lengths behind them."""
    return jnp.column_stack([vectors, safe_norm(vectors)])


def log_positive(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the logarithm, and zero where `x` is not positive (a padded vertex has no mass)."""
    return jnp.log(jnp.where(x > 0, x, 1))


def mean_edge_length(garment: Garment, edges: Garment | CoarseEdges) -> Float[Array, ""]:
    """Return the mean length at rest of the garment's edges, or of a coarse level's [m]."""
    rest = _edge_vectors(edges, garment.sewn_positions)
    total = jnp.sum(jnp.where(edges.edge_mask, safe_norm(rest), 0))
    return total / jnp.maximum(jnp.sum(edges.edge_mask.astype(rest.dtype)), 1)


def timestep_input(timestep: Float[Array, ""]) -> Float[Array, ""]:
    """Return log10 of the timestep over a thirtieth of a second: 0 for a regular frame."""
    return jnp.log10(timestep / REGULAR_TIMESTEP)


# --- HOOD ---------------------------------------------------------------------------------------------------


def hood_garment_features(
    garment: Garment, material: Material, inputs: GraphInputs
) -> Float[Array, "vertices 11"]:
    """Return velocity 3 [m per frame], normal 3, timestep [s], ln mass [ln kg] and material inputs 3.

    The model inserts the embedding of the vertex type behind the velocity, which makes 20 columns.
    """
    timestep = jnp.broadcast_to(inputs.timestep, inputs.position.shape[:1])
    mass = log_positive(vertex_masses(garment, material))
    normals = vertex_normals(inputs.position, garment.faces, garment.face_incidence)
    return jnp.column_stack([inputs.velocity, normals, timestep, mass, material_inputs(garment, material)])


def hood_body_features(contacts: Contacts, timestep: Float[Array, ""]) -> Float[Array, "world_edges 11"]:
    """Return the columns of `hood_garment_features` for body points; mass and material are -1."""
    velocity = contacts.next_points - contacts.points
    unknown = -jnp.ones((velocity.shape[0], 4), velocity.dtype)
    column = jnp.broadcast_to(timestep, velocity.shape[:1])
    return jnp.column_stack([velocity, contacts.normals, column, unknown])


def hood_edge_features(
    garment: Garment,
    material: Material,
    inputs: GraphInputs,
    edges: Garment | CoarseEdges,
    *,
    reads_state: bool,
) -> Float[Array, "edges features"]:
    """Return sender minus receiver 3 [m], its norm, the same at rest 4, timestep [s], material inputs 3.

    With the state there are before them sender's velocity less receiver's 3 [m per frame], strain now, and strain
    where velocity alone leads: columns that are not normalised stay last. Edges are the garment's own, or those
    of a coarse level.
    """
    now, rest = _edge_vectors(edges, inputs.position), _edge_vectors(edges, garment.sewn_positions)
    constants = material_inputs(garment, material)
    rows = [
        with_norm(now),
        with_norm(rest),
        jnp.broadcast_to(inputs.timestep, now.shape[:1]),
        (constants[edges.senders] + constants[edges.receivers]) / 2,
    ]
    if reads_state:
        moving, rest_length = _edge_vectors(edges, inputs.velocity), safe_norm(rest)
        rows = [moving, _strain(now, rest_length), _strain(now + moving, rest_length), *rows]
    return jnp.column_stack(rows)


def hood_world_features(
    contacts: Contacts, inputs: GraphInputs, *, reads_state: bool
) -> Float[Array, "world_edges features"]:
    """Return body point minus vertex 3 [m], its norm, the same with the body's next frame 4, timestep [s].

    As on mesh edges, that is sender minus receiver. With the state there are two signed distances behind them:
    from the body point now; from its next plane, of where velocity alone leads.
    """
    position = to_world_edges(inputs.position, contacts.points.shape[0])
    timestep = jnp.broadcast_to(inputs.timestep, position.shape[:1])
    rows = [with_norm(contacts.points - position), with_norm(contacts.next_points - position), timestep]
    if reads_state:
        later = plane_distance(inputs.position + inputs.velocity, contacts)
        rows += [clip(distance / DISTANCE_SCALE) for distance in (contacts.distances, later)]
    return jnp.column_stack(rows)


def reverse_world_features(
    rows: Float[Array, "world_edges features"],
) -> Float[Array, "world_edges features"]:
    """Return the features of the opposite world edges: the two leading (vector, norm) pairs change sign."""
    signs = jnp.ones(rows.shape[1], rows.dtype).at[jnp.array([0, 1, 2, 4, 5, 6])].set(-1)
    return rows * signs[None]


# --- gradient -----------------------------------------------------------------------------------------------
# Every kind of row has features that stay for a frame, and features that change with every refinement step.

NODE_FRAME_SIZE, NODE_REFINEMENT_SIZE = 14, 18
MESH_FRAME_SIZE, MESH_REFINEMENT_SIZE = 8, 4
WORLD_FRAME_SIZE, WORLD_REFINEMENT_SIZE = 10, 2
BODY_FRAME_SIZE = 10


def frame_node_features(
    garment: Garment, material: Material, inputs: GraphInputs, edge_length: Float[Array, ""]
) -> Float[Array, "vertices 14"]:
    """Return velocity 3, normal 3, timestep, density, vertex area, mesh spacing, pinned, material inputs 3."""
    rows = inputs.position.shape[:1]
    return jnp.column_stack(
        [
            clip(inputs.velocity / VELOCITY_SCALE),
            vertex_normals(inputs.position, garment.faces, garment.face_incidence),
            jnp.broadcast_to(timestep_input(inputs.timestep), rows),
            jnp.log(jnp.broadcast_to(material.density, rows) / DENSITY_SCALE),
            clip(log_positive(garment.vertex_areas / edge_length**2)),
            jnp.broadcast_to(jnp.log(edge_length / EDGE_LENGTH_SCALE), rows),
            garment.is_pinned.astype(inputs.position.dtype),
            clip(material_inputs(garment, material)),
        ]
    )


def refinement_node_features(
    garment: Garment, material: Material, inputs: RefinementInputs, edge_length: Float[Array, ""]
) -> Float[Array, "vertices 18"]:
    """Return push-out 3, force 4, descent step 4, last correction 3 and last force 4.

    A force f enters as its direction times s, and s = asinh(|f| / (m g)) / 2, with g at least
    `LEAST_GRAVITY`. The descent step enters through tanh, in units of a tenth of the mesh spacing, and its
    size through log1p.
    """
    weight = jnp.maximum(inputs.weight, LEAST_GRAVITY * vertex_masses(garment, material))
    unit = jnp.maximum(weight, 1e-12)[:, None]  # a padded vertex has no mass

    def force_features(force):
        size = jnp.arcsinh(safe_norm(force, keepdims=True) / unit) / 2
        return safe_normalize(force) * size, size

    scaled = inputs.step / (STEP_SCALE * edge_length)
    return jnp.column_stack(
        [
            clip((inputs.guess - inputs.inertial_guess) / GUESS_SCALE),
            *force_features(-inputs.gradient),
            jnp.tanh(scaled),
            jnp.log1p(safe_norm(scaled)) / 2,
            clip(inputs.correction / GUESS_SCALE),
            *force_features(-inputs.previous_gradient),
        ]
    )


def frame_mesh_features(
    garment: Garment,
    position: Float[Array, "vertices 3"],
    edges: Garment | CoarseEdges,
    edge_length: Float[Array, ""],
) -> Float[Array, "edges 8"]:
    """Return sender minus receiver 3, the same at rest 3, rest length less one, in mean lengths; strain.

    Positions [m] and the mean length at rest [m] are those of `edges`: the garment's own, or of a coarse level.
    """
    current = _edge_vectors(edges, position)
    rest = _edge_vectors(edges, garment.sewn_positions)
    rest_length = safe_norm(rest)
    return jnp.column_stack(
        [
            clip(current / edge_length),
            clip(rest / edge_length),
            clip(rest_length / edge_length - 1),
            _strain(current, rest_length),
        ]
    )


def refinement_mesh_features(
    garment: Garment,
    guess: Float[Array, "vertices 3"],
    edges: Garment | CoarseEdges,
    edge_length: Float[Array, ""],
) -> Float[Array, "edges 4"]:
    """Return sender minus receiver at the guess 3, in mean lengths, and its strain; see `frame_mesh_features`."""
    rest_length = safe_norm(_edge_vectors(edges, garment.sewn_positions))
    vector = _edge_vectors(edges, guess)
    return jnp.column_stack([clip(vector / edge_length), _strain(vector, rest_length)])


def _edge_vectors(
    edges: Garment | CoarseEdges, position: Float[Array, "vertices 3"]
) -> Float[Array, "edges 3"]:
    """Return the vector from receiver to sender of every edge [m]."""
    return position[edges.senders] - position[edges.receivers]


def _strain(vector: Float[Array, "edges 3"], rest_length: Float[Array, " edges"]) -> Float[Array, " edges"]:
    """Return the relative change of length over `STRAIN_SCALE`; zero where padded."""
    is_real = rest_length > 0
    ratio = safe_norm(vector) / jnp.where(is_real, rest_length, 1)
    return clip(jnp.where(is_real, ratio - 1, 0) / STRAIN_SCALE)


def frame_world_features(contacts: Contacts, inputs: GraphInputs) -> Float[Array, "world_edges 10"]:
    """Return the offset from the body point now 4 and at the next frame 4, with norms; signed distances 2."""
    position = to_world_edges(inputs.position, contacts.points.shape[0])
    rows = [
        with_norm(position - contacts.points) / BODY_OFFSET_SCALE,
        with_norm(position - contacts.next_points) / BODY_OFFSET_SCALE,
        contacts.distances / DISTANCE_SCALE,
        plane_distance(inputs.inertial_guess, contacts) / DISTANCE_SCALE,
    ]
    return clip(jnp.column_stack(rows))


def refinement_world_features(
    guess: Float[Array, "vertices 3"], contacts: Contacts
) -> Float[Array, "world_edges 2"]:
    """Return the guess's signed distance to the body's next tangent plane, coarse and in contact widths."""
    distance = plane_distance(guess, contacts)
    return clip(jnp.column_stack([distance / DISTANCE_SCALE, distance / CONTACT_SCALE]))


def plane_distance(position: Float[Array, "vertices 3"], contacts: Contacts) -> Float[Array, " world_edges"]:
    """Return the signed distance [m] of an edge's vertex to the tangent plane at the body's next frame."""
    position = to_world_edges(position, contacts.points.shape[0])
    return jnp.sum((position - contacts.next_points) * contacts.next_normals, axis=1)


def frame_body_features(contacts: Contacts, timestep: Float[Array, ""]) -> Float[Array, "world_edges 10"]:
    """Return the body point's velocity 3, its normal now 3 and at the next frame 3, and the timestep."""
    velocity = contacts.next_points - contacts.points
    column = jnp.broadcast_to(timestep_input(timestep), velocity.shape[:1])
    return jnp.column_stack(
        [clip(velocity / VELOCITY_SCALE), contacts.normals, contacts.next_normals, column]
    )
