"""Decide what a scene models, from what is there (host)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from eslr_jax.body.motion import SHOULDERS, check_length
from eslr_jax.contact.self_contact import SEARCH_RADIUS, starting_capacity
from eslr_jax.errors import ConfigError, MeshError
from eslr_jax.geometry.padding import choose_bucket, common_bucket
from eslr_jax.geometry.prepare import pad_alike
from eslr_jax.geometry.surface import prepare_surface
from eslr_jax.geometry.topology import vertex_components
from eslr_jax.physics.validate import validate_air, validate_damping, validate_substeps
from eslr_jax.scene.build import (
    Integrator,
    ScenePlan,
    build_scene,
    skin_garment,
    slice_tracks,
    worn_material,
)
from eslr_jax.terms.air import Air
from eslr_jax.terms.damping import Damping
from eslr_jax.terms.term import Term
from eslr_jax.types import Body, BodyMotion, BodySurface, Garment, Material, PhysicsConstants, Scene

# [m] that cloth may be away from its skinned place, besides its distance from the body at rest. Body faces that
# are farther away are left out.
REACH = 0.08
_SHARED_REACH = 0.15  # [m] of scenes that share a surface, chosen in the rest pose alone
_FAR_AT_REST = (
    2.0 * SEARCH_RADIUS
)  # [m] between places of one piece that may come close; nearer ones bend towards
_SPACING = 0.1  # [s] between the frames that are looked at to decide what is modelled
_MOST_COMPARED = (
    4000  # vertices of a piece that are compared with each other; a part of a finer one is enough
)
Ground = Literal["auto", "on", "off"]
_build = jax.jit(build_scene)
_skin = jax.jit(skin_garment)


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """What to model beyond what is there; host only."""

    reach: float = REACH  # [m], besides how far the garment hangs from the body at rest
    has_body: bool = True
    start_at_rest: bool = False  # zero initial velocity instead of the body's
    self_contact: bool | None = None  # keep layers of cloth apart; None: where two pieces can meet
    has_folds: bool = False  # self_contact None: keep a one-piece garment off itself, if it can meet itself
    has_skin: bool = False  # keep the faces of the cloth off the skin, besides its vertices off the body
    has_tips: bool = False  # the body has tips finer than the cloth, as a needle has: faces keep off them
    integrator: Integrator = "euler"
    substeps: int = 1  # in which a frame is simulated
    # A level ground at the lowest point of the moving body; auto: if cloth could reach it.
    ground: Ground = "auto"
    air: Air | None = None  # drag and wind; None: a vacuum
    damping: float | None = None  # of the fabric [s], see `terms.damping`; None: none
    terms: tuple[Term, ...] = ()  # of one's own, see `terms.term.Term`


def plan_scene(
    garment: Garment,
    poses: BodyMotion,
    *,
    constants: PhysicsConstants | None = None,
    options: SceneOptions | None = None,
    surface: BodySurface | None = None,
) -> ScenePlan:
    """Decide what a scene models: only body faces that the garment can reach, and pins only if it has some.

    A piece is a connected component of the mesh. Self-contact is modelled between pieces that come close to each
    other. Within one piece it is modelled only on request: always with `self_contact=True`, and with
    `has_folds=True` if the piece can touch itself. Networks are trained without self-contact. The buffer of pairs
    starts small, because `simulate` enlarges it. A pure `rollout` can't: replace `plan.self_contact` by
    `default_capacity`, or check the status of the trajectory.

    Args:
        garment: A prepared garment.
        poses: The body in motion.
        constants: Physical constants; by default those for the fabric, see `physics.materials.constants_for`.
        options: What to leave out or add.
        surface: Body faces to search instead of those in reach, so that several scenes share one compiled
            rollout; see `shared_surface`.

    Raises:
        MotionError: The motion has fewer than two frames.
        MeshError: The garment hangs on joints that the body does not have.
        ConfigError: An option has a value that it can't have.
    """
    options = options or SceneOptions()
    _check_choices(options)
    check_length(poses)
    _check_joints(garment, poses)
    skinned, looseness = np.empty(0), np.empty(0)
    piece, has_layers = piece_of_vertices(garment), options.self_contact
    num_pieces = int(piece.max()) + 1
    is_undecided = has_layers is None and (num_pieces > 1 or options.has_folds)
    needs_surface = options.has_body and surface is None
    needs_ground = options.has_body and options.ground == "auto"
    if is_undecided or needs_surface or needs_ground:
        skinned = np.asarray(_skin(garment, poses.joint_transforms))
        looseness = _looseness(garment, poses)
    radii = options.reach + looseness
    if is_undecided:
        is_real = np.asarray(garment.vertex_mask)
        looked_at = skinned[_sampled(poses)][:, is_real]
        has_layers = (
            _pieces_meet(piece[is_real], looked_at)
            if num_pieces > 1
            else _meets_itself(garment, looseness, looked_at)
        )
    if not options.has_body:
        surface = None
    elif surface is None:
        surface = _surface_near(reachable_vertices(garment, skinned, poses, radii), poses)
    has_ground = options.ground == "on"
    if needs_ground:
        has_ground = _could_fall(garment, poses, piece) or _reaches_ground(garment, skinned, poses, radii)
    return ScenePlan(
        surface=surface,
        constants=constants,
        has_pins=bool(np.any(garment.is_pinned)),
        starts_at_rest=options.start_at_rest,
        self_contact=starting_capacity(len(piece), num_pieces) if has_layers else None,
        pieces=jnp.asarray(piece) if has_layers and is_undecided and num_pieces > 1 else None,
        has_skin=options.has_skin,
        has_tips=options.has_tips,
        integrator=options.integrator,
        substeps=validate_substeps(options.substeps),
        ground=ground_height(poses) if has_ground else None,
        terms=_asked_for(options),
    )


def prepare_scene(
    garment: Garment,
    poses: BodyMotion,
    *,
    material: Material | None = None,
    constants: PhysicsConstants | None = None,
    options: SceneOptions | None = None,
    surface: BodySurface | None = None,
    on_shapes: Callable[[Scene], None] = lambda shapes: None,
) -> Scene:
    """Return the scene of a garment on a moving body, without what it does not need.

    Frame 0 is the garment skinned to the first pose and pushed out of the body.

    Args:
        garment: A prepared garment.
        poses: The body in motion.
        material: Fabric; by default the garment's own, of its file, or else cotton.
        constants: Physical constants; by default those for the fabric, see `physics.materials.constants_for`.
        options: What to leave out or add.
        surface: Body faces to search, see `plan_scene`.
        on_shapes: Called with the shapes of the scene's arrays before they are made; a rollout of them can be
            compiled meanwhile, see `simulation.simulate.begin_compiling`.

    Raises:
        MotionError: The motion has fewer than two frames.
        MeshError: The garment hangs on joints that the body does not have.
        ConfigError: An option has a value that it can't have.
    """
    material = worn_material(garment, material)
    plan = plan_scene(garment, poses, constants=constants, options=options, surface=surface)
    on_shapes(_build.eval_shape(garment, poses, material, plan))
    return _build(garment, poses, material, plan)


def prepare_scenes(
    garments: Sequence[Garment],
    poses: Sequence[BodyMotion],
    materials: Sequence[Material | None],
    *,
    constants: PhysicsConstants | None = None,
    options: SceneOptions | None = None,
) -> list[Scene]:
    """Return scenes that can be stacked: padded to one bucket, over one part of the body.

    All scenes model what one of them needs: pins, self-contact and a ground. All search the body faces near any
    of the garments at rest on the first body, whatever the motion. So other motions of the same garments run the
    same compiled rollout.

    Args:
        garments: Unpadded garments of like sizes.
        poses: As many motions of bodies with the same faces and rest pose, and of the same length.
        materials: As many fabrics, isotropic and the same all over a garment; see `prepare_scene` for None.
        constants: Physical constants of all; by default those for each fabric.
        options: What to leave out or add.

    Raises:
        MotionError: A motion has fewer than two frames.
        MeshError: A garment hangs on joints that its body does not have.
        ConfigError: An option has a value that it can't have.
    """
    options = options or SceneOptions()
    fabrics = [
        worn_material(garment, material) for garment, material in zip(garments, materials, strict=True)
    ]
    if any(np.ndim(leaf) for material in fabrics for leaf in jax.tree.leaves(material)):
        raise ConfigError(
            "a batch takes one isotropic fabric for each garment, with bending_stiffness; simulate garments with "
            "fabrics by part, threads or bending in N m one by one"
        )
    padded = pad_alike(garments, common_bucket([choose_bucket(garment) for garment in garments]))
    surface = shared_surface(padded, poses[0]) if options.has_body else None
    plans = [
        plan_scene(garment, motion, constants=constants, options=options, surface=surface)
        for garment, motion in zip(padded, poses, strict=True)
    ]
    has_pins = any(plan.has_pins for plan in plans)
    if any(plan.ground is not None for plan in plans):
        plans = [
            plan.replace(ground=ground_height(motion)) for plan, motion in zip(plans, poses, strict=True)
        ]
    has_one_piece = any(plan.self_contact is not None and plan.pieces is None for plan in plans)
    capacities = [plan.self_contact for plan in plans if plan.self_contact is not None]
    layers = max(capacities, key=lambda capacity: capacity.pairs, default=None)
    plans = [plan.replace(has_pins=has_pins, self_contact=layers) for plan in plans]
    has_pieces = layers is not None and not has_one_piece
    plans = [
        plan.replace(pieces=jnp.asarray(piece_of_vertices(garment)) if has_pieces else None)
        for garment, plan in zip(padded, plans, strict=True)
    ]
    return [
        _build(garment, motion, material, plan)
        for garment, motion, plan, material in zip(padded, poses, plans, fabrics, strict=True)
    ]


def _asked_for(options: SceneOptions) -> tuple[Term, ...]:
    """Return the terms that are modelled because somebody asks for them."""
    terms: list[Term] = []
    if options.air is not None:
        terms.append(validate_air(options.air))
    if options.damping is not None:
        terms.append(Damping(validate_damping(options.damping)))
    return (*terms, *options.terms)


def _check_choices(options: SceneOptions) -> None:
    """Refuse words that are none of an option's."""
    for name, accepted in (("integrator", get_args(Integrator)), ("ground", get_args(Ground))):
        if getattr(options, name) not in accepted:
            raise ConfigError(f"{name} is {getattr(options, name)!r}; give one of {', '.join(accepted)}")


def first_frames(scene: Scene, num_frames: int) -> Scene:
    """Return the first frames of a scene, at most all of them."""
    num_frames = min(num_frames, scene.num_frames)
    return slice_tracks(scene, slice(num_frames)).replace(num_frames=num_frames)


def _check_joints(garment: Garment, poses: BodyMotion) -> None:
    """Raise where a garment hangs on joints that the body does not have, whose weights would be lost."""
    last, num_joints = int(np.max(garment.skin_indices)), poses.joint_transforms.shape[1]
    if last >= num_joints:
        raise MeshError(
            f"the garment was fitted to another body: it hangs on joint {last}, and this body has {num_joints} "
            "joints, counted from 0; give the mesh that it was fitted from, or carry that mesh to this body with "
            "eslr fit --made-for"
        )


def ground_height(poses: BodyMotion) -> Float[Array, ""]:
    """Return the height of the ground that a body moves on [m]: that of its lowest point."""
    return jnp.min(poses.positions[..., 1])


def _could_fall(garment: Garment, poses: BodyMotion, piece: np.ndarray) -> bool:
    """Tell whether a part of a garment has no pin, and no cloth above the shoulders that it could hang from."""
    is_real = np.asarray(garment.vertex_mask)
    height = np.asarray(garment.rest_positions)[is_real, 1]
    body = np.asarray(poses.rest_positions)[:, 1]
    shoulders = body.min() + SHOULDERS * np.ptp(body)
    piece = piece[is_real]
    is_held = np.asarray(garment.is_pinned)[is_real] | (height > shoulders)
    return bool(np.setdiff1d(piece, piece[is_held]).size)


def _reaches_ground(garment: Garment, skinned: np.ndarray, poses: BodyMotion, radii: np.ndarray) -> bool:
    """Tell whether a free vertex comes as near to the ground as it may stray."""
    is_real = np.asarray(garment.vertex_mask)
    lowest = skinned[:, is_real, 1].min(axis=0) - radii
    is_free = ~np.asarray(garment.is_pinned)[is_real]
    return bool((lowest[is_free] < float(ground_height(poses))).any())


def _sampled(poses: BodyMotion) -> np.ndarray:
    """Return the frames that are looked at to decide what is modelled: ten a second, first and last included."""
    last, spacing = poses.positions.shape[0] - 1, max(round(_SPACING / float(poses.timestep)), 1)
    return np.unique(np.linspace(0, last, -(-last // spacing) + 1).astype(int))


def piece_of_vertices(garment: Garment) -> Int[np.ndarray, " vertices"]:
    """Return the piece of cloth that every vertex belongs to, which no edge joins to others; -1 where padded."""
    faces = np.asarray(garment.faces)[np.asarray(garment.rest_areas) > 0]
    is_real = np.asarray(garment.vertex_mask)
    pieces = np.full(len(is_real), -1, np.int32)
    pieces[is_real] = vertex_components(faces, int(is_real.sum()))[1]
    return pieces


def _pieces_meet(piece: np.ndarray, skinned: np.ndarray) -> bool:
    """Return whether two pieces come close enough to touch.

    Args:
        piece: Number of the piece of every vertex, shape [vertices].
        skinned: Positions in a sample of frames [m], shape [frames, vertices, 3].
    """
    for positions in skinned:
        for number in range(1, piece.max() + 1):
            one, others = positions[piece == number], positions[piece < number]
            if np.isfinite(cKDTree(others).query(one, distance_upper_bound=SEARCH_RADIUS)[0]).any():
                return True
    return False


def _meets_itself(garment: Garment, looseness: np.ndarray, skinned: np.ndarray) -> bool:
    """Return whether cloth of one piece can touch itself.

    It hangs so far off the body that it can fold, or two places that are far apart at rest come close, such as a
    sleeve and the trunk.

    Args:
        garment: A prepared garment.
        looseness: How far its real vertices hang from the body at rest [m].
        skinned: Positions of its real vertices in a sample of frames [m], shape [frames, vertices, 3].
    """
    if np.max(looseness, initial=0.0) > SEARCH_RADIUS:
        return True
    rest = np.asarray(garment.rest_positions)[np.asarray(garment.vertex_mask)]
    stride = -(-len(rest) // _MOST_COMPARED)
    rest = rest[::stride]
    for positions in skinned[:, ::stride]:
        pairs = cKDTree(positions).query_pairs(SEARCH_RADIUS, output_type="ndarray")
        if np.any(np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1) > _FAR_AT_REST):
            return True
    return False


def reachable_vertices(
    garment: Garment, skinned: np.ndarray, poses: BodyMotion, radii: np.ndarray
) -> np.ndarray:
    """Return which body vertices the skinned garment can reach, looking ten times a second.

    A T-shirt's scene then searches no legs, no head and no feet. `radii` say how far each real vertex strays [m].
    """
    is_real = np.asarray(garment.vertex_mask)
    bodies = np.asarray(poses.positions)  # cut on the host, where it compiles nothing
    is_near = np.zeros(bodies.shape[1], bool)
    for frame in _sampled(poses):
        far = np.flatnonzero(~is_near)  # once is enough
        points = bodies[frame, far]
        is_near[far] = _within(radii, np.asarray(skinned[frame])[is_real], points)
    return is_near


def shared_surface(
    garments: Sequence[Garment], body: Body | BodyMotion, reach: float = _SHARED_REACH
) -> BodySurface | None:
    """Return the obstacle faces that any of the garments can reach in the rest pose; `reach` in metres."""
    rest = np.asarray(body.rest_positions)
    is_near = np.zeros(len(rest), bool)
    for garment in garments:
        points = np.asarray(garment.rest_positions)[np.asarray(garment.vertex_mask)]
        is_near |= _within(reach + _looseness(garment, body), points, rest)
    return _surface_near(is_near, body)


def _surface_near(is_near: np.ndarray, body: Body | BodyMotion) -> BodySurface | None:
    """Return the surface of the obstacle faces with a vertex among those; None without any."""
    faces = np.asarray(body.faces)[np.asarray(body.is_obstacle)]
    is_kept = is_near[faces].any(axis=1)
    if not is_kept.any():
        return None
    boundary = np.intersect1d(faces[is_kept], faces[~is_kept])
    return prepare_surface(np.asarray(body.rest_positions), faces[is_kept], boundary=boundary)


def _looseness(garment: Garment, body: Body | BodyMotion) -> np.ndarray:
    """Return how far real vertices hang from the body at rest [m]: a hem swings, a collar does not."""
    obstacle = np.unique(np.asarray(body.faces)[np.asarray(body.is_obstacle)])
    points = np.asarray(garment.rest_positions)[np.asarray(garment.vertex_mask)]
    distance, _ = cKDTree(np.asarray(body.rest_positions)[obstacle]).query(points)
    return distance


def _within(radii: np.ndarray, centers: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points lie within the radius around any of the centers."""
    is_within = np.zeros(len(points), bool)
    most = np.max(radii, initial=0.0)
    low, high = centers.min(axis=0) - most, centers.max(axis=0) + most
    boxed = np.flatnonzero(((points > low) & (points < high)).all(axis=1))  # a tree of few is quick to search
    for hits in cKDTree(points[boxed]).query_ball_point(centers, radii):
        is_within[boxed[hits]] = True
    return is_within
