"""Pairs of vertices with faces and of edges: distances, pushes and searches against other people's code."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from scipy.spatial import cKDTree

from eslr_jax.contact import lists, pairs
from eslr_jax.mesh.surface import prepare_surface

ROWS = 2048
EMPTY = pairs.Rows(jnp.zeros((4, pairs.CHUNK), jnp.int32), jnp.int32(0))
KINDS = pytest.mark.parametrize("is_edge", [False, True], ids=["faces", "edges"])
find_pairs = jax.jit(lists.find_pairs, static_argnums=2)
pushed_apart = jax.jit(pairs.pushed_apart, static_argnums=4)


@partial(jax.jit, static_argnums=2)
def closest(x, ids, is_edge):
    """Return the closest points of pairs, by the places of vertices and the ids of their corners."""
    return pairs.closest(pairs.corners_of(x, ids), is_edge)


def random_rows(is_edge, scale=0.02):
    """Random pairs, as both tables, their ids, and their vertices [m]."""
    x = (np.random.default_rng(0).normal(size=(4 * ROWS, 3)) * scale).astype(np.float32)
    ids = np.arange(4 * ROWS, dtype=np.int32).reshape(4, ROWS)
    rows = pairs.Rows(jnp.asarray(ids), jnp.int32(ROWS))
    return pairs.Pairs(EMPTY, rows) if is_edge else pairs.Pairs(rows, EMPTY), ids, x


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
    found = closest(columns(x), jnp.asarray(ids), is_edge).distance
    np.testing.assert_allclose(found, known, rtol=1e-4, atol=1e-7)


@KINDS
def test_pushed_ends_are_reached_without_crossing_and_those_that_meet_nothing_stay(is_edge):
    table, ids, x = random_rows(is_edge)
    step = np.random.default_rng(2).normal(size=x.shape).astype(np.float32) * 0.012
    freedom = jnp.asarray(np.arange(len(x)) < 3 * ROWS, int)  # the last corner of every pair stays
    ends, lack = pushed_apart(columns(x), columns(x + step), table, freedom, 60)
    assert float(lack) < 1e-8  # a pair that only comes near may be left undecided
    ends = np.stack(ends, axis=1)
    np.testing.assert_array_equal(ends[3 * ROWS :], (x + step)[3 * ROWS :])
    squared, meets = toolkit(is_edge)

    def meeting(ends):
        """Pairs that meet; the toolkit also names some that come near, which samples sort out."""
        is_met = np.zeros(ROWS, bool)
        for row, four in enumerate(ids.T):
            a, b = x[four].astype(float), ends[four].astype(float)
            if meets(*a, *b)[0]:
                gaps = [squared(*((1 - t) * a + t * b)) for t in np.linspace(0, 1, 501)]
                is_met[row] = np.sqrt(min(gaps)) < min(1e-5, 0.02 * np.sqrt(gaps[0]))
        return is_met

    assert not meeting(ends).any()
    is_pushed = np.any(ends != x + step, axis=1)[ids].any(axis=0)
    does_meet = meeting(x + step)
    assert does_meet.sum() > 20
    # What meets is pushed; of what does not, few come so near that no direction is found to part them.
    assert is_pushed[does_meet].all()
    assert is_pushed[~does_meet].mean() < 0.1


@KINDS
def test_gaps_do_not_shrink_below_the_floor(is_edge):
    table, ids, x = random_rows(is_edge, scale=0.005)
    near = closest(columns(x), jnp.asarray(ids), is_edge)
    # The first primitive of every pair goes to 20 micrometres before the second.
    toward = np.stack(near.offset, axis=1) * np.asarray(1 - 2e-5 / near.distance)[:, None]
    first = ids[: 2 if is_edge else 1]
    x[first] -= toward.astype(np.float32)
    freedom = jnp.asarray(np.isin(np.arange(len(x)), first), int)
    ends, lack = pushed_apart(columns(x), columns(x), table, freedom, 60)
    distance = closest(ends, jnp.asarray(ids), is_edge).distance
    assert float(lack) == 0
    assert float(distance.min()) >= pairs.FLOOR


def test_what_is_pushed_onto_others_is_pushed_off_them():
    """An edge falls on one that lies on a third. Sweeps leave out chunks of rows in which nothing moves."""
    x = np.float32([[0, 1, -10], [0, 1, 10], [-10, 0, 0], [10, 0, 0], [0, -0.6, -10], [0, -0.6, 10]]) * 1e-3
    step = np.zeros_like(x)
    step[:2, 1] = -3e-3
    # A chunk for each pair.
    ids = np.zeros((4, 2 * pairs.CHUNK), np.int32)
    ids[:, : pairs.CHUNK] = np.arange(4)[:, None]
    ids[:, pairs.CHUNK] = np.arange(2, 6)
    edges = pairs.Rows(jnp.asarray(ids), jnp.int32(pairs.CHUNK + 1))
    freedom = jnp.asarray(np.arange(6) < 4, int)
    ends, lack = pushed_apart(columns(x), columns(x + step), pairs.Pairs(EMPTY, edges), freedom, 60)
    assert float(lack) == 0
    heights = np.asarray(ends[1]).reshape(3, 2)
    assert heights[0].min() > heights[1].max() + pairs.FLOOR
    assert heights[1].min() > heights[2].max() + pairs.FLOOR
    assert heights[1].max() < 0  # the fallen edge moved it


@pytest.mark.parametrize("least", [0, 1])
def test_what_has_less_freedom_stays_where_the_other_can_be_pushed(least):
    x = np.float32([[0, 1, -10], [0, 1, 10], [-10, 0, 0], [10, 0, 0]]) * 1e-3
    step = np.float32([[0, -3, 0], [0, -3, 0], [0, 0, 0], [0, 0, 0]]) * 1e-3
    edges = EMPTY._replace(ids=EMPTY.ids.at[:, 0].set(jnp.arange(4)), count=jnp.int32(1))
    freedom = jnp.asarray([least + 1, least + 1, least, least])
    ends, lack = pushed_apart(columns(x), columns(x + step), pairs.Pairs(EMPTY, edges), freedom, 60)
    assert float(lack) == 0
    np.testing.assert_array_equal(np.stack(ends, axis=1)[2:], x[2:])
    assert float(ends[1][:2].min()) > pairs.FLOOR


def test_edges_that_slide_past_each_other_are_not_pushed():
    """By 34 mm a frame, 2 mm apart: a fast sheet on a slope caught on every edge of the ground."""
    x = np.float32([[-0.017, 0.002, -0.02], [-0.017, 0.002, 0.02], [0, 0, -0.1], [0, 0, 0.1]])
    step = np.float32([[0.034, 0, 0], [0.034, 0, 0], [0, 0, 0], [0, 0, 0]])
    edges = EMPTY._replace(ids=EMPTY.ids.at[:, 0].set(jnp.arange(4)), count=jnp.int32(1))
    ends, lack = pushed_apart(columns(x), columns(x + step), pairs.Pairs(EMPTY, edges), jnp.ones(4, int), 60)
    assert float(lack) == 0
    np.testing.assert_array_equal(np.stack(ends, axis=1), x + step)


def sheet_in_ball():
    """Return meshes and places of a sheet whose middle lies in a ball: there both are near each other."""
    garment, poses = square(side=12), drifting_ball(2)
    surface = prepare_surface(np.asarray(poses.positions[0]), np.asarray(poses.faces))
    sheet = np.asarray(garment.rest_positions) - np.float32([0.0, 0.004, 0.0])
    return lists.joint_meshes(garment, surface), np.concatenate([sheet, poses.positions[0]])


def test_the_search_finds_every_pair_that_comes_near_while_vertices_move():
    meshes, start = sheet_in_ball()
    random = np.random.default_rng(3)
    half = random.normal(size=start.shape).astype(np.float32) * 2e-3
    radius = np.where(np.arange(len(start)) < 144, 2e-3, 0.0).astype(np.float32)
    motion = lists.Motion(columns(start), columns(half), jnp.asarray(radius))
    found = find_pairs(motion, meshes, 65536)
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
        known = set()
        for _ in range(50):  # places within the motion: on the ways, and in the balls around them
            way = start + half * np.float32(random.choice([-1.0, 0.3, 1.0]))
            off = np.sign(random.normal(size=start.shape)) / np.sqrt(3)
            place = columns((way + radius[:, None] * off).astype(np.float32))
            distance = closest(place, jnp.asarray(ids.T), is_edge).distance
            known |= {tuple(row) for row in ids[np.asarray(distance) < pairs.GAP]}
        count = int(rows.count)
        own = [tuple(row) for row in np.asarray(rows.ids).T[:count]]
        assert known
        assert known <= set(own)
        assert len(own) == len(set(own)) == count


def test_rows_beyond_a_table_are_counted():
    meshes, start = sheet_in_ball()
    still = lists.Motion(columns(start), columns(0 * start), jnp.full(len(start), 0.02))
    few, many = (find_pairs(still, meshes, rows) for rows in (512, 65536))
    assert int(few.most) == int(many.most) > 512
    assert int(few.pairs.edges.count) == 512
