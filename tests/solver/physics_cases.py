"""A small crumpled sheet between two moving bodies: one frame, in either precision."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from cloth import make_garment, make_sheet

from eslr_jax import Material
from eslr_jax.mesh import topology
from eslr_jax.mesh.padding import pad_garment
from eslr_jax.numerics import to_device
from eslr_jax.terms import Bending, Collision, Friction, Gravity, Inertia, Stretch
from eslr_jax.terms.collision import BodyContact
from eslr_jax.terms.friction import Rubbing
from eslr_jax.terms.term import FrameProblem
from eslr_jax.types import Contacts, Garment

TIMESTEP = 1 / 30
BODY_MOTION = np.array([0.003, 0.002, -0.001])  # [m] in the frame
GAP = 0.008  # [m] between the two bodies, along y


def to_numpy(tree, dtype=np.float64):
    """Return a pytree with NumPy leaves, the floating ones cast."""
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, dtype) if np.asarray(leaf).dtype.kind == "f" else np.asarray(leaf), tree
    )


def float64_garment(garment: Garment) -> Garment:
    """Return a garment whose rest quantities are exact for its (rounded) rest positions."""
    garment = to_numpy(garment)
    rest, faces = garment.rest_positions, garment.faces
    areas = topology.face_areas(rest, faces)
    _, hinge_faces = topology.find_hinges(faces.astype(np.int64))
    return dataclasses.replace(
        garment,
        rest_areas=areas,
        inverse_rest_frames=topology.inverse_rest_frames(rest, faces),
        hinge_rest_areas=areas[hinge_faces].sum(axis=1),
        hinge_rest_lengths=np.linalg.norm(rest[garment.hinges[:, 1]] - rest[garment.hinges[:, 0]], axis=1),
        vertex_areas=topology.vertex_areas(areas, faces, len(rest)),
    )


class Case(NamedTuple):
    """One frame of the sheet; NumPy leaves of one precision."""

    problem: FrameProblem
    position: Any  # a candidate at t + 1 [m]


def make_contacts(start, normals, heights, is_near) -> Contacts:
    """Return contacts with body points that lie `heights` below the cloth along their normals."""
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    points = start - normals * heights[:, None]
    return Contacts(
        points=points,
        next_points=points + BODY_MOTION,
        normals=normals,
        next_normals=normals,
        distances=heights,
        is_near=is_near,
        faces=np.zeros(len(start), np.int32),
    )


def make_case(*, seed=0, dtype=np.float64, is_pinned=None) -> Case:
    positions, faces = make_sheet(seed=seed)
    garment = float64_garment(make_garment(positions, faces, is_pinned=is_pinned))
    random = np.random.default_rng(seed + 1)
    count = len(positions)

    def noise(scale, *columns):
        return scale * random.standard_normal((count, *columns))

    start = np.asarray(garment.rest_positions) * [1.05, 1.0, 0.97] + noise(0.004, 3)
    start[:, 1] += 0.03 * np.sin(12 * start[:, 0])
    up = np.array([0.0, 1.0, 0.0])
    below = make_contacts(
        start, up + noise(0.2, 3), 0.002 + np.abs(noise(0.002)), random.uniform(size=count) < 0.8
    )
    above = make_contacts(
        start, noise(0.2, 3) - up, GAP - below.distances, below.is_near & (random.uniform(size=count) < 0.6)
    )
    material = Material(
        density=0.2 * random.uniform(0.5, 2, count),
        lame_mu=2.4e4 * random.uniform(0.5, 2, len(faces)),
        lame_lambda=4.4e4 * random.uniform(0.5, 2, len(faces)),
        bending_stiffness=4e-5 * random.uniform(0.5, 2, len(garment.hinges)),
        thickness=4.7e-4 * random.uniform(0.5, 2, len(faces)),
    )
    problem = FrameProblem(
        garment=garment,
        material=material,
        timestep=np.float64(TIMESTEP),
        position=start,
        inertial_guess=start + noise(0.002, 3),
        friction_load=np.abs(noise(1e-3)),
        pin_targets=None if is_pinned is None else start + 0.01,
    )
    # As wide as the gap is narrow, so that both sides press.
    touching = BodyContact(below, above, thickness=np.float64(5e-3), stiffness=np.float64(3.5e7))
    friction = Friction()
    rubbing = (Rubbing(below, friction.coefficient * problem.friction_load),)
    problem = problem.replace(
        terms=(Stretch(), Bending(), Inertia(), Gravity(), Collision(), friction),
        data=(None, None, None, None, touching, rubbing),
    )
    return to_numpy(Case(problem, start + BODY_MOTION + noise(0.001, 3)), dtype)


def pad_case(case: Case) -> Case:
    """Return the case with every array padded to a bucket; padded rows are the last one, without its load."""
    plain = case.problem.garment
    garment = pad_garment(plain)
    tables = ("vertex_mask", "faces", "hinges")
    sizes = {len(getattr(plain, name)): len(getattr(garment, name)) for name in tables}

    def grow(leaf):
        more = sizes[len(leaf)] - len(leaf) if leaf.ndim and len(leaf) in sizes else 0
        return np.pad(leaf, [(0, more)] + [(0, 0)] * (leaf.ndim - 1), mode="edge") if more else leaf

    grown = jax.tree.map(grow, case._replace(problem=case.problem.replace(garment=None)))
    *others, (rubbing,) = grown.problem.data
    rubbing = rubbing._replace(force=rubbing.force * garment.vertex_mask)
    problem = grown.problem.replace(
        garment=to_device(garment),
        friction_load=grown.problem.friction_load * garment.vertex_mask,
        data=(*others, (rubbing,)),
    )
    return grown._replace(problem=problem)
