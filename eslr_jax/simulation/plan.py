"""Decide what a scene models, from what is there (host)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, get_args

import jax
import numpy as np

from eslr_jax.errors import ConfigError, MeshError
from eslr_jax.mesh.padding import choose_bucket, common_bucket
from eslr_jax.mesh.prepare import pad_alike
from eslr_jax.mesh.surface import pad_body
from eslr_jax.pose.motion import check_length
from eslr_jax.simulation.program import find_program
from eslr_jax.simulation.scene import (
    Integrator,
    first_state,
    reached_body,
    scene_from,
    slice_tracks,
    worn_material,
)
from eslr_jax.terms import Term, scene_terms
from eslr_jax.terms.worn import Worn, looseness, skinned_frames, surface_near, within
from eslr_jax.types import Body, BodyMotion, BodySurface, Garment, Material, Obstacle, Scene

_SHARED_REACH = 0.15  # [m] of scenes that share a surface, chosen in the rest pose alone
# Vertices of a garment whose start is not compiled briefly, see `find_program`: that of a dress at 4k would take
# 0.45 in place of 0.08 s, in every run.
_LARGE = 3000


def plan_scene(
    garment: Garment,
    poses: BodyMotion,
    terms: tuple[Term, ...] | None = None,
    *,
    surface: BodySurface | None = None,
) -> tuple[tuple[Term, ...], BodyMotion]:
    """Decide what a scene models: only terms that it needs, and only body faces that the garment can reach.

    Args:
        garment: A prepared garment.
        poses: The body in motion.
        terms: What to model where it is needed; by default `scene_terms()`.
        surface: Body faces to search instead of those in reach, so that several scenes share one compiled
            rollout, see `shared_surface`.

    Returns:
        Terms and motion as `rollout` takes them.

    Raises:
        MotionError: The motion has fewer than two frames.
        MeshError: The garment hangs on joints that the body does not have.
        ConfigError: A constant of a term is out of its range.
    """
    planned, poses = _plan(garment, poses, terms, surface)
    return planned, _cleared(poses, planned)


def _plan(
    garment: Garment, poses: BodyMotion, terms: tuple[Term, ...] | None, surface: BodySurface | None
) -> tuple[tuple[Term, ...], BodyMotion]:
    """Do what `plan_scene` does, but leave the body as it moves."""
    _check(garment, poses)
    worn, planned = Worn(garment, poses, surface), []
    for term in scene_terms() if terms is None else terms:
        term.check()
        if (needed := term.plan(worn, planned)) is not None:
            planned.append(needed)
    if any(term.reads_body for term in planned) and worn.surface is not None:
        poses = poses.replace(surface=worn.surface)
    return tuple(planned), poses


def prepare_scene(
    garment: Garment,
    poses: BodyMotion,
    *,
    material: Material | None = None,
    terms: tuple[Term, ...] | None = None,
    integrator: Integrator = "euler",
    substeps: int = 1,
    starts_at_rest: bool = False,
    surface: BodySurface | None = None,
    on_shapes: Callable[[Scene], None] = lambda shapes: None,
) -> Scene:
    """Return the scene of a garment on a moving body, without what it does not need.

    Frame 0 is the garment skinned to the first pose and pushed out of the body.

    Args:
        garment: A prepared garment.
        poses: The body in motion.
        material: Fabric; by default the garment's own, of its file, or else cotton.
        terms: What to model where it is needed; by default `scene_terms()`.
        integrator: How time is stepped.
        substeps: Number of equal parts in which a frame is simulated.
        starts_at_rest: Frame 0 stands still; else it moves as the body does.
        surface: Body faces to search, see `plan_scene`.
        on_shapes: Called with the shapes of the scene's arrays before they are made; a rollout of them can be
            compiled meanwhile, see `simulation.simulate.begin_compiling`.

    Raises:
        MotionError: The motion has fewer than two frames.
        MeshError: The garment hangs on joints that the body does not have.
        ConfigError: An option has a value that it can't have.
    """
    _check_stepping(integrator, substeps)
    planned, poses = _plan(garment, poses, terms, surface)
    stepping = {"integrator": integrator, "substeps": substeps, "starts_at_rest": starts_at_rest}
    given = (garment, poses, worn_material(garment, material), planned)
    return _build(*given, on_shapes, **stepping, has_pins=bool(np.any(np.asarray(garment.is_pinned))))


def prepare_scenes(
    garments: Sequence[Garment],
    poses: Sequence[BodyMotion],
    materials: Sequence[Material | None],
    *,
    terms: tuple[Term, ...] | None = None,
    integrator: Integrator = "euler",
    substeps: int = 1,
    starts_at_rest: bool = False,
) -> list[Scene]:
    """Return scenes that can be stacked: padded to one bucket, over one part of the body.

    All scenes model what one of them needs. All search the body faces near any of the garments at rest on the
    first body, whatever the motion. So other motions of the same garments run the same compiled rollout.

    Args:
        garments: Unpadded garments of like sizes.
        poses: As many motions of bodies with the same faces and rest pose, and of the same length.
        materials: As many fabrics, isotropic and the same all over a garment; see `prepare_scene` for None.
        terms: What to model where it is needed; by default `scene_terms()`.
        integrator: How time is stepped.
        substeps: Number of equal parts in which a frame is simulated.
        starts_at_rest: Frame 0 stands still; else it moves as the body does.

    Raises:
        MotionError: A motion has fewer than two frames.
        MeshError: A garment hangs on joints that its body does not have.
        ConfigError: An option has a value that it can't have.
    """
    _check_stepping(integrator, substeps)
    fabrics = [
        worn_material(garment, material) for garment, material in zip(garments, materials, strict=True)
    ]
    if any(np.ndim(leaf) for material in fabrics for leaf in jax.tree.leaves(material)):
        raise ConfigError(
            "a batch takes one isotropic fabric for each garment, with bending_stiffness; simulate garments with "
            "fabrics by part, threads or bending in N m one by one"
        )
    padded = pad_alike(garments, common_bucket([choose_bucket(garment) for garment in garments]))
    asked_for = scene_terms() if terms is None else terms
    surface = shared_surface(padded, poses[0]) if any(term.reads_body for term in asked_for) else None
    worn = [Worn(garment, motion, surface) for garment, motion in zip(padded, poses, strict=True)]
    plans: list[list[Term]] = [[] for _ in worn]
    for one in worn:
        _check(one.garment, one.poses)
    for term in asked_for:
        term.check()
        asked = [term.plan(one, plan) for one, plan in zip(worn, plans, strict=True)]
        if needed := [one for one in asked if one is not None]:
            for one, plan in zip(worn, plans, strict=True):
                plan.append(term.alike(one, needed))
    stepping = {"integrator": integrator, "substeps": substeps, "starts_at_rest": starts_at_rest}
    has_pins = any(bool(np.any(garment.is_pinned)) for garment in garments)
    return [
        _build(
            one.garment,
            one.poses if surface is None else one.poses.replace(surface=surface),
            material,
            tuple(plan),
            lambda shapes: None,
            **stepping,
            has_pins=has_pins,
        )
        for one, plan, material in zip(worn, plans, fabrics, strict=True)
    ]


def _build(
    garment: Garment,
    poses: BodyMotion,
    material: Material,
    terms: tuple[Term, ...],
    on_shapes: Callable[[Scene], None],
    *,
    has_pins: bool,
    substeps: int,
    **starting: Any,
) -> Scene:
    """Return the scene of `build_scene`, whose first state comes from a program that is kept and shared.

    The body makes room for cloth after `on_shapes`, while programs compile.
    """
    poses = jax.device_get(poses)  # on the host nothing is compiled
    garment, material, terms = jax.device_put((garment, material, terms))
    poses = poses.replace(timestep=jax.device_put(poses.timestep))

    def on_body(poses: BodyMotion) -> tuple[Obstacle | None, tuple]:
        body = reached_body(poses, terms)
        first = None if body is None else pad_body(body.replace(positions=body.positions[:1]))
        given = garment.replace(material=None), poses.joint_transforms[:2], poses.timestep, first, terms
        return body, jax.device_put(given)

    body, given = on_body(poses)
    is_brief = len(garment.rest_positions) < _LARGE
    program = find_program(first_state, given, is_brief=is_brief, **starting)
    pins = skinned_frames(garment, poses.joint_transforms) if has_pins else None
    parts = garment, poses, material, terms
    scene = scene_from(program.results, *parts, body=body, pin_targets=pins, substeps=substeps)
    on_shapes(scene)
    body, given = on_body(_cleared(poses, terms))
    return scene.replace(initial_state=program.wait()(*given), body=jax.device_put(body))


def _cleared(poses: BodyMotion, terms: Sequence[Term]) -> BodyMotion:
    """Return the motion of the body as all terms can take it."""
    return functools.reduce(lambda poses, term: term.clear_body(poses), terms, poses)


def _check_stepping(integrator: str, substeps: int) -> None:
    """Refuse what can't step a scene."""
    if integrator not in get_args(Integrator):
        raise ConfigError(f"integrator is {integrator!r}; give one of {', '.join(get_args(Integrator))}")
    if isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1:
        raise ConfigError(f"substeps = {substeps!r}; give a whole number, 1 or more")


def _check(garment: Garment, poses: BodyMotion) -> None:
    """Raise where there is no motion, or where a garment hangs on joints that the body does not have."""
    check_length(poses)
    last, num_joints = int(np.max(np.asarray(garment.skin_indices))), poses.joint_transforms.shape[1]
    if last >= num_joints:  # their weights would be lost
        raise MeshError(
            f"the garment was fitted to another body: it hangs on joint {last}, and this body has {num_joints} "
            "joints, counted from 0; give the mesh that it was fitted from, or carry that mesh to this body with "
            "eslr fit --made-for"
        )


def first_frames(scene: Scene, num_frames: int) -> Scene:
    """Return the first frames of a scene, at most all of them."""
    num_frames = min(num_frames, scene.num_frames)
    return slice_tracks(scene, slice(num_frames)).replace(num_frames=num_frames)


def shared_surface(
    garments: Sequence[Garment], body: Body | BodyMotion, reach: float = _SHARED_REACH
) -> BodySurface | None:
    """Return the obstacle faces that any of the garments can reach in the rest pose; `reach` in metres."""
    rest = np.asarray(body.rest_positions)
    is_near = np.zeros(len(rest), bool)
    for garment in garments:
        points = np.asarray(garment.rest_positions)[np.asarray(garment.vertex_mask)]
        is_near |= within(reach + looseness(garment, body), points, rest)
    return surface_near(is_near, body)
