"""Pairs of vertices with faces and of edges: distances, forces, cuts and lists against other people's code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from scipy.spatial import cKDTree

from eslr_jax.contact import lists, pairs
from eslr_jax.mesh.surface import prepare_surface

ROWS = 2048
KINDS = pytest.mark.parametrize("is_edge", [False, True], ids=["faces", "edges"])


def random_rows(is_edge, scale=0.02):
    """Random pairs, as both tables, their ids, and their vertices [m]."""
    x = (np.random.default_rng(0).normal(size=(4 * ROWS, 3)) * scale).astype(np.float32)
    ids, ones = np.arange(4 * ROWS, dtype=np.int32).reshape(4, ROWS), jnp.ones(ROWS)
    rows = pairs.Rows(jnp.asarray(ids), ones, 3e-3 * ones, 1e-10 * ones, jnp.int32(ROWS))
    empty = pairs.no_pairs(pairs.CHUNK, jnp.float32)
    return pairs.Pairs(empty, rows) if is_edge else pairs.Pairs(rows, empty), ids, x


def toolkit(is_edge):
    """Squared distance and continuous detection of the IPC Toolkit."""
    ipctk = pytest.importorskip("ipctk")
    ccd = ipctk.TightInclusionCCD()
    if is_edge:
        return ipctk.edge_edge_distance, ccd.edge_edge_ccd
    return ipctk.point_triangle_distance, ccd.point_triangle_ccd


def columns(x):
    return tuple(jnp.asarray(x).T)


@KINDS
def test_distances_are_the_ipc_toolkits(is_edge):
    _, ids, x = random_rows(is_edge)
    squared, _ = toolkit(is_edge)
    known = [np.sqrt(squared(*x[ids[:, row]].astype(float))) for row in range(ROWS)]
    found = pairs.closest(pairs.corners_of(columns(x), jnp.asarray(ids)), is_edge).distance
    np.testing.assert_allclose(found, known, rtol=1e-4, atol=1e-7)


@KINDS
def test_the_gradient_is_that_of_the_energy(is_edge):
    table, _, x = random_rows(is_edge, scale=0.003)
    where = columns(x)
    total, gradient = pairs.energy_and_gradient(where, table)
    rows, slopes = jax.value_and_grad(lambda x: sum(jnp.sum(part) for part in pairs.energies(x, table)))(
        where
    )
    assert float(total) > 0
    assert float(total) == pytest.approx(float(rows), rel=1e-5)
    for own, known in zip(gradient, slopes, strict=True):
        np.testing.assert_allclose(own, known, atol=1e-3 * float(jnp.abs(known).max()))
    other = jax.grad(lambda x: pairs.energy(x, table))(where)
    np.testing.assert_array_equal(np.stack(other), np.stack(gradient))


@KINDS
def test_cut_steps_cross_nothing(is_edge):
    table, ids, x = random_rows(is_edge)
    random = np.random.default_rng(1)
    step = (random.normal(size=x.shape) * random.choice([0.002, 0.01, 0.04], size=(len(x), 1))).astype(
        np.float32
    )
    share = np.asarray(pairs.shares(columns(x), columns(step), table, 0.9))[:, None]
    squared, meets = toolkit(is_edge)

    def crossing(scale):
        """Pairs that cross on the way; the toolkit also names some that come near, which samples sort out."""
        start, end = x.astype(float), x.astype(float) + scale * step
        count = 0
        for row in range(ROWS):
            a, b = start[ids[:, row]], end[ids[:, row]]
            if meets(*a, *b)[0]:
                gaps = [squared(*((1 - t) * a + t * b)) for t in np.linspace(0, 1, 501)]
                count += np.sqrt(min(gaps)) < 0.02 * np.sqrt(gaps[0])
        return count

    assert crossing(np.ones_like(share)) > 20
    assert crossing(share) == 0


@KINDS
def test_pushed_ends_cross_nothing(is_edge):
    table, ids, x = random_rows(is_edge)
    step = np.random.default_rng(2).normal(size=x.shape).astype(np.float32) * 0.02
    is_free = jnp.asarray(np.arange(len(x)) < 3 * ROWS)  # the last corner of every pair stays
    ends, lack = pairs.mended(columns(x), columns(x + step), table, is_free, 60)
    assert float(lack) < 1e-7
    ends = np.stack(ends, axis=1).astype(float)
    np.testing.assert_array_equal(ends[3 * ROWS :], (x + step)[3 * ROWS :])
    _, meets = toolkit(is_edge)
    assert not any(meets(*x[ids[:, row]].astype(float), *ends[ids[:, row]])[0] for row in range(ROWS))


def sheet_in_ball():
    """Return meshes and places of a sheet whose middle lies in a ball: there both are near each other."""
    garment, poses = square(side=12), drifting_ball(2)
    surface = prepare_surface(np.asarray(poses.positions[0]), np.asarray(poses.faces))
    meshes = lists.joint_meshes(garment, surface)
    sheet = np.asarray(garment.rest_positions) - np.float32([0.0, 0.004, 0.0])
    return meshes, np.concatenate([sheet, poses.positions[0]])


def search(motion, meshes, rows):
    """Return all pairs: every vertex is new."""
    nothing = pairs.Pairs(*[pairs.no_pairs(rows, jnp.float32)] * 2)
    everyone = jnp.ones(motion.radius.shape, bool)
    known = lists.Found(nothing, jnp.int32(0))
    return lists.find_pairs(motion, meshes, jnp.float32(3e-3), known, everyone, None)


def listed(rows):
    """Return the pairs of a table as a set."""
    return {tuple(row) for row in np.asarray(rows.ids).T[: int(rows.count)]}


def test_a_search_for_some_vertices_completes_the_pairs_of_the_others():
    meshes, start = sheet_in_ball()
    random = np.random.default_rng(4)
    is_cloth = np.arange(len(start)) < 144
    radius = np.where(is_cloth, 3e-3, 0.0).astype(np.float32)
    before = search(lists.Motion(columns(start), columns(0 * start), jnp.asarray(radius)), meshes, 8192)
    is_new = is_cloth & (random.random(len(start)) < 0.1)
    start[is_new] += 8e-3 * random.normal(size=(is_new.sum(), 3)).astype(np.float32)
    radius[is_new] = 5e-3
    after = lists.Motion(columns(start), columns(0 * start), jnp.asarray(radius))
    kept = lists.nearer_pairs(*after[::2], before.pairs, 8192, jnp.asarray(is_new))
    found = lists.find_pairs(after, meshes, jnp.float32(3e-3), kept, jnp.asarray(is_new), None)
    for rows, rest, whole in zip(found.pairs, kept.pairs, search(after, meshes, 8192).pairs, strict=True):
        assert int(rest.count) < int(rows.count) == int(whole.count) < 8192
        assert listed(rows) == listed(whole)


def test_the_search_finds_every_pair_within_reach_while_vertices_move():
    meshes, start = sheet_in_ball()
    random = np.random.default_rng(3)
    half = random.normal(size=start.shape).astype(np.float32) * 2e-3
    radius = np.where(np.arange(len(start)) < 144, 2e-3, 0.0).astype(np.float32)
    motion = lists.Motion(columns(start), columns(half), jnp.asarray(radius))
    reach = 3e-3
    found = search(motion, meshes, 4096)
    for (rows, is_edge), first, second in zip(
        found.pairs.kinds, (meshes.vertices, meshes.edges), (meshes.faces, meshes.edges), strict=True
    ):
        one, other = np.asarray(first.corners).T, np.asarray(second.corners).T
        near = cKDTree(start[one].mean(1)).query_ball_point(start[other].mean(1), 0.12)
        couples = np.array([(i, j) for j, rows in enumerate(near) for i in rows if not is_edge or i < j])
        ids = np.concatenate([one[couples[:, 0]], other[couples[:, 1]]], axis=1)
        shares_one = [(row[: one.shape[1], None] == row[None, one.shape[1] :]).any() for row in ids]
        ids = ids[~np.array(shares_one) & (ids < 144).any(axis=1)]
        is_one_body = (ids[:, : one.shape[1]] >= 144).all(1) & (ids[:, one.shape[1] :] >= 144).all(1)
        ids = ids[~is_one_body]
        # Places within the motion that it must allow for: one end of the way, and a corner of every ball.
        where = start + half + radius[:, None] * np.sign(random.normal(size=start.shape)) / np.sqrt(3)
        p = pairs.corners_of(columns(where.astype(np.float32)), jnp.asarray(ids.T))
        known = {tuple(row) for row in ids[np.asarray(pairs.closest(p, is_edge).distance) < reach]}
        count = int(rows.count)
        own = [tuple(row) for row in np.asarray(rows.ids).T[:count]]
        assert known
        assert known <= set(own)
        assert len(own) == len(set(own)) == count


def test_rows_beyond_a_table_are_counted():
    meshes, start = sheet_in_ball()
    still = lists.Motion(columns(start), columns(0 * start), jnp.full(len(start), 0.02))
    few, many = (search(still, meshes, rows) for rows in (512, 65536))
    assert int(few.most) == int(many.most) > 512
    assert int(few.pairs.edges.count) == 512
