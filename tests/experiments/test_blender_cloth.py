"""The experiments' adapter to Blender: what its numbers mean, where BLENDER_PYTHON names a Python with `bpy`."""

import jax.numpy as jnp
import numpy as np
import pytest
from blender_cloth import blender_python, blender_simulator, run_blender
from hard_cases import CASES, drop_scene, run_case
from hard_cases.build import hanging_sheet, make_cloth, make_scene, sheet
from newton_cloth import prepare_cloth, strip_stiffness

from eslr_jax import EslrError
from eslr_jax.fabric.materials import COTTON

EFFORT = (10, 2)
needs_blender = pytest.mark.skipif(blender_python() is None, reason="BLENDER_PYTHON names no Python with bpy")


def pinned_scene(num_frames, *, deform=1.0):
    """Return a sheet that hangs by its upper edge, and the rows of that edge."""
    mesh = hanging_sheet(9, 9, (0.4, 0.4))
    is_pinned = np.isclose(mesh[0][:, 1], 0.0)
    garment = make_cloth(mesh, {}, is_pinned=is_pinned)
    return make_scene(garment, deform * mesh[0], num_frames), mesh[0], is_pinned


def test_what_blender_cannot_start_from_is_refused():
    with pytest.raises(EslrError, match="deformed"):
        run_blender(pinned_scene(3, deform=1.1)[0], EFFORT)
    garment = make_cloth(sheet(5, 5, (0.2, 0.2)), {})
    rest = np.asarray(garment.rest_positions)
    scene = make_scene(garment, rest, 3)
    scene = scene.replace(initial_state=scene.initial_state.replace(velocity=jnp.ones(rest.shape)))
    with pytest.raises(EslrError, match="without velocity"):
        run_blender(scene, EFFORT)


@pytest.mark.slow
@needs_blender
def test_blender_falls_freely_at_our_frame_rate():
    garment = make_cloth(sheet(5, 5, (0.2, 0.2)), {})
    scene = make_scene(garment, np.asarray(garment.rest_positions), 11)
    moved = np.diff(run_blender(scene, EFFORT).positions[[0, -1], :25], axis=0)[0]
    steps, dt = 10 * EFFORT[0], float(scene.timestep) / EFFORT[0]
    np.testing.assert_allclose(-moved[:, 1], 9.81 * dt * dt * steps * (steps + 1) / 2, rtol=1e-3)


@pytest.mark.slow
@needs_blender
def test_a_hanging_sheet_stretches_in_blender_as_its_fabric_says():
    scene, rest, is_pinned = pinned_scene(200)
    end = run_blender(scene, EFFORT).positions[-50:, : len(rest)].mean(axis=0)
    np.testing.assert_allclose(end[is_pinned], rest[is_pinned], atol=1e-5)
    cloth = prepare_cloth(scene.garment, COTTON)
    lowest = np.isclose(rest[:, 1], -0.4)
    drop = float((rest - end)[lowest, 1].mean())
    expected = float(COTTON.density) * 9.81 * 0.4**2 / 2
    expected /= strip_stiffness(cloth.shear, cloth.area_stiffness).mean()
    # A grid with diagonals is 1.16 times as stiff as a lattice of equilateral triangles, its borders more.
    assert drop == pytest.approx(expected, rel=0.25)


@pytest.mark.slow
@needs_blender
def test_blender_starts_deformed_and_returns_to_the_rest_shape():
    garment = make_cloth(sheet(9, 9, (0.4, 0.4)), {})
    rest = np.asarray(garment.rest_positions)
    positions = run_blender(make_scene(garment, 1.2 * rest, 60), EFFORT).positions[:, :81]
    np.testing.assert_allclose(positions[0], 1.2 * rest[:81], atol=1e-5)
    sizes = np.ptp(positions[-20:], axis=1)[:, [0, 2]]
    np.testing.assert_allclose(sizes.mean(axis=0), 0.4, rtol=0.03)


@pytest.mark.slow
@needs_blender
def test_blender_drapes_a_sheet_over_a_moving_ball():
    scene = drop_scene({}, columns=17, seconds=0.8).scene
    count = int(np.sum(np.asarray(scene.garment.vertex_mask)))
    position = run_blender(scene, EFFORT).positions[-1, :count]
    ball = np.asarray(scene.body.positions)[-1].mean(axis=0)
    assert np.linalg.norm(position - ball, axis=1).min() > 0.245
    assert position[:, 1].max() < 0.27
    assert position[:, 1].min() > -0.6


@pytest.mark.slow
@needs_blender
def test_blender_runs_the_hard_cases():
    outcome = run_case(CASES["drop_on_ball"], blender_simulator(EFFORT))
    assert len(outcome.measures) == 5  # a scene that Blender refuses leaves two
    assert outcome.measures[3].name == "depth in the ball, 99.9 % [mm]"
    assert outcome.measures[3].is_passed
