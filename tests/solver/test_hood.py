"""HOOD's losses against plain NumPy, quirk by quirk."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from cloth import make_garment, make_sheet
from physics_cases import TIMESTEP, pad_case, to_numpy

from eslr_jax.fabric.materials import COTTON
from eslr_jax.terms.hood import (
    METRIC_PARAMETERS,
    BodyFrames,
    HoodParameters,
    HoodProblem,
    collision_weight,
    criterion_depths,
    hood_terms,
    nearest_centroid,
)

TERMS = ("stretch", "bending", "inertia", "gravity", "collision", "friction")


def wavy_body(shift):
    """A coarse floor that the sheet bulges over, moved along x and z and lifted a little."""
    positions, faces = make_sheet(7, 8, 0.05, seed=5)
    positions = positions - np.array([0.04, -0.008, 0.04])
    positions[:, 1] += 0.005 * np.sin(20 * positions[:, 0])
    return positions + shift * np.array([1.0, 0.3, 0.7]), faces


@pytest.fixture(scope="module")
def step(case64):
    """Cloth at t + 1, and HOOD's problem with cloth and body at t - 1 and t; float64."""
    start = case64.problem.position
    random = np.random.default_rng(11)
    previous = start - [0.004, 0.001, 0.002] + 1e-3 * random.standard_normal(start.shape)
    bodies = (wavy_body(shift)[0] for shift in (0.0, 0.006, 0.014))
    problem = HoodProblem(
        current=start,
        previous=previous,
        bodies=BodyFrames(*bodies, wavy_body(0)[1]),
        garment=case64.problem.garment,
        material=case64.problem.material,
        timestep=np.float64(TIMESTEP),
        parameters=to_numpy(HoodParameters()),
    )
    return case64.position, problem


@partial(jax.jit, static_argnames="criterion")
def terms_and_gradients(position, problem, criterion):
    def stacked(position):
        losses = hood_terms(position, problem, criterion=criterion)
        return jnp.stack([losses[name] for name in TERMS])

    return stacked(position), jax.jacrev(stacked)(position)


def evaluate(step, criterion):
    return tuple(np.asarray(part) for part in terms_and_gradients(*step, criterion))


def oracle(step, criterion, position=None):
    at, problem = step
    position = at if position is None else position
    garment, material, bodies, own = problem.garment, problem.material, problem.bodies, problem.parameters
    rest, faces, current = garment.rest_positions, garment.faces, problem.current
    mass = reference.masses(rest, faces, material.density)
    fabric = (material.lame_mu, material.lame_lambda, material.thickness)
    searched = {
        "postcvpr": (current, bodies.current, bodies.next),
        "cvpr": (current, bodies.previous, bodies.current),
        "metric": (position, bodies.next, bodies.next),
    }[criterion]
    rubbed = (bodies.current, bodies.next) if criterion == "metric" else (bodies.previous, bodies.current)
    pressing = (own.collision_weight, own.collision_thickness)
    rubbing = (own.friction_coefficient, own.gravity, own.friction_radius)
    return np.array(
        [
            reference.stretch(position, rest, faces, *fabric),
            reference.bending(position, rest, faces, material.bending_stiffness, current_length=True),
            reference.inertia(position, 2 * current - problem.previous, mass, TIMESTEP),
            reference.gravity(position, 0.0, mass, own.gravity),
            reference.hood_collision(position, *searched, bodies.faces, *pressing),
            reference.hood_friction(position, current, *rubbed, bodies.faces, mass, *rubbing),
        ]
    )


CRITERIA = [("postcvpr", HoodParameters()), ("cvpr", HoodParameters()), ("metric", METRIC_PARAMETERS)]


@pytest.mark.parametrize(("criterion", "parameters"), CRITERIA, ids=lambda v: v if isinstance(v, str) else "")
def test_losses_match_the_oracle(step, criterion, parameters):
    position, problem = step
    step = position, problem.replace(parameters=to_numpy(parameters))
    expected = oracle(step, criterion)
    assert np.all(np.abs(expected) > 1e-10), "a term that vanishes is not tested"
    with jax.enable_x64(True):
        double, _ = evaluate(step, criterion)
    np.testing.assert_allclose(double, expected, rtol=1e-10)


def test_losses_match_the_oracle_in_float32(step):
    """Criteria differ in the frames that they read, and not in what is computed of them."""
    single, _ = evaluate(to_numpy(step, np.float32), "postcvpr")
    for name, found, value in zip(TERMS, single, oracle(step, "postcvpr"), strict=True):
        # Depths of millimetres are differences of decimetres, and cubed.
        tolerance = {"collision": 3e-4, "friction": 1e-4}.get(name, 1e-5)
        np.testing.assert_allclose(found, value, rtol=tolerance, err_msg=name)


@pytest.mark.parametrize("criterion", ["postcvpr", "metric"])
def test_gradients_match_central_differences(step, criterion):
    with jax.enable_x64(True):
        _, gradients = evaluate(step, criterion)
    width, position = 2e-7, step[0]
    for vertex in range(0, len(position), 4):
        for axis in range(3):
            offset = np.zeros_like(position)
            offset[vertex, axis] = width
            ahead, behind = (oracle(step, criterion, position + sign * offset) for sign in (1, -1))
            numeric = (ahead - behind) / (2 * width)
            scale = np.abs(gradients).max(axis=(1, 2)) + 1e-12
            np.testing.assert_allclose(gradients[:, vertex, axis] / scale, numeric / scale, atol=1e-6)


def test_the_three_criteria_look_at_different_bodies(step):
    with jax.enable_x64(True):
        values = {name: evaluate(step, name)[0] for name, _ in CRITERIA}
    for one, other in (("postcvpr", "cvpr"), ("postcvpr", "metric")):
        np.testing.assert_allclose(values[one][:4], values[other][:4], rtol=1e-12)  # each is compiled anew
        assert values[one][4] != values[other][4]
    late = {name: value[5] for name, value in values.items()}  # friction, a frame late in two of them
    assert late["postcvpr"] == pytest.approx(late["cvpr"], rel=1e-12)
    assert late["postcvpr"] != pytest.approx(late["metric"], rel=1e-6)


@pytest.fixture(scope="module")
def flat_step(step):
    """Flat sheets over a flat, still floor, which moved in the last frame, of as many vertices as `step`."""

    def make(height, move=(0.0, 0.0, 0.0), is_pinned=None):
        garment = to_numpy(make_garment(*make_sheet(spacing=0.03, jitter=0), is_pinned=is_pinned))
        current = garment.rest_positions + np.array([0, height, 0])
        floor, faces = make_sheet(7, 8, 0.03, jitter=0)
        floor = floor - np.array([0.03, 0, 0.03])
        return current + np.array(move), step[1].replace(
            current=current,
            previous=current,
            bodies=BodyFrames(floor, floor, floor, faces),
            garment=garment,
            material=jax.tree.map(np.full_like, step[1].material, COTTON),
        )

    return make


def weight_of(problem):
    return 9.81 * float(COTTON.density) * float(problem.garment.vertex_areas.sum())


def losses(step, criterion="postcvpr"):
    with jax.enable_x64(True):
        return dict(zip(TERMS, evaluate(step, criterion)[0], strict=True))


def test_friction_reaches_to_five_centimetres_and_a_half(flat_step):
    """The radius of 3 mm is compared with squared distances."""
    near, far = (losses(flat_step(height, (0.001, 0.0, 0.0)))["friction"] for height in (0.04, 0.06))
    np.testing.assert_allclose(
        near, 0.5 * weight_of(flat_step(0.04)[1]) * 0.001 * np.sqrt(1 + 1e-4), rtol=1e-9
    )
    assert far == 0


def test_friction_hardly_acts_along_z(flat_step):
    """Its floor is the xy plane: sliding along x costs mu m g, along z a hundredth of it."""
    along_x, along_z = (flat_step(0.001, move) for move in ((0.002, 0.0, 0.0), (0.0, 0.0, 0.002)))
    limit = 0.5 * weight_of(along_x[1])
    np.testing.assert_allclose(losses(along_x)["friction"], limit * 0.002 * np.sqrt(1 + 1e-4), rtol=1e-9)
    np.testing.assert_allclose(losses(along_z)["friction"], limit * 0.002 * np.sqrt(1e-4), rtol=1e-9)


def test_gravity_counts_from_the_worlds_origin(flat_step):
    step = flat_step(2.0)
    np.testing.assert_allclose(losses(step)["gravity"], 2.0 * weight_of(step[1]), rtol=1e-9)


def test_pins_add_a_constant_to_the_training_inertia_only(flat_step):
    is_pinned = np.arange(30) < 6
    step = flat_step(0.1, (0.01, 0.0, 0.0), is_pinned)
    with jax.enable_x64(True):
        found = {name: evaluate(step, name) for name in ("postcvpr", "metric")}
    inertia = {name: (values[2], gradients[2]) for name, (values, gradients) in found.items()}
    assert not np.any(inertia["postcvpr"][1][is_pinned])
    assert np.all(inertia["metric"][1][is_pinned, 0] > 0)
    # A pin's state is (target, current), so that it seems to fly on by its last motion: the same distance.
    np.testing.assert_allclose(inertia["postcvpr"][0], inertia["metric"][0], rtol=1e-9)


def test_bending_feels_the_current_length(step):
    """A sheet that is scaled keeps its angles; its bending grows with the square of the edges."""
    position, problem = step
    with jax.enable_x64(True):
        values, scaled = (evaluate((factor * position, problem), "postcvpr")[0] for factor in (1.0, 1.1))
    np.testing.assert_allclose(scaled[1], 1.21 * values[1], rtol=1e-9)


def test_collision_weight_ramps_from_50k_to_150k():
    expected = {0: 5e3, 50_000: 5e3, 60_000: 5.45e4, 100_000: 2.525e5, 150_000: 5e5, 400_000: 5e5}
    for iteration, weight in expected.items():
        np.testing.assert_allclose(collision_weight(iteration), weight, rtol=1e-5)


def test_nearest_centroid_matches_brute_force():
    random = np.random.default_rng(0)
    query, centers = (jnp.float32(random.standard_normal((n, 3))) for n in (200, 77))
    index, squared = nearest_centroid(query, centers)
    expected, expected_squared = reference.nearest(*(np.asarray(x, np.float64) for x in (query, centers)))
    np.testing.assert_array_equal(index, expected)
    np.testing.assert_allclose(squared, expected_squared, rtol=1e-5)


def test_losses_are_finite_where_nothing_moves_and_without_a_body(step):
    _, problem = to_numpy(step, np.float32)
    still, current = problem.current, problem.bodies.current
    bodies = problem.bodies.replace(previous=current, next=current)
    values, gradients = evaluate((still, problem.replace(previous=still, bodies=bodies)), "postcvpr")
    assert np.all(np.isfinite(values))
    assert np.all(np.isfinite(gradients))
    assert values[5] == 0
    alone, _ = evaluate((still, problem.replace(previous=still, bodies=None)), "postcvpr")
    np.testing.assert_array_equal(alone[4:], 0.0)
    np.testing.assert_allclose(alone[:4], values[:4], rtol=1e-6)


def test_depths_are_those_of_the_collision_loss(step):
    position, problem = step
    with jax.enable_x64(True):
        depths = jax.jit(partial(criterion_depths, criterion="metric"))(position, problem)
        values, _ = evaluate(step, "metric")
    np.testing.assert_allclose(5e3 * np.sum(np.asarray(depths) ** 3), values[4], rtol=1e-12)


def test_padding_changes_nothing(step, case32):
    position, problem = to_numpy(step, np.float32)
    values, gradients = evaluate((position, problem), "postcvpr")
    padded = pad_case(case32).problem
    count, rows = len(position), len(padded.position) - len(position)
    grow = partial(np.pad, pad_width=[(0, rows), (0, 0)], mode="edge")
    grown = problem.replace(
        current=grow(problem.current),
        previous=grow(problem.previous),
        garment=padded.garment,
        material=padded.material,
    )
    found, padded_gradients = evaluate((grow(position), grown), "postcvpr")
    np.testing.assert_allclose(found, values, rtol=5e-7)
    np.testing.assert_allclose(padded_gradients[:, :count], gradients, rtol=2e-6, atol=1e-7)
    assert not np.any(padded_gradients[:, count:])
