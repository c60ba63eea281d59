"""MAT on our own data: what joins faces, what it sees, how it keeps off the body, and that it learns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paper import mat, mat_space
from scipy.spatial.transform import Rotation

from eslr_jax import Network, SimConfig, rollout_scene
from eslr_jax.types import Contacts


@pytest.fixture(scope="module")
def space(small_garment):
    return mat_space.prepare_space(small_garment)


@pytest.fixture(scope="module")
def moved(small_garment):
    """Two shapes of the garment [m], turned and bent."""
    rest = np.asarray(small_garment.rest_positions, float)
    noise = np.random.default_rng(0).standard_normal((2, *rest.shape))
    turns = [Rotation.from_rotvec(angles).as_matrix() for angles in ([0.1, 0.9, 0.1], [0.1, 1.2, 0.0])]
    return [
        jnp.asarray(rest @ turn.T + 0.003 * bump, jnp.float32)
        for turn, bump in zip(turns, noise, strict=True)
    ]


def contacts_of(position, depth=0.05):
    """A floor under the cloth [m] that rises through its lower part."""
    floor = jnp.min(position[:, 1]) + depth
    points = position.at[:, 1].set(floor)
    up = jnp.zeros_like(position).at[:, 1].set(1.0)
    height = position[:, 1] - floor
    near = jnp.ones(len(position), bool)
    return Contacts(points, points + 0.01, up, up, height, near, jnp.zeros(len(position), jnp.int32))


def test_the_true_change_of_faces_rebuilds_the_true_positions(space, moved):
    now, after = moved
    turn = mat_space.heading(now, space)
    rebuilt = mat_space.rebuild(mat_space.change_between(now, after, space, turn), now, space, turn)
    is_real = np.asarray(space.garment.vertex_mask)
    np.testing.assert_allclose(np.asarray(rebuilt)[is_real], np.asarray(after)[is_real], atol=2e-4)
    assert np.abs(np.asarray(now) - after)[is_real].max() > 0.02


def test_turning_and_shifting_the_scene_changes_nothing_that_is_seen(space, moved):
    position, after = moved
    yaw = jnp.asarray(Rotation.from_euler("y", 70, degrees=True).as_matrix(), jnp.float32)

    shift = jnp.array([[1.0, 0.0, -2.0]])

    def seen(position, after, turned):
        contacts = contacts_of(position)
        arrows = {name: getattr(contacts, name) @ turned.T for name in ("points", "next_points", "normals")}
        contacts = contacts.replace(**arrows, next_normals=arrows["normals"])
        place = position @ turned.T + shift
        then = after @ turned.T + shift
        turn = mat_space.heading(place, space)
        return mat.observe(place, then - place, contacts, space, turn), mat_space.change_between(
            place, then, space, turn
        )

    straight, turned = (jax.tree.leaves(seen(position, after, rotation)) for rotation in (jnp.eye(3), yaw))
    for one, other in zip(straight, turned, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-4)


def test_cloth_inside_the_body_comes_out_and_the_rest_hardly_moves(space, moved):
    position = moved[0]
    contacts = contacts_of(position)
    contacts = contacts.replace(next_points=contacts.points)
    is_real = np.asarray(space.garment.vertex_mask)
    before = np.asarray(contacts.distances)[is_real]
    off = np.asarray(mat_space.step_off(position, contacts, space))[is_real]
    after = before + off[:, 1] - np.asarray(position)[is_real, 1]
    assert before.min() == pytest.approx(-0.05, abs=1e-4)
    assert after.min() > -0.01  # what is left is the price of smoothness
    clear = before > 0.1
    assert np.abs(after - before)[clear].max() < 0.02


@pytest.mark.slow
def test_the_error_falls_on_a_frame_that_is_seen_again_and_again(space, moved):
    turn = mat_space.heading(moved[0], space)
    seen = mat.observe(moved[0], moved[1] - moved[0], contacts_of(moved[0]), space, turn)
    change = mat_space.change_between(*moved, space, turn)
    is_face = np.asarray(space.garment.rest_areas) > 0
    stacked = jax.tree.map(lambda x: np.asarray(x)[None], (seen, change))
    scales = [mat.column_moments(value, is_face) for value in stacked]
    seen, change = (
        mat.standardise(value, *moments) for value, moments in zip((seen, change), scales, strict=True)
    )
    params = mat.Transformer().init(jax.random.key(0), seen, space.geodesic, is_face.astype(np.float32))
    network = mat.Weights(params, *scales[0], *scales[1], space)
    with jax.numpy_dtype_promotion("standard"):  # optax mixes types
        _, losses = mat.fit(
            jax.value_and_grad(
                lambda params, _, key: mat.loss(network.replace(params=params), seen, change, key)
            ),
            params,
            lambda _: None,
            60,
            0,
        )
    assert np.mean(losses[-5:]) < 0.7 * losses[0]


@pytest.mark.slow
def test_an_untrained_network_steps_the_cloth_and_comes_back_from_its_file(small_scene, tmp_path):
    space = mat_space.prepare_space(small_scene.garment)
    faces, count = jnp.ones((1, 34)), len(space.garment.faces)
    scales = [mat.Seen(0 * faces, jnp.zeros(6)), mat.Seen(faces, jnp.ones(6))]
    scales += [mat.Change(0 * faces[:, :9], jnp.zeros(3)), mat.Change(0.1 * faces[:, :9], 0.01 * jnp.ones(3))]
    seen = mat.Seen(jnp.zeros((count, 34)), jnp.zeros(6))
    params = mat.Transformer().init(jax.random.key(0), seen, space.geodesic, jnp.ones(count))
    network = mat.Weights(params, *scales)
    mat.write_network(network, tmp_path / "mat_sleeve.npz", {})
    again, _ = mat.read_network(tmp_path / "mat_sleeve.npz")
    config = SimConfig(iterations=0)
    still, random, read = (
        np.asarray(rollout_scene(Network(net.replace(space=space), mat.Mat()), small_scene, config).positions)
        for net in (mat.untrained(network), network, again)
    )
    is_real = np.asarray(space.garment.vertex_mask)
    assert np.isfinite(random).all()
    np.testing.assert_array_equal(random, read)
    assert np.abs(random - still).max() > 0.01
    # Heads of zeros leave the cloth where it is but for the body, which pushes it.
    pushed = np.abs(np.diff(still[:, is_real], axis=0)).max()
    assert 1e-4 < pushed < 0.03
