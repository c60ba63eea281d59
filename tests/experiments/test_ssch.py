"""SSCH on our own data: the garment space, and that the network learns a motion and comes back from its file."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paper import ssch
from paper.posed import carry
from scipy.spatial.transform import Rotation


@pytest.fixture(scope="module")
def motion(tshirt):
    """Twelve frames of slightly turned joints, on every joint the same [frames, joints, 3, 4]."""
    count = int(np.asarray(tshirt.skin_indices).max()) + 1
    angles = 0.2 * np.sin(0.4 * np.arange(12)[:, None] + np.arange(count)[None])
    turned = Rotation.from_rotvec(angles.reshape((-1, 1)) * [0.6, 0.0, 0.8]).as_matrix()
    moved = np.full((len(turned), 3, 1), 0.1)
    rows = np.concatenate([turned, moved], axis=2).reshape((12, count, 3, 4))
    return jnp.asarray(rows, jnp.float32)


def test_unposing_undoes_skinning(tshirt, motion):
    offsets = 0.01 * np.random.default_rng(0).standard_normal(tshirt.rest_positions.shape).astype(np.float32)
    posed = carry(tshirt, jnp.asarray(offsets)[None], motion[3:4])[0]
    found = np.asarray(ssch.unpose(tshirt, posed, motion[3]))
    assert np.linalg.norm(found - offsets) < 0.05 * np.linalg.norm(offsets)  # of damping
    assert np.linalg.norm(np.asarray(posed) - tshirt.rest_positions) > np.linalg.norm(offsets)


@pytest.mark.slow
def test_a_motion_is_learnt_and_kept(tshirt, motion, tmp_path):
    sway = 0.02 * np.sin(0.8 * np.arange(12))[None, :, None, None]
    offsets = jnp.asarray(np.broadcast_to(sway, (1, 12, *tshirt.rest_positions.shape)), jnp.float32)
    network = ssch.prepare(tshirt, motion[None], offsets, seed=0)
    features = ssch.motion_features(motion, network)[None]
    latents = jnp.zeros((1, 12, 25))
    with jax.numpy_dtype_promotion("standard"):  # optax mixes types
        regressor, losses = ssch.fit(
            jax.value_and_grad(lambda params, batch, _: ssch.motion_loss(params, network, *batch)),
            network.params["regressor"],
            lambda _: (features, offsets, latents),
            200,
            0,
        )
    assert losses[-1] < 0.95 * losses[0]  # the decoder, which is not trained here, can show no more
    network = network.replace(params={**network.params, "regressor": regressor})
    ssch.write_network(network, tmp_path / "ssch_tshirt.npz", {"steps": 40})
    again, training = ssch.read_network(tmp_path / "ssch_tshirt.npz")
    assert training == {"steps": 40}
    positions = ssch.displace(network, tshirt, motion)
    assert positions.shape == (12, *tshirt.rest_positions.shape)
    assert np.isfinite(positions).all()
    np.testing.assert_allclose(ssch.displace(again, tshirt, motion), positions, atol=1e-6)
