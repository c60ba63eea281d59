"""The comparison with Newton: what is computed without it, and, where it is installed, what it does."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hard_cases import CASES, drop_scene, run_case
from hard_cases.build import corners_of, hanging_sheet, make_cloth, make_scene, sheet
from newton_cloth import (
    NewtonCloth,
    Setting,
    bending_cotangents,
    contact_stiffness,
    newton_simulator,
    prepare_cloth,
    springs,
    stable_substeps,
    strip_stiffness,
)
from peers import Method, our_method, teach

from eslr_jax import SimConfig, rollout_scene
from eslr_jax.fabric.materials import COTTON
from eslr_jax.terms import Collision
from eslr_jax.terms.bending import bending_energy
from eslr_jax.terms.collision import contact_forces
from eslr_jax.terms.term import contact_thickness
from eslr_jax.types import Contacts

SOLVERS = [Setting("vbd", 2, 10), Setting("style3d", 2, 10), Setting("xpbd", None, 1)]


@pytest.fixture(scope="module")
def cloth():
    return prepare_cloth(make_cloth(sheet(5, 5, (0.2, 0.2)), {}), COTTON)


def fold(positions, angle):
    """Turn what lies beyond x = 0 about the y axis."""
    turned = np.stack(
        [positions[:, 0] * np.cos(angle), positions[:, 1], positions[:, 0] * np.sin(angle)], axis=1
    )
    return np.where(positions[:, :1] > 0, turned, positions)


def test_padding_and_pins_carry_no_mass():
    mesh = hanging_sheet(5, 5, (0.2, 0.2))
    is_pinned = corners_of(mesh[0], (-1, 1), (1, 1), axes=(0, 1))
    free, pinned = (make_cloth(mesh, {}, is_pinned=pins) for pins in (None, is_pinned))
    assert prepare_cloth(free, COTTON).masses.sum() == pytest.approx(0.04 * float(COTTON.density), rel=1e-5)
    assert set(np.flatnonzero(prepare_cloth(pinned, COTTON).masses == 0)) == set(np.flatnonzero(is_pinned))
    assert len(prepare_cloth(free, COTTON).rest) == 25
    assert prepare_cloth(free, COTTON).faces.max() == 24


def test_fabric_by_face_reaches_every_face():
    garment = make_cloth(sheet(5, 5, (0.2, 0.2)), {})
    mu = np.linspace(1e4, 2e4, garment.faces.shape[0]).astype(np.float32)
    shear = prepare_cloth(garment, COTTON.replace(lame_mu=jnp.asarray(mu))).shear
    is_face = np.asarray(garment.rest_areas) > 0
    np.testing.assert_allclose(shear, mu[is_face] * float(COTTON.thickness), rtol=1e-6)


def test_springs_hold_the_energy_of_a_sheet(cloth):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0]])
    triangle = dataclasses.replace(
        cloth,
        rest=corners,
        faces=np.array([[0, 1, 2]]),
        areas=np.array([np.sqrt(3) / 4]),
        shear=cloth.shear[:1],
        area_stiffness=cloth.area_stiffness[:1],
    )
    edges, stiffness = springs(triangle)
    strain = 1e-4
    moved = corners * [1 + strain, 1, 1]
    length, rest = (np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1) for x in (moved, corners))
    energy = 0.5 * np.sum(stiffness * (length - rest) ** 2)
    modulus = strip_stiffness(triangle.shear, triangle.area_stiffness)[0]
    # Held across the pull, a sheet of Poisson's ratio 1/3 has E / (1 - 1/9).
    assert energy == pytest.approx(0.5 * modulus / (1 - 1 / 9) * strain**2 * triangle.areas[0], rel=1e-3)


@pytest.mark.numerics
def test_quadratic_bending_is_ours_at_small_angles():
    rest = np.array([[0, 0, 0], [0, 0.03, 0], [-0.02, 0.01, 0], [0.03, 0.02, 0]])
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    garment = make_cloth((rest, faces), {})
    cloth = prepare_cloth(garment, COTTON)
    folded = fold(rest, 1e-2)
    # The weights of Style3D's bend kernel, from its order of the cotangents.
    at_start, at_end = (bending_cotangents(cloth)[:, columns] for columns in ([0, 1], [2, 3]))
    weights = np.stack([at_end.sum(1), at_start.sum(1), *(-(at_start + at_end).T)], axis=1)
    bend = np.einsum("hi,hix->hx", weights, folded[cloth.hinges])
    stiffness = cloth.bending_stiffness / 12 * 3 / cloth.hinge_areas
    energy = 0.5 * np.sum(stiffness * np.sum(bend**2, axis=1))
    padded = jnp.asarray(np.resize(folded, garment.rest_positions.shape), jnp.float32)
    padded = padded.at[: len(folded)].set(folded.astype(np.float32))
    assert energy == pytest.approx(float(bending_energy(padded, garment, COTTON)), rel=2e-3)


def test_xpbd_needs_more_substeps_on_finer_cloth():
    counts = [
        stable_substeps(prepare_cloth(make_cloth(sheet(n, n, (1, 1)), {}), COTTON), 1 / 30) for n in (9, 17)
    ]
    assert counts[1] / counts[0] == pytest.approx(2, rel=0.1)


def test_contact_spring_pushes_as_our_cubic_does_through_the_whole_distance():
    scene = drop_scene({}, columns=9, seconds=0.1).scene
    radius = float(contact_thickness(scene.garment, scene.term(Collision).thickness))
    inside = jnp.zeros_like(scene.initial_state.position)
    up = jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), inside.shape)
    near = jnp.ones(len(inside), bool)
    contacts = Contacts(
        inside, inside, up, up, jnp.zeros(len(inside)), near, jnp.zeros(len(inside), jnp.int32)
    )
    forces = contact_forces(inside, contacts, scene.garment, scene.term(Collision).stiffness, radius)
    count = np.sum(np.asarray(scene.garment.vertex_mask))
    assert contact_stiffness(scene) * radius == pytest.approx(float(forces.sum()) / count, rel=1e-4)


@pytest.mark.slow
def test_our_method_steps_as_a_rollout_does():
    scene = drop_scene({}, columns=5, seconds=0.3).scene
    method, state = our_method(scene, 2, 10), scene.initial_state
    for frame in range(scene.num_frames - 1):
        state = method.step(state, frame)
    whole = rollout_scene(None, scene.replace(substeps=2), SimConfig(iterations=10))
    np.testing.assert_allclose(state.position, whole.positions[-1], atol=1e-5)


def newton_cloth(scene, setting):
    pytest.importorskip("newton")
    return NewtonCloth(scene, setting)


def roll(method, scene):
    states = [scene.initial_state]
    for frame in range(scene.num_frames - 1):
        states.append(method(states[-1], frame))
    return states


@pytest.mark.slow
@pytest.mark.parametrize("setting", SOLVERS, ids=lambda setting: setting.solver)
def test_newton_falls_freely(setting):
    garment = make_cloth(sheet(5, 5, (0.2, 0.2)), {})
    scene = make_scene(garment, np.asarray(garment.rest_positions), 11)
    method = newton_cloth(scene, setting)
    end = roll(method, scene)[-1]
    steps, dt = 10 * method.substeps, float(scene.timestep) / method.substeps
    fall = 9.81 * dt * dt * steps * (steps + 1) / 2
    moved = np.asarray(end.position - scene.initial_state.position)[np.asarray(garment.vertex_mask)]
    # Style3D takes 0.2 % off the velocity in every substep.
    np.testing.assert_allclose(-moved[:, 1], fall, rtol=0.03 if setting.solver == "style3d" else 1e-3)
    np.testing.assert_allclose(moved[:, [0, 2]], 0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("setting", SOLVERS, ids=lambda setting: setting.solver)
def test_newton_drapes_a_sheet_over_a_moving_ball(setting):
    scene = drop_scene({}, columns=17, seconds=0.8).scene
    end = roll(newton_cloth(scene, setting), scene)[-1]
    position = np.asarray(end.position)[np.asarray(scene.garment.vertex_mask)]
    ball = np.asarray(scene.body.positions)[-1].mean(axis=0)
    assert np.linalg.norm(position - ball, axis=1).min() > 0.245
    assert position[:, 1].max() < 0.27
    assert position[:, 1].min() > -0.6


@pytest.mark.slow
@pytest.mark.parametrize("setting", SOLVERS, ids=lambda setting: setting.solver)
def test_newton_hangs_cloth_by_its_pins(setting):
    mesh = hanging_sheet(9, 9, (0.4, 0.4))
    is_pinned = corners_of(mesh[0], (-1, 1), (1, 1), axes=(0, 1))
    garment = make_cloth(mesh, {}, is_pinned=is_pinned)
    scene = make_scene(garment, mesh[0], 31)
    end = np.asarray(roll(newton_cloth(scene, setting), scene)[-1].position)[: len(mesh[0])]
    np.testing.assert_allclose(end[is_pinned], mesh[0][is_pinned], atol=1e-6)
    ours = rollout_scene(None, scene, SimConfig(iterations=500))
    sag = [x[:, 1].min() for x in (end, np.asarray(ours.positions[-1])[: len(mesh[0])])]
    assert sag[0] == pytest.approx(sag[1], abs=0.05)  # VBD is far from converged


@pytest.mark.slow
def test_vbd_minimises_our_potential_where_strains_are_small(tshirt):
    rest = np.asarray(tshirt.rest_positions)
    noise = 1e-4 * np.random.default_rng(0).normal(size=rest.shape)
    scene = make_scene(tshirt, rest + noise, 4, timestep=1 / 300)
    method = Method("VBD", 1, 200, newton_cloth(scene, Setting("vbd", 1, 200)))
    truth = rollout_scene(None, scene, SimConfig(iterations=500))
    gap, initial = teach([method], scene, truth, every=1)
    assert (gap[0] / initial).max() < 1e-3


@pytest.mark.slow
def test_newton_runs_the_hard_cases():
    pytest.importorskip("newton")
    outcome = run_case(CASES["free_fall"], newton_simulator(Setting("vbd", 2, 10)))
    assert [measure.name.split(",")[0] for measure in outcome.measures[1:]] == [
        "displacement beyond free fall",
        "fall of the centre against backward Euler [%]",
    ]
    # Two substeps fall by less than one: by (2 n + 1) / (2 n + 2) of it after n frames.
    assert outcome.measures[2].value == pytest.approx(100 / 62, rel=0.05)
