"""HOOD's losses against plain NumPy, quirk by quirk."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from physics_cases import make_garment, make_sheet, pad_case, to_numpy

from eslr_jax.physics.hood import (
    METRIC_PARAMETERS,
    BodyFrames,
    HoodParameters,
    collision_weight,
    hood_metrics,
    hood_terms,
    nearest_centroid,
)
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.potential import PotentialTerms

TERMS = PotentialTerms._fields[:6]
TIMESTEP = 1 / 30


def wavy_body(shift):
    """A coarse floor that the sheet bulges over, moved along x and z and lifted a little."""
    positions, faces = make_sheet(7, 8, 0.05, seed=5)
    positions = positions - np.array([0.04, -0.008, 0.04])
    positions[:, 1] += 0.005 * np.sin(20 * positions[:, 0])
    return positions + shift * np.array([1.0, 0.3, 0.7]), faces


@pytest.fixture(scope="module")
def frames(case64):
    """Cloth at t - 1, t, t + 1, and the body at the same times; float64."""
    start = case64.problem.position
    random = np.random.default_rng(11)
    previous = start - [0.004, 0.001, 0.002] + 1e-3 * random.standard_normal(start.shape)
    bodies = BodyFrames(*(wavy_body(shift)[0] for shift in (0.0, 0.006, 0.014)))
    return case64.position, start, previous, bodies, wavy_body(0)[1]


@partial(jax.jit, static_argnames="criterion")
def terms_and_gradients(position, current, previous, bodies, faces, garment, material, parameters, criterion):
    def stacked(position):
        terms = hood_terms(
            position,
            current,
            previous,
            bodies,
            faces,
            garment,
            material,
            TIMESTEP,
            parameters,
            criterion=criterion,
        )
        return jnp.stack([jnp.asarray(term, position.dtype) for term in terms[:6]])

    return stacked(position), jax.jacrev(stacked)(position)


def evaluate(frames, case, parameters, criterion):
    found = terms_and_gradients(*frames, case.garment, case.material, parameters, criterion)
    return tuple(np.asarray(part) for part in found)


def oracle(frames, case, parameters, criterion, position=None):
    at, current, previous, bodies, faces = frames
    position = at if position is None else position
    garment, material = case.garment, case.material
    rest, mass = (
        garment.rest_positions,
        reference.masses(garment.rest_positions, garment.faces, material.density),
    )
    query, search, body = {
        "postcvpr": (current, bodies.current, bodies.next),
        "cvpr": (current, bodies.previous, bodies.current),
        "metric": (position, bodies.next, bodies.next),
    }[criterion]
    before, after = (bodies.current, bodies.next) if criterion == "metric" else bodies[:2]
    return np.array(
        [
            reference.stretch(
                position,
                rest,
                garment.faces,
                material.lame_mu,
                material.lame_lambda,
                material.thickness,
            ),
            reference.bending(position, rest, garment.faces, material.bending_stiffness, current_length=True),
            reference.inertia(position, 2 * current - previous, mass, TIMESTEP),
            reference.gravity(position, 0.0, mass, parameters.gravity),
            reference.hood_collision(
                position,
                query,
                search,
                body,
                faces,
                parameters.collision_weight,
                parameters.collision_thickness,
            ),
            reference.hood_friction(
                position,
                current,
                before,
                after,
                faces,
                mass,
                parameters.friction_coefficient,
                parameters.gravity,
                parameters.friction_radius,
            ),
        ]
    )


CRITERIA = [("postcvpr", HoodParameters()), ("cvpr", HoodParameters()), ("metric", METRIC_PARAMETERS)]


@pytest.mark.parametrize(("criterion", "parameters"), CRITERIA, ids=lambda v: v if isinstance(v, str) else "")
def test_losses_match_the_oracle(frames, case64, criterion, parameters):
    expected = oracle(frames, case64, parameters, criterion)
    assert np.all(np.abs(expected) > 1e-10), "a term that vanishes is not tested"
    with jax.enable_x64(True):
        double, _ = evaluate(frames, case64, parameters, criterion)
    np.testing.assert_allclose(double, expected, rtol=1e-10)
    single, _ = evaluate(*to_numpy((frames, case64), np.float32), parameters, criterion)
    for name, found, value in zip(TERMS, single, expected, strict=True):
        # Depths of millimetres are differences of decimetres, and cubed.
        tolerance = {"collision": 3e-4, "friction": 1e-4}.get(name, 1e-5)
        np.testing.assert_allclose(found, value, rtol=tolerance, err_msg=name)


@pytest.mark.parametrize("criterion", ["postcvpr", "metric"])
def test_gradients_match_central_differences(frames, case64, criterion):
    parameters = HoodParameters()
    with jax.enable_x64(True):
        _, gradients = evaluate(frames, case64, parameters, criterion)
    step, count = 2e-7, len(frames[0])
    for vertex in range(0, count, 4):
        for axis in range(3):
            offset = np.zeros((count, 3))
            offset[vertex, axis] = step
            ahead, behind = (
                oracle(frames, case64, parameters, criterion, frames[0] + sign * offset) for sign in (1, -1)
            )
            numeric = (ahead - behind) / (2 * step)
            scale = np.abs(gradients).max(axis=(1, 2)) + 1e-12
            np.testing.assert_allclose(gradients[:, vertex, axis] / scale, numeric / scale, atol=1e-6)


def test_the_three_criteria_look_at_different_bodies(frames, case64):
    with jax.enable_x64(True):
        values = {name: evaluate(frames, case64, HoodParameters(), name)[0] for name, _ in CRITERIA}
    for one, other in (("postcvpr", "cvpr"), ("postcvpr", "metric")):
        np.testing.assert_array_equal(values[one][:4], values[other][:4])
        assert values[one][4] != values[other][4]
    assert values["postcvpr"][5] == values["cvpr"][5], "friction is a frame late in both"
    assert values["postcvpr"][5] != values["metric"][5]


def flat_case(height, moves=(0.0, 0.0, 0.0), is_pinned=None):
    """A flat sheet over a flat, still floor; it moved by `moves` in the last frame."""
    garment = to_numpy(make_garment(*make_sheet(4, 4, jitter=0), is_pinned=is_pinned))
    current = garment.rest_positions + np.array([0, height, 0])
    body, faces = make_sheet(9, 9, 0.03, jitter=0)
    body = body - np.array([0.045, 0, 0.045])
    return garment, current + np.array(moves), current, current, BodyFrames(body, body, body), faces


def friction_of(height, moves):
    garment, position, current, previous, bodies, faces = flat_case(height, moves)
    with jax.enable_x64(True):
        terms = hood_terms(
            position, current, previous, bodies, faces, garment, COTTON, TIMESTEP, HoodParameters()
        )
        return float(terms.friction), 0.5 * 9.81 * float(COTTON.density) * float(garment.vertex_areas.sum())


def test_friction_reaches_to_five_centimetres_and_a_half():
    """The radius of 3 mm is compared with squared distances."""
    near, _ = friction_of(0.04, (0.001, 0.0, 0.0))
    far, _ = friction_of(0.06, (0.001, 0.0, 0.0))
    assert near > 0
    assert far == 0


def test_friction_hardly_acts_along_z():
    """Its floor is the xy plane: sliding along x costs mu m g, along z a hundredth of it."""
    along_x, limit = friction_of(0.001, (0.002, 0.0, 0.0))
    along_z, _ = friction_of(0.001, (0.0, 0.0, 0.002))
    np.testing.assert_allclose(along_x, limit * 0.002 * np.sqrt(1 + 1e-4), rtol=1e-9)
    np.testing.assert_allclose(along_z, limit * 0.002 * np.sqrt(1e-4), rtol=1e-9)


def test_gravity_counts_from_the_worlds_origin():
    garment, position, current, previous, bodies, faces = flat_case(2.0)
    with jax.enable_x64(True):
        terms = hood_terms(
            position, current, previous, bodies, faces, garment, COTTON, TIMESTEP, HoodParameters()
        )
    weight = 9.81 * float(COTTON.density) * garment.vertex_areas.sum()
    np.testing.assert_allclose(terms.gravity, 2.0 * weight, rtol=1e-9)


def test_pins_add_a_constant_to_the_training_inertia_only():
    is_pinned = np.arange(16) < 4
    garment, position, current, previous, bodies, faces = flat_case(0.1, (0.01, 0.0, 0.0), is_pinned)
    arguments = (current, previous, bodies, faces, garment, COTTON, TIMESTEP, HoodParameters())

    def inertia(position, criterion):
        return hood_terms(position, *arguments, criterion=criterion).inertia

    with jax.enable_x64(True):
        gradient = {name: np.asarray(jax.grad(inertia)(position, name)) for name in ("postcvpr", "metric")}
        values = {name: float(inertia(position, name)) for name in ("postcvpr", "metric")}
    assert not np.any(gradient["postcvpr"][is_pinned])
    assert np.all(gradient["metric"][is_pinned, 0] > 0)
    # A pin's state is (target, current), so that it seems to fly on by its last motion: the same distance.
    np.testing.assert_allclose(values["postcvpr"], values["metric"], rtol=1e-9)


def test_bending_feels_the_current_length(frames, case64):
    """A sheet that is scaled keeps its angles; its bending grows with the square of the edges."""
    position, *rest = frames
    with jax.enable_x64(True):
        values, _ = evaluate(frames, case64, HoodParameters(), "postcvpr")
        scaled, _ = evaluate((1.1 * position, *rest), case64, HoodParameters(), "postcvpr")
    np.testing.assert_allclose(scaled[1], 1.21 * values[1], rtol=1e-9)


def test_collision_weight_ramps_from_50k_to_150k():
    expected = {0: 5e3, 50_000: 5e3, 60_000: 5.45e4, 100_000: 2.525e5, 150_000: 5e5, 400_000: 5e5}
    for iteration, weight in expected.items():
        np.testing.assert_allclose(collision_weight(iteration), weight, rtol=1e-5)


def test_nearest_centroid_matches_brute_force():
    random = np.random.default_rng(0)
    query, centers = (random.standard_normal((n, 3)).astype(np.float32) for n in (200, 77))
    index, squared = nearest_centroid(query, centers)
    expected, expected_squared = reference.nearest(query.astype(float), centers.astype(float))
    np.testing.assert_array_equal(index, expected)
    np.testing.assert_allclose(squared, expected_squared, rtol=1e-5)


def test_losses_are_finite_where_nothing_moves_and_without_a_body(frames, case32):
    garment, material = case32.garment, case32.material
    still = case32.problem.position
    body, faces = frames[3].current.astype(np.float32), frames[4]
    values, gradients = evaluate(
        (still, still, still, BodyFrames(body, body, body), faces), case32, HoodParameters(), "postcvpr"
    )
    assert np.all(np.isfinite(values))
    assert np.all(np.isfinite(gradients))
    assert values[5] == 0
    alone = hood_terms(still, still, still, None, None, garment, material, TIMESTEP, HoodParameters())
    assert alone.collision == alone.friction == 0.0


def test_padding_changes_nothing(frames, case32):
    small = to_numpy(frames, np.float32)
    values, gradients = evaluate(small, case32, HoodParameters(), "postcvpr")
    padded = pad_case(case32)
    rows, count = padded.position.shape[0] - len(small[0]), len(small[0])
    grown = [np.concatenate([x, np.repeat(x[-1:], rows, axis=0)]) for x in small[:3]]
    found, padded_gradients = evaluate((*grown, *small[3:]), padded, HoodParameters(), "postcvpr")
    np.testing.assert_allclose(found, values, rtol=3e-7)
    np.testing.assert_array_equal(padded_gradients[:, :count], gradients)
    assert not np.any(padded_gradients[:, count:])


def test_metrics_of_a_trajectory_are_those_of_its_frames(frames, case32):
    position, current, previous, bodies, faces = to_numpy(frames, np.float32)
    positions = np.stack([previous, current, position, position + np.float32(0.001)])
    body_positions = np.stack([*bodies, bodies.next])
    metrics = hood_metrics(positions, body_positions, faces, case32.garment, case32.material, TIMESTEP)
    assert all(np.shape(term) == (2,) for term in metrics.terms[:6])
    for k in range(2):
        step = (positions[k + 2], positions[k + 1], positions[k])
        around = BodyFrames(*body_positions[k : k + 3])
        values, gradients = evaluate((*step, around, faces), case32, METRIC_PARAMETERS, "metric")
        np.testing.assert_allclose([term[k] for term in metrics.terms[:6]], values, rtol=1e-5)
        norm = np.linalg.norm(gradients.sum(axis=0), axis=1).mean()
        np.testing.assert_allclose(metrics.gradient_norm[k], norm, rtol=1e-4)
    assert np.all((metrics.penetrating_share > 0) & (metrics.penetrating_share < 1))
