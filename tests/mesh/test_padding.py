"""A padded garment holds the same numbers, and what is added weighs nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax import CapacityError, MeshError, prepare_garment
from eslr_jax.mesh.padding import choose_bucket, common_bucket, garment_bucket, pad_garment, round_up
from eslr_jax.numerics import gather_corners


def prepare(positions, faces, **options):
    count = len(positions)
    weights = np.tile([3.0, 1.0, 0.0, 0.0], (count, 1))
    indices = np.tile([2, 5, 0, 0], (count, 1))
    return prepare_garment(positions, faces, skin_weights=weights, skin_indices=indices, **options)


@pytest.fixture(scope="module")
def garment(builders):
    return prepare(*builders.tube(17, 9), is_pinned=np.arange(153) < 9)


@pytest.fixture(scope="module")
def padded(garment):
    return pad_garment(garment)


def test_prepared_garment_has_device_dtypes_and_normal_weights(garment):
    kinds = {leaf.dtype for leaf in jax.tree.leaves(garment)}
    assert kinds == {jnp.dtype("float32"), jnp.dtype("int32"), jnp.dtype("bool")}
    np.testing.assert_allclose(garment.skin_weights.sum(axis=1), 1, rtol=1e-6)
    assert garment.is_pinned.sum() == 9


def test_prepared_areas_agree(garment):
    total = float(garment.rest_areas.sum())
    np.testing.assert_allclose(garment.vertex_areas.sum(), total, rtol=1e-5)
    faces, areas = np.asarray(garment.faces), np.asarray(garment.rest_areas)
    ends = np.asarray(garment.hinges)[:, :2]
    expected = [areas[np.isin(faces, pair).sum(axis=1) == 2].sum() for pair in ends]
    np.testing.assert_allclose(garment.hinge_rest_areas, expected, rtol=1e-5)


def test_real_rows_stay(garment, padded):
    for name in garment.__dataclass_fields__:
        if name.endswith("incidence") or name in ("coarse", "material"):
            continue
        real = np.asarray(getattr(garment, name))
        head = np.asarray(getattr(padded, name))[tuple(slice(0, size) for size in real.shape)]
        assert head.dtype == real.dtype
        np.testing.assert_array_equal(head, real, err_msg=name)


def test_padding_follows_the_rule(garment, padded):
    last = len(padded.vertex_mask) - 1
    have = garment_bucket(garment)
    assert garment_bucket(padded) == choose_bucket(garment)
    for name in ("faces", "hinges", "senders", "receivers"):
        assert (np.asarray(getattr(padded, name))[len(getattr(garment, name)) :] == last).all()
    for name in ("rest_areas", "hinge_rest_areas", "vertex_areas", "vertex_mask", "edge_mask", "is_pinned"):
        assert not np.asarray(getattr(padded, name))[len(getattr(garment, name)) :].any()
    np.testing.assert_array_equal(padded.inverse_rest_frames[have.faces], np.eye(2))
    assert (np.diff(padded.receivers) >= 0).all()
    np.testing.assert_array_equal(padded.senders[padded.reverse_edges], padded.receivers)
    assert not padded.vertex_mask[last]
    assert (padded.neighbors[have.vertices :] == np.arange(have.vertices, last + 1)[:, None]).all()
    assert not padded.neighbor_mask[have.vertices :].any()
    for leaf in (padded.faces, padded.hinges, padded.senders, padded.neighbors):
        assert leaf.min() >= 0
        assert leaf.max() <= last
    assert np.isfinite(np.asarray(padded.rest_positions)).all()


@pytest.mark.parametrize("corners", ["faces", "hinges"])
def test_gradients_through_padded_tables_equal_a_scatter(garment, padded, corners):
    for one in (garment, padded):
        one = jax.tree.map(jnp.asarray, one)
        indices = getattr(one, corners)
        table = one.face_incidence if corners == "faces" else one.hinge_incidence
        count = len(getattr(garment, corners))
        weights = jnp.asarray(np.random.default_rng(0).normal(size=(count, indices.shape[1], 3)), jnp.float32)

        def through_table(x, indices=indices, table=table, weights=weights, count=count):
            gathered = jnp.stack([jnp.stack(corner, -1) for corner in gather_corners(x, indices, table)], 1)
            return jnp.sum(gathered[:count] ** 2 * weights)

        def plain(x, indices=indices, weights=weights, count=count):
            return jnp.sum(x[indices][:count] ** 2 * weights)

        gradient = jax.jit(jax.grad(through_table))(one.rest_positions)
        np.testing.assert_allclose(gradient, jax.jit(jax.grad(plain))(one.rest_positions), atol=1e-5)


@pytest.mark.parametrize("of", ["face", "hinge"])
def test_incidence_lists_no_padding(garment, padded, of):
    items = {"face": "faces", "hinge": "hinges"}[of]
    table, count = np.asarray(getattr(padded, f"{of}_incidence")), len(getattr(padded, items))
    corners = getattr(padded, items).shape[1]
    listed = table[table < corners * count]
    assert (listed % count < len(getattr(garment, items))).all()
    assert len(listed) == getattr(garment, items).size


def test_single_triangle_pads(builders):
    garment = prepare(np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0.0]]), np.array([[0, 1, 2]]), pad=True)
    assert (garment.hinge_incidence == garment.hinges.size).all()
    assert garment.vertex_mask.sum() == 3


@pytest.mark.parametrize("count", [1, 2, 17, 1000, 1024, 1025, 4000, 4001, 12345, 50000])
def test_sizes_waste_little(count):
    size = round_up(count)
    assert count <= size <= max(1.0625 * count + 1e-9, count + 1)
    assert round_up(size) == size


def test_garments_of_like_size_share_a_bucket(builders):
    first, second = prepare(*builders.tube(10, 20)), prepare(*builders.tube(12, 17))
    assert choose_bucket(first) == choose_bucket(second)
    assert common_bucket([choose_bucket(first), garment_bucket(second)]) == choose_bucket(first)


def test_small_bucket_is_named(garment):
    bucket = choose_bucket(garment)
    with pytest.raises(CapacityError, match=r"faces 272, the bucket holds 10"):
        pad_garment(garment, bucket._replace(faces=10))
    with pytest.raises(CapacityError, match="at least 154 vertices"):
        pad_garment(garment, bucket._replace(vertices=153))
    assert pad_garment(garment, garment_bucket(garment)) is garment


@pytest.mark.parametrize(("change", "message"), [
    ({"skin_weights": np.ones((5, 4))}, "skin weights .5, 4. and indices .153, 4. do not fit 153 vertices"),
    ({"skin_weights": np.zeros((153, 4))}, "skin weights of vertex 0"),
    ({"skin_indices": np.full((153, 4), -1)}, "skin indices of vertex 0 .* joints are counted from 0"),
    ({"is_pinned": np.zeros(4, bool)}, "is_pinned has shape .4,. and dtype bool for 153 vertices"),
])  # fmt: skip
def test_arrays_that_do_not_fit_are_named(builders, change, message):
    positions, faces = builders.tube(17, 9)
    options = {"skin_weights": np.ones((153, 4)), "skin_indices": np.zeros((153, 4), int)} | change
    with pytest.raises(MeshError, match=message):
        prepare_garment(positions, faces, **options)


def test_disconnected_garment_prepares_on_request(builders):
    positions, faces = builders.sheet(4, 4)
    both = np.concatenate([positions, positions + np.array([0, 0.2, 0])]), np.concatenate([faces, faces + 16])
    with pytest.raises(MeshError, match="2 separate components"):
        prepare(*both)
    garment = prepare(*both, allow_components=True)
    assert np.isfinite(garment.geodesic_embedding).all()
