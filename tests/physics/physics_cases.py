"""A small crumpled sheet over moving contacts: one frame, in either precision."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from eslr_jax.geometry import topology
from eslr_jax.geometry.padding import pad_garment
from eslr_jax.geometry.prepare import prepare_garment, to_device
from eslr_jax.physics.problem import FrameProblem, PhysicsParameters
from eslr_jax.types import Contacts, Garment, Material

TIMESTEP = 1 / 30


def make_sheet(rows=5, columns=6, spacing=0.05, *, seed=0, jitter=0.2):
    """A sheet facing +y; its inner vertices are moved at random, so that no two triangles are alike."""
    x, z = np.meshgrid(np.arange(columns) * spacing, np.arange(rows) * spacing)
    positions = np.stack([x, np.zeros_like(x), z], axis=-1)
    random = np.random.default_rng(seed)
    offset = random.uniform(-jitter, jitter, (rows - 2, columns - 2, 3))
    positions[1:-1, 1:-1] += offset * spacing * [1, 0.2, 1]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return positions.reshape(-1, 3), np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def make_garment(positions, faces, *, is_pinned=None) -> Garment:
    count = len(positions)
    return prepare_garment(
        positions,
        faces,
        skin_weights=np.ones((count, 1)),
        skin_indices=np.zeros((count, 1), int),
        is_pinned=is_pinned,
        allow_components=True,
    )


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
        hinge_rest_angles=topology.hinge_angles(rest, garment.hinges),
        vertex_areas=topology.vertex_areas(areas, faces, len(rest)),
    )


class Case(NamedTuple):
    """One frame of the sheet; NumPy leaves of one precision."""

    garment: Garment
    material: Material
    problem: FrameProblem
    position: Any  # a candidate at t + 1 [m]


def make_case(*, seed=0, dtype=np.float64, is_pinned=None) -> Case:
    positions, faces = make_sheet(seed=seed)
    garment = float64_garment(make_garment(positions, faces, is_pinned=is_pinned))
    random = np.random.default_rng(seed + 1)
    count = len(positions)

    def noise(scale, *columns):
        return scale * random.standard_normal((count, *columns))

    start = np.asarray(garment.rest_positions) * [1.05, 1.0, 0.97] + noise(0.004, 3)
    start[:, 1] += 0.03 * np.sin(12 * start[:, 0])
    normals = np.array([0.0, 1.0, 0.0]) + noise(0.2, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = start - normals * (0.002 + np.abs(noise(0.002)))[:, None]
    contacts = Contacts(
        points=points,
        next_points=points + np.array([0.003, 0.002, -0.001]),
        normals=normals,
        next_normals=normals,
        distances=np.einsum("va,va->v", start - points, normals),
        is_near=random.uniform(size=count) < 0.8,
    )
    problem = FrameProblem(
        position=start,
        inertial_guess=start + noise(0.002, 3),
        timestep=np.float64(TIMESTEP),
        pin_targets=None if is_pinned is None else start + 0.01,
        contacts=contacts,
        friction_load=np.abs(noise(1e-3)),
        collision_thickness=np.float64(2e-3),
        parameters=PhysicsParameters(),
    )
    material = Material(
        density=0.2 * random.uniform(0.5, 2, count),
        lame_mu=2.4e4 * random.uniform(0.5, 2, len(faces)),
        lame_lambda=4.4e4 * random.uniform(0.5, 2, len(faces)),
        bending_stiffness=4e-5 * random.uniform(0.5, 2, len(garment.hinges)),
        thickness=4.7e-4 * random.uniform(0.5, 2, len(faces)),
    )
    position = start + np.array([0.003, 0.002, -0.001]) + noise(0.001, 3)
    return to_numpy(Case(garment, material, problem, position), dtype)


def pad_case(case: Case) -> Case:
    """Return the case with every array padded to a bucket; padded rows hold the last vertex's values."""
    garment = pad_garment(case.garment)
    rows = garment.vertex_mask.shape[0] - case.garment.vertex_mask.shape[0]

    def vertices(leaf):
        return np.concatenate([leaf, np.repeat(leaf[-1:], rows, axis=0)])

    problem = case.problem
    padded = problem.replace(
        position=vertices(problem.position),
        inertial_guess=vertices(problem.inertial_guess),
        contacts=jax.tree.map(vertices, problem.contacts),
        friction_load=np.pad(problem.friction_load, (0, rows)),
    )
    material = case.material

    def elements(leaf, count):
        return np.pad(leaf, (0, count - len(leaf)), mode="edge")

    material = Material(
        density=elements(material.density, len(garment.vertex_areas)),
        lame_mu=elements(material.lame_mu, len(garment.rest_areas)),
        lame_lambda=elements(material.lame_lambda, len(garment.rest_areas)),
        bending_stiffness=elements(material.bending_stiffness, len(garment.hinge_rest_areas)),
        thickness=elements(material.thickness, len(garment.rest_areas)),
    )
    return Case(to_device(garment), material, padded, vertices(case.position))
