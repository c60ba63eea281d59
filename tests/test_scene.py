"""What a scene leaves out must be what it does not need."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment
from draped_ball import ball, drifting_ball, square

from eslr_jax import (
    ConfigError,
    MeshError,
    SimConfig,
    load_body,
    load_garment,
    load_motion,
    plan_scene,
    pose_body,
    prepare_scene,
    prepare_scenes,
    rollout_scene,
)
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.fabric.materials import COTTON, fabric_material
from eslr_jax.mesh.closest import closest_points
from eslr_jax.simulation.frame import first_problem, frame_inputs
from eslr_jax.simulation.plan import first_frames
from eslr_jax.simulation.scene import build_scene
from eslr_jax.solver.potential import evaluate
from eslr_jax.terms import CLOTH, Collision, Contact, Gravity
from eslr_jax.terms.stretch import contact_excess
from eslr_jax.terms.worn import REACH

of_first_frame, pressed = jax.jit(first_problem), jax.jit(evaluate)


def without_pairs(scene):
    """Return the terms of a scene but for contact of pairs, which takes long to compile."""
    return tuple(term for term in scene.terms if not isinstance(term, Contact))


def test_frame_zero_is_clear_of_the_body(small_scene):
    body = small_scene.body
    found = jax.jit(find_contacts)(
        small_scene.initial_state.position, body.positions[0], body.positions[0], body.surface
    )
    assert float(found.distances.min()) > 0


def test_what_is_not_asked_for_is_absent(small_garment, small_poses, small_scene):
    scene = small_scene
    assert scene.pin_targets is None
    assert not scene.term(Contact).has_layers
    options = {"terms": (*CLOTH, Gravity(1.62)), "starts_at_rest": True}
    other = prepare_scene(small_garment, small_poses, **options)
    assert other.body is None
    assert other.term(Contact) is None
    np.testing.assert_array_equal(other.initial_state.velocity, 0.0)
    np.testing.assert_allclose(
        scene.initial_state.velocity * scene.timestep,
        # the limb is rigid: it carries the sleeve as it carries its nearest vertex, but for the turn
        np.broadcast_to(
            np.asarray(small_poses.positions[1] - small_poses.positions[0]).mean(axis=0), (60, 3)
        ),
        atol=0.01,
    )


def test_a_garment_that_hangs_on_joints_of_another_body_is_refused(small_garment, small_poses):
    joints = small_poses.joint_transforms.shape[1]
    stranger = small_garment.replace(skin_indices=small_garment.skin_indices.at[7].set(joints))
    with pytest.raises(MeshError, match=f"was fitted to another body: it hangs on joint {joints}"):
        prepare_scene(stranger, small_poses)


def test_a_misspelt_option_is_refused(small_garment, small_poses):
    with pytest.raises(ConfigError, match="give one of"):
        prepare_scene(small_garment, small_poses, integrator="Euler")


def test_contacts_are_as_stiff_as_the_fabric_asks_for(small_scene):
    """The same vertex at the same depth presses with the fabric's share."""
    denim, stiffness = fabric_material("denim"), Collision().stiffness
    fabrics = [jax.tree.map(jnp.asarray, one) for one in (denim, COTTON)]
    scenes = [small_scene.replace(material=one, terms=without_pairs(small_scene)) for one in fabrics]
    found = [float(of_first_frame(scene).data_of(Collision).stiffness) for scene in scenes]
    assert found == pytest.approx([float(contact_excess(denim)) * stiffness, stiffness])
    assert found[0] > 5 * stiffness


def test_scenes_with_and_without_pieces_and_pins_can_be_stacked():
    """What one of them needs, all model."""
    layer = square()
    positions, faces = np.asarray(layer.rest_positions), np.asarray(layer.faces)
    one = make_garment(positions, faces, is_pinned=np.arange(len(positions)) < 8)
    above = positions + np.array([0, 0.01, 0])
    two = make_garment(np.concatenate([positions, above]), np.concatenate([faces, faces + len(positions)]))
    motion = drifting_ball(4)
    scenes = prepare_scenes([one, two], [motion, motion], [COTTON, COTTON])
    assert len({(scene.term(Contact).rows, scene.term(Contact).has_layers) for scene in scenes}) == 1
    shapes = [jax.tree.map(np.shape, scene) for scene in scenes]
    assert shapes[0] == shapes[1]
    assert all(scene.pin_targets is not None for scene in scenes)


def test_what_a_plan_leaves_out_changes_no_force(small_garment, small_poses, small_scene, monkeypatch):
    """A scene that is not planned searches every face of the body, and models pins although there are none."""
    terms = without_pairs(small_scene)
    whole = jax.jit(build_scene)(small_garment, small_poses, small_scene.material, terms)
    assert whole.pin_targets is not None
    monkeypatch.setattr("eslr_jax.terms.worn.REACH", REACH / 2)  # else all of this small body is in reach
    near = prepare_scene(small_garment, small_poses, terms=terms)
    assert whole.body.surface.faces.shape[0] > near.body.surface.faces.shape[0]
    # Pressed into the limb, and rubbing on it.
    start = small_scene.initial_state
    loaded = start.replace(friction_load=jnp.full_like(start.friction_load, 1e-3))
    position = 0.9 * start.position + 1e-3

    def forces(scene):
        return pressed(position, of_first_frame(scene.replace(initial_state=loaded))).gradient

    expected = forces(whole)
    np.testing.assert_allclose(forces(near), expected, atol=1e-5 * np.abs(expected).max())


def test_the_first_frames_of_a_scene_have_its_inputs(small_scene):
    short = first_frames(small_scene, 3)
    assert short.num_frames == 3
    whole = jax.tree.map(lambda leaf: leaf[:2], frame_inputs(small_scene))
    jax.tree.map(np.testing.assert_array_equal, frame_inputs(short), whole)
    assert first_frames(small_scene, 99).num_frames == small_scene.num_frames


def test_a_limb_that_comes_for_a_fifth_of_a_second_in_a_long_motion_is_searched():
    """Of 300 frames it is near in six, 138 to 143; a look at every twenty-seventh would miss it."""
    positions, faces = ball()
    hand = positions * 0.3 + np.array([0.0, 0.2, 0.0])
    both = np.concatenate([positions, hand]), np.concatenate([faces, faces + len(positions)])
    poses = drifting_ball(300, speed=0.0, mesh=both)
    is_away = np.ones(300)
    is_away[138:144] = 0.0
    assert is_away[np.linspace(0, 299, 12).astype(int)].all()
    moved = np.array(poses.positions)
    moved[:, len(positions) :, 1] += is_away[:, None]
    _, near = plan_scene(square(), poses.replace(positions=jnp.asarray(moved)))
    reached = np.asarray(near.surface.vertex_ids)
    assert (reached >= len(positions)).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dress", "tshirt"])
def test_cloth_touches_nothing_else_than_what_was_searched(body, name):
    """The hem of a dress swings farther from where it is skinned to than a T-shirt does."""
    poses = pose_body(body, load_motion("cmu_016_32"), num_frames=31)
    scene = prepare_scene(load_garment(name), poses)
    trajectory = jax.jit(rollout_scene, static_argnames="config")(None, scene, SimConfig(iterations=40))
    solid = np.asarray(poses.faces)[np.asarray(poses.is_obstacle)]
    find = jax.jit(find_contacts)
    for frame in (10, 20, 30):
        cloth, reached = trajectory.positions[frame], scene.body.positions[frame]
        contacts = find(cloth, reached, reached, scene.body.surface)
        corners = np.asarray(poses.positions[frame])
        face, weights = closest_points(np.asarray(cloth), corners, solid)
        nearest = np.einsum("vc,vcx->vx", weights, corners[solid[face]])
        touches = np.linalg.norm(nearest - np.asarray(cloth), axis=1) < 0.02
        assert touches.sum() > 50
        assert np.mean(contacts.is_near[touches]) > 0.999
        np.testing.assert_array_less(-0.005, np.where(contacts.is_near, contacts.distances, 0.0))


def has_layers(garment, poses):
    """Tell whether cloth is kept from passing through cloth."""
    planned, _ = plan_scene(garment, poses)
    return next(term.has_layers for term in planned if isinstance(term, Contact))


def test_one_piece_that_can_fold_is_kept_from_passing_through_itself(small_garment, small_poses):
    """A tight sleeve has no room to fold; a sheet that hangs ten centimetres off the limb has."""
    from cloth import make_garment, make_sheet

    positions, faces = make_sheet(6, 6, 0.02, jitter=0)
    loose = make_garment(positions + np.array([0.16, 0.0, 0.0]), faces)
    assert not has_layers(small_garment, small_poses)
    assert has_layers(loose, small_poses)


def test_a_sleeve_that_meets_its_trunk_can_meet_itself():
    """Arms that hang bring a sleeve to the trunk, half a garment away at rest."""
    body = load_body()
    assert has_layers(load_garment("tshirt"), pose_body(body, load_motion("cmu_016_29"), num_frames=6))
