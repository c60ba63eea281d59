"""The term Contact: nothing passes through anything, by the IPC Toolkit's count in every frame."""

import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment, make_sheet
from draped_ball import RADIUS, TIMESTEP, drifting_ball, square
from hard_cases.build import make_cloth, make_scene
from hard_cases.build import sheet as plain_sheet
from hard_cases.obstacles import needle

from eslr_jax import (
    SimConfig,
    load_body,
    load_garment,
    load_motion,
    pose_body,
    prepare_scene,
    rollout_scene,
    scene_terms,
    simulate,
)
from eslr_jax.pipeline.report.crossing import intersecting_pairs
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling
from eslr_jax.simulation.scene import start_integrator
from eslr_jax.terms import Contact, Damping, Friction
from eslr_jax.terms.stretch import principal_stretches


def assert_nothing_crosses(trajectory, scene, first=0):
    assert int(trajectory.status) == 0
    assert not trajectory.is_passed[first + 1 :].any()  # the first frame is where it starts
    obstacle = scene.body
    for frame, cloth in enumerate(np.asarray(trajectory.positions)[first:], first):
        body = () if obstacle is None else (obstacle.positions[frame], obstacle.surface.faces)
        assert len(intersecting_pairs(cloth, scene.garment.faces, *body)) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "integrator"), [(0.3, "euler"), (3.0, "bdf2")])
def test_a_ball_passes_through_no_sheet(speed, integrator):
    pytest.importorskip("ipctk")
    scene = prepare_scene(square(), drifting_ball(9, speed=speed), integrator=integrator)
    scene = with_velocity(scene, scene.initial_state.velocity.at[:, 1].set(-1.0))
    trajectory = rollout_scene(None, scene, SimConfig())
    assert_nothing_crosses(trajectory, scene)


def with_velocity(scene, velocity):
    """Return a scene whose cloth starts with a velocity [m/s]."""
    start = scene.initial_state
    velocity = jnp.asarray(np.broadcast_to(velocity, start.velocity.shape), jnp.float32)
    return scene.replace(initial_state=start.replace(velocity=velocity))


@pytest.mark.parametrize("depth", [0.012, 0.03])
def test_cloth_that_starts_inside_the_body_comes_out_of_it(depth):
    pytest.importorskip("ipctk")
    scene = prepare_scene(square(), drifting_ball(6), integrator="bdf2")
    inside = scene.initial_state.position.at[:, 1].set(RADIUS - depth)
    scene = scene.replace(initial_state=scene.initial_state.replace(position=inside))
    trajectory = simulate(None, scene).trajectory
    assert_nothing_crosses(trajectory, scene, first=1)
    assert trajectory.is_passed[1]
    assert float(principal_stretches(trajectory.positions[-1], scene.garment)[0].max()) < 1.2


@pytest.mark.slow
def test_a_sheet_that_a_needle_stops_follows_what_the_needle_holds():
    """It falls by 13 cm a frame on a tip between its vertices, where pushes alone stretch it to five times."""
    pytest.importorskip("ipctk")
    garment = make_cloth(plain_sheet(9, 9, (0.24, 0.24)), {})
    start = np.asarray(garment.rest_positions, np.float64) + np.array([0.003, 0.02, 0.004])
    scene = make_scene(garment, start, 6, body=needle()[0])
    scene = scene.replace(initial_state=start_integrator(scene.initial_state, "bdf2"))
    larger = tuple(term.replace(rows=4096) if isinstance(term, Contact) else term for term in scene.terms)
    scene = with_velocity(scene.replace(terms=larger), [0.0, -4.0, 0.0])
    trajectory = simulate(None, scene).trajectory
    assert_nothing_crosses(trajectory, scene)
    stretches = [float(principal_stretches(x, garment)[0].max()) for x in trajectory.positions]
    assert max(stretches) < 1.8


@pytest.mark.slow
def test_a_shirt_that_starts_folded_through_itself_walks_and_crosses_nothing(tshirt, walk):
    pytest.importorskip("ipctk")
    scene = prepare_scene(tshirt, walk, integrator="bdf2")
    trajectory = rollout_scene(None, scene, SimConfig())
    assert float(trajectory.gap_bounds.max()) <= 0.01
    assert_nothing_crosses(trajectory, scene)


@pytest.mark.slow
def test_a_pinned_sheet_folds_onto_itself_without_crossing():
    pytest.importorskip("ipctk")
    is_pinned = np.arange(64) < 8
    garment = square(is_pinned=is_pinned)
    scene = prepare_scene(garment, drifting_ball(9, speed=0.0, below=5.0))
    # The free end is thrown over the pinned one.
    rest = np.asarray(garment.rest_positions)
    thrown = np.zeros_like(rest)
    thrown[:, 1], thrown[:, 0] = 8.0 * (rest[:, 0] - rest[:, 0].min()), -3.0
    thrown[is_pinned] = 0.0
    trajectory = simulate(None, with_velocity(scene, thrown)).trajectory  # with tables that suffice
    assert_nothing_crosses(trajectory, scene)


@pytest.mark.slow
def test_what_passes_through_a_shirt_on_a_backflip_is_told():
    """Its thighs pass into its belly, with the cloth between. No frame may take minutes either."""
    pytest.importorskip("ipctk")
    body = load_body()
    poses = with_settling(pose_body(body, load_motion("deepmimic_backflip")), SETTLE_FRAMES, body)
    scene = prepare_scene(load_garment("tshirt", vertices="1k"), poses, integrator="bdf2")
    trajectory = simulate(None, scene).trajectory
    frames = zip(np.asarray(trajectory.positions), np.asarray(scene.body.positions), strict=True)
    is_crossed = [
        len(intersecting_pairs(cloth, scene.garment.faces, skin, scene.body.surface.faces)) > 0
        for cloth, skin in frames
    ]
    first = np.flatnonzero(is_crossed)[0]
    assert trajectory.is_passed[: first + 1].any()


def test_pins_give_way_to_a_body_that_comes_through_them_and_to_nothing_else():
    pytest.importorskip("ipctk")
    is_pinned = np.arange(64) % 8 < 4
    rise = 4e-3 * np.arange(9)[:, None, None] * np.array([0.0, 1.0, 0.0])  # [m], from 14 mm under the sheet
    still = drifting_ball(9, speed=0.0, below=0.01)
    poses = still.replace(positions=still.positions + rise.astype(np.float32))
    scene = prepare_scene(square(is_pinned=is_pinned), poses)
    trajectory = simulate(None, scene).trajectory
    assert_nothing_crosses(trajectory, scene)
    yielded = np.linalg.norm(trajectory.positions - scene.pin_targets, axis=2)[:, is_pinned].max(axis=1)
    assert yielded[:3].max() == 0
    assert 0.012 < yielded[-1] < 0.018


@pytest.mark.parametrize("coefficient", [0.1, 0.6])
def test_a_layer_slides_on_another_by_coulombs_law(coefficient):
    """Both lie on a slope of 25 degrees, whose tangent is .47. The lower one is pinned."""
    slope = np.radians(25.0)
    (lower, faces), (upper, more) = make_sheet(4, 13, jitter=0), make_sheet(2, 3, jitter=0)
    lower, upper = (points - points.mean(axis=0) for points in (lower, upper))
    turn = np.array([[np.cos(slope), np.sin(slope), 0], [-np.sin(slope), np.cos(slope), 0], [0, 0, 1]])
    garment = make_garment(
        np.concatenate([lower, upper + np.array([0.012, 1.9e-3, 0.007])]) @ turn.T,
        np.concatenate([faces, more + len(lower)]),
        is_pinned=np.arange(len(lower) + len(upper)) < len(lower),
    )
    poses = drifting_ball(6, speed=0.0, below=5.0)
    scene = prepare_scene(garment, poses, terms=scene_terms(Friction(coefficient=coefficient)))
    trajectory = simulate(None, scene).trajectory
    assert not trajectory.is_passed.any()
    upper = np.asarray(trajectory.positions)[:, len(lower) :]
    slid = ((upper - upper[0]) @ turn[:, 0]).mean(axis=1)
    pull = 9.81 * (np.sin(slope) - coefficient * np.cos(slope))
    if pull > 0:  # friction takes the force of the frame before, which the first one does not know
        np.testing.assert_allclose(np.diff(slid, 2)[1:] / TIMESTEP**2, pull, rtol=0.05)
    else:
        assert np.abs(slid).max() < 2e-3


def test_terms_of_one_kind_are_all_kept():
    assert scene_terms(Damping(0.1), Damping(0.2))[-2:] == (Damping(0.1), Damping(0.2))
