"""Pairs of primitives: their closest points, the energy between them, and how far their vertices may go.

Cloth and body share one numbering, cloth first. A pair is a vertex over a face, (v, a, b, c), or an edge over an
edge, (a0, a1, b0, b1). Its offset is the way from the closest point of the second primitive to that of the first:
its length is their exact distance, and its direction separates the two, since both are convex.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.triangle import point_triangle
from eslr_jax.numerics import Vector3, cross3, dot3, sub3

FLOOR = 2e-5  # [m] gap that a step leaves at least: a hundred times the rounding of positions in float32
_BARRIER = 1.0 / 3.0  # share of the reach below which the energy is logarithmic
_PARALLEL = 1e-3  # squared sine of the angle between two edges below which their energy fades (IPC)
_LEAST_SHARE = 0.05  # of a gap, that either side of the dividing plane keeps
CHUNK = 512  # rows that are looked at together, and of which tables hold a multiple
_OVERSHOOT = 1.05  # of a push, so that sweeps end
_SHORT = 1e-9  # [m] below which two primitives touch, and have no direction


class Rows(NamedTuple):
    """Pairs of one kind, in a table of fixed size; those in use come first."""

    ids: Int[Array, "corners rows"]  # four vertices; what is not used names the first one
    areas: Float[Array, " rows"]  # of cloth that the pair stands for [m^2]; zero where not used
    reach: Float[Array, " rows"]  # distance below which it acts [m]
    rest: Float[Array, " rows"]  # of two edges, the product of their squared lengths at rest [m^4]
    count: Int[Array, ""]  # rows in use


class Pairs(NamedTuple):
    """Both kinds of pairs."""

    faces: Rows  # vertices over faces
    edges: Rows  # edges over edges

    @property
    def kinds(self) -> tuple[tuple[Rows, bool], tuple[Rows, bool]]:
        """Each kind, and whether it is of edges."""
        return (self.faces, False), (self.edges, True)


def no_pairs(rows: int, dtype: Any) -> Rows:
    """Return an empty table."""
    nothing = jnp.zeros(rows, dtype)
    return Rows(jnp.zeros((4, rows), jnp.int32), nothing, nothing, nothing, jnp.int32(0))


class Closest(NamedTuple):
    """Where pairs are closest."""

    weights: tuple[
        Array, Array, Array, Array
    ]  # of the four vertices in the offset; negative for the second side
    offset: Vector3  # [m], from the second primitive to the first
    distance: Float[Array, " rows"]  # [m], not less than `_SHORT`


def signs(is_edge: bool) -> tuple[int, int, int, int]:
    """Return 1 for the vertices of a pair's first primitive, and -1 for those of its second."""
    return (1, 1, -1, -1) if is_edge else (1, -1, -1, -1)


def corners_of(x: Vector3, ids: Int[Array, "corners rows"]) -> tuple[Vector3, ...]:
    """Return the four vertices of every row, by components.

    One gather each: jaxlib 0.10.2 sums products with gathers of [3, 4, rows] wrongly on a CPU.
    """
    return tuple((x[0][row], x[1][row], x[2][row]) for row in ids)


def closest(p: tuple[Vector3, ...], is_edge: bool, *, is_frozen: bool = False) -> Closest:
    """Return the closest points of every pair.

    Args:
        p: Its four vertices, by components [m].
        is_edge: It is of two edges.
        is_frozen: The weights have no derivative. The gradient of a distance needs none; its curvature does.
    """
    if is_edge:
        s, t = _closest_on_edges(*p)
        shares = s, t
    else:
        _, u, v = point_triangle(*p)
        shares = u, v
    if is_frozen:
        shares = jax.lax.stop_gradient(shares)
    offset = []
    for axis in range(3):  # differences first: their rounding is that of the offset, not of the place
        a, b, c, d = (corner[axis] for corner in p)
        if is_edge:
            offset.append((a - c) + shares[0] * (b - a) - shares[1] * (d - c))
        else:
            offset.append((a - b) - shares[0] * (c - b) - shares[1] * (d - b))
    one = jnp.ones_like(shares[0])
    if is_edge:
        weights = (1 - shares[0], shares[0], shares[1] - 1, -shares[1])
    else:
        weights = (one, shares[0] + shares[1] - 1, -shares[0], -shares[1])
    x, y, z = offset
    return Closest(weights, (x, y, z), jnp.sqrt(jnp.maximum(dot3((x, y, z), (x, y, z)), _SHORT**2)))


def _closest_on_edges(p0: Vector3, p1: Vector3, q0: Vector3, q1: Vector3) -> tuple[Array, Array]:
    """Return where two segments are closest, as shares of their lengths.

    Source: Ericson 2005, Real-Time Collision Detection, section 5.1.9.
    """
    first, second, between = sub3(p1, p0), sub3(q1, q0), sub3(p0, q0)
    a, e, b = dot3(first, first), dot3(second, second), dot3(first, second)
    c, f = dot3(first, between), dot3(second, between)
    a, e = (jnp.where(squared > 0, squared, 1.0) for squared in (a, e))
    determinant = a * e - b * b
    is_crossed = determinant > 1e-6 * a * e
    s = jnp.where(is_crossed, (b * f - c * e) / jnp.where(is_crossed, determinant, 1.0), 0.5)
    s = jnp.clip(s, 0.0, 1.0)
    t = jnp.clip((b * s + f) / e, 0.0, 1.0)
    s = jnp.clip((b * t - c) / a, 0.0, 1.0)
    return s, jnp.clip((b * s + f) / e, 0.0, 1.0)  # once more: exact where s was clipped last


def barrier(distance: Float[Array, " rows"], reach: Float[Array, " rows"]) -> Float[Array, " rows"]:
    """Return (r - d)^3 [m^3] for distances d from the reach r down to t = r / 3, then t^3 (12 log(t / d) + 8).

    It has two derivatives everywhere, and no finite value at no distance. So the logarithm of IPC holds what
    comes near, and a cubic, which is weaker at first touch, what rests.

    Source: Li et al. 2020, doi 10.1145/3386569.3392425, for the logarithm.
    """
    t = jnp.where(reach > 0, _BARRIER * reach, 1.0)
    is_low = distance < t
    low = t**3 * (12.0 * jnp.log(t / jnp.where(is_low, distance, t)) + 8.0)
    return jnp.where(is_low, low, jnp.maximum(reach - distance, 0.0) ** 3)


def row_energies(
    p: tuple[Vector3, ...], rows: Rows, is_edge: bool, *, is_frozen: bool = False
) -> Float[Array, " rows"]:
    """Return the energy of every pair over the stiffness [m^5]: its area times `barrier`.

    That of two edges fades where they become parallel, and their closest points jump (IPC).

    Args:
        p: Vertices of the pairs, by components [m].
        rows: Areas and reach.
        is_edge: The pairs are of two edges.
        is_frozen: See `closest`.
    """
    value = barrier(closest(p, is_edge, is_frozen=is_frozen).distance, rows.reach)
    if is_edge:
        normal = cross3(sub3(p[1], p[0]), sub3(p[3], p[2]))
        share = dot3(normal, normal) / jnp.where(rows.rest > 0, _PARALLEL * rows.rest, 1.0)
        value = value * jnp.where(share < 1, share * (2.0 - share), 1.0)
    return jnp.where(rows.areas > 0, rows.areas * value, 0.0)


def energies(x: Vector3, pairs: Pairs) -> tuple[Float[Array, " rows"], ...]:
    """Return the energies of all rows of both kinds over the stiffness [m^5], at vertices x by components [m]."""
    return tuple(row_energies(corners_of(x, rows.ids), rows, is_edge) for rows, is_edge in pairs.kinds)


@jax.custom_jvp
def energy_and_gradient(x: Vector3, pairs: Pairs) -> tuple[Float[Array, ""], Vector3]:
    """Return the sum of `energies` [m^5], and its gradient [m^4], over the rows in use alone.

    The rows have no derivative. That of the gradient is exact: it is taken over the whole table.
    """
    total, gradient = jnp.zeros((), x[0].dtype), tuple(jnp.zeros_like(part) for part in x)
    for kind, is_edge in pairs.kinds:

        def add(carry, rows: Rows, is_edge: bool = is_edge):
            total, gradient = carry

            def summed(p: tuple[Vector3, ...]) -> Array:
                return jnp.sum(row_energies(p, rows, is_edge, is_frozen=True))

            value, forces = jax.value_and_grad(summed)(corners_of(x, rows.ids))
            by_axis = zip(gradient, zip(*forces, strict=True), strict=True)
            return total + value, tuple(_added(part, rows, force) for part, force in by_axis)

        total, gradient = over_rows(kind, (total, gradient), add)
    return total, gradient  # type: ignore[return-value]


@energy_and_gradient.defjvp
def _energy_and_gradient_jvp(primals: tuple, tangents: tuple) -> tuple:
    x, pairs = primals

    def whole(x: Vector3) -> tuple[Array, Vector3]:
        return jax.value_and_grad(lambda x: sum(jnp.sum(rows) for rows in energies(x, pairs)))(x)

    return energy_and_gradient(x, pairs), jax.jvp(whole, (x,), tangents[:1])[1]


@jax.custom_jvp
def energy(x: Vector3, pairs: Pairs) -> Float[Array, ""]:
    """Return the sum of `energies` [m^5], over the rows in use alone; the rows have no derivative."""
    return energy_and_gradient(x, pairs)[0]


@energy.defjvp
def _energy_jvp(primals: tuple, tangents: tuple) -> tuple:
    total, gradient = energy_and_gradient(*primals)
    change = sum(jnp.sum(slope * move) for slope, move in zip(gradient, tangents[0], strict=True))
    return total, change


def diagonal(x: Vector3, pairs: Pairs) -> Float[Array, " vertices"]:
    """Return the curvature per vertex over the stiffness [m^3], a third of that along the offset."""
    total = jnp.zeros_like(x[0])
    for kind, is_edge in pairs.kinds:

        def add(total: Array, rows: Rows, is_edge: bool = is_edge) -> Array:
            near = closest(corners_of(x, rows.ids), is_edge)
            t = _BARRIER * rows.reach
            low = 12.0 * t**3 / jnp.square(jnp.maximum(near.distance, FLOOR))
            bend = jnp.where(near.distance < t, low, 6.0 * jnp.maximum(rows.reach - near.distance, 0.0))
            values = rows.areas * bend / 3.0
            return _added(total, rows, [w * w * values for w in near.weights])

        total = over_rows(kind, total, add)
    return total


def loads(
    x: Vector3, pairs: Pairs, is_load: Callable[[Rows], Bool[Array, " rows"]]
) -> Float[Array, " vertices"]:
    """Return the sum per vertex of the sizes of the forces of some rows, over the stiffness [m^4]."""
    total = jnp.zeros_like(x[0])
    for kind, is_edge in pairs.kinds:

        def add(total: Array, rows: Rows, is_edge: bool = is_edge) -> Array:
            near = closest(corners_of(x, rows.ids), is_edge)
            slope = jax.grad(lambda d: jnp.sum(barrier(d, rows.reach)))(near.distance)
            size = jnp.where(is_load(rows) & (rows.areas > 0), -rows.areas * slope, 0.0)
            return _added(total, rows, [jnp.abs(w) * size for w in near.weights])

        total = over_rows(kind, total, add)
    return total


def _added(total: Array, rows: Rows, values: Sequence[Array]) -> Array:
    """Return totals of vertices with values of the four corners of rows added.

    Corner by corner: XLA would compute what is joined in a loop that it can't vectorise.
    """
    for corner, value in zip(rows.ids, values, strict=True):
        total = total.at[corner].add(value)
    return total


def shares(x: Vector3, step: Vector3, pairs: Pairs, caution: float) -> Float[Array, " vertices"]:
    """Return the share of its step [m] that every vertex may take so that no pair crosses on the way.

    Across the closest points lies a plane between the two primitives. It divides the gap as they approach it.
    Who stays on his side crosses nobody, however far he slides. `caution` is the share of his room that a vertex
    may take.

    Source: the dividing planes of Newton's VBD solver (github.com/newton-physics/newton), taken here at every
    iterate.
    """
    least = jnp.ones_like(x[0])
    for kind, is_edge in pairs.kinds:

        def cut(least: Array, rows: Rows, is_edge: bool = is_edge) -> Array:
            p, move = corners_of(x, rows.ids), corners_of(step, rows.ids)
            near = closest(p, is_edge)
            normal = tuple(part / near.distance for part in near.offset)
            side = signs(is_edge)
            toward = [-sign * dot3(normal, m) for sign, m in zip(side, move, strict=True)]  # type: ignore[arg-type]
            # Heights over the closest point of the second primitive. Those of the first are d or more.
            height = [dot3(normal, sub3(corner, p[0])) for corner in p]  # type: ignore[arg-type]
            zero = sum(near.weights[k] * height[k] for k in range(4) if side[k] < 0)
            speeds = [
                _greatest([jnp.zeros_like(near.distance), *(toward[k] for k in range(4) if side[k] == sign)])
                for sign in (1, -1)
            ]
            both = speeds[0] + speeds[1]
            part = jnp.where(both > 0, speeds[1] / jnp.where(both > 0, both, 1.0), 0.5)
            plane = near.distance * jnp.clip(part, _LEAST_SHARE, 1.0 - _LEAST_SHARE)
            for k in range(4):
                room = caution * jnp.maximum(side[k] * (height[k] + zero - plane) - FLOOR, 0.0)
                is_cut = (rows.areas > 0) & (toward[k] > room)
                share = jnp.where(is_cut, room / jnp.where(is_cut, toward[k], 1.0), 1.0)
                least = least.at[rows.ids[k]].min(share)
            return least

        least = over_rows(kind, least, cut)
    return least


def least_gaps(x: Vector3, pairs: Pairs) -> Float[Array, " vertices"]:
    """Return the distance of the nearest pair that every vertex belongs to [m]; infinite without any."""
    least = jnp.full_like(x[0], jnp.inf)
    for kind, is_edge in pairs.kinds:

        def take(least: Array, rows: Rows, is_edge: bool = is_edge) -> Array:
            distance = closest(corners_of(x, rows.ids), is_edge).distance
            distance = jnp.where(rows.areas > 0, distance, jnp.inf)
            for corner in rows.ids:
                least = least.at[corner].min(distance)
            return least

        least = over_rows(kind, least, take)
    return least


def _greatest(values: Sequence[Array]) -> Array:
    return functools.reduce(jnp.maximum, values)


def mended(
    start: Vector3, end: Vector3, pairs: Pairs, is_free: Bool[Array, " vertices"], sweeps: int
) -> tuple[Vector3, Float[Array, ""]]:
    """Return ends of straight motions, pushed so that nothing crosses on the way, and what gap is lacking.

    A direction that separates two primitives at both ends of straight motions separates them all the way: the
    plane between them may move along. So only the end counts, and a body that carries cloth along costs no room.

    Args:
        start: Vertices before, by components [m]; no pair crosses.
        end: Vertices after.
        pairs: All that may come near.
        is_free: Vertices that may be pushed.
        sweeps: Bound of the number of sweeps.
    """
    movable = is_free.astype(start[0].dtype)

    def sweep(carry):
        end, _, number = carry
        moves, worst = jnp.zeros((start[0].shape[0], 4), start[0].dtype), jnp.zeros((), start[0].dtype)
        for kind, is_edge in pairs.kinds:

            def add(carry, rows: Rows, is_edge: bool = is_edge):
                moves, worst = carry
                lack, pushes = _pushes(start, end, movable, rows, is_edge)
                return moves.at[rows.ids.ravel()].add(pushes), jnp.maximum(worst, lack)

            moves, worst = over_rows(kind, (moves, worst), add)
        count = jnp.maximum(moves[:, 3], 1.0)
        pushed = tuple(part + moves[:, axis] / count for axis, part in enumerate(end))
        return pushed, worst, number + 1

    # The lack is of before the last push: one more sweep sees whether nothing is left.
    first = (end, jnp.full((), jnp.inf, start[0].dtype), jnp.int32(0))
    end, worst, _ = jax.lax.while_loop(lambda carry: (carry[1] > 0) & (carry[2] < sweeps), sweep, first)
    return end, worst


def _pushes(
    start: Vector3, end: Vector3, movable: Float[Array, " vertices"], rows: Rows, is_edge: bool
) -> tuple[Float[Array, ""], Float[Array, "entries 4"]]:
    """Return by how much pairs lack their gap at the end [m], and moves that mend it, with a count."""
    near = closest(corners_of(start, rows.ids), is_edge)
    normal = tuple(part / near.distance for part in near.offset)
    p, side = corners_of(end, rows.ids), signs(is_edge)
    free = [movable[row] for row in rows.ids]
    along = [dot3(normal, sub3(corner, p[0])) for corner in p]  # type: ignore[arg-type]
    first = [k for k in range(4) if side[k] > 0]
    second = [k for k in range(4) if side[k] < 0]
    least = jnp.minimum(along[first[0]], along[first[-1]])
    most = _greatest([along[k] for k in second])
    wanted = 0.5 * jnp.minimum(near.distance, 10.0 * FLOOR)
    can_first = jnp.maximum(free[first[0]], free[first[-1]]) > 0
    can_second = _greatest([free[k] for k in second]) > 0
    is_lacking = (rows.areas > 0) & (can_first | can_second) & (least - most < wanted)
    lack = jnp.where(is_lacking, wanted - (least - most), 0.0)
    middle = 0.5 * (least + most)
    upper = jnp.where(can_first & can_second, middle + 0.5 * wanted, most + wanted)
    lower = jnp.where(can_first & can_second, middle - 0.5 * wanted, least - wanted)
    entries = []
    for k in range(4):
        up = jnp.maximum(upper - along[k], 0.0) if side[k] > 0 else -jnp.maximum(along[k] - lower, 0.0)
        up = jnp.where(is_lacking & (free[k] > 0), _OVERSHOOT * up, 0.0)
        is_pushed = (up != 0).astype(up.dtype)
        entries.append(jnp.stack([normal[0] * up, normal[1] * up, normal[2] * up, is_pushed], axis=1))
    return jnp.max(lack), jnp.concatenate(entries)


_Carry = TypeVar("_Carry")


def over_rows(rows: Rows, start: _Carry, add: Callable[[_Carry, Rows], _Carry]) -> _Carry:
    """Return a start to which the rows in use are added, `CHUNK` at a time; those that fill up have no area."""

    def chunk(carry):
        first, value = carry
        ids, areas, reach, rest = (
            jax.lax.dynamic_slice_in_dim(leaf, first, CHUNK, axis=leaf.ndim - 1) for leaf in rows[:4]
        )
        is_used = first + jnp.arange(CHUNK, dtype=jnp.int32) < rows.count
        return first + CHUNK, add(value, Rows(ids, jnp.where(is_used, areas, 0.0), reach, rest, rows.count))

    return jax.lax.while_loop(lambda carry: carry[0] < rows.count, chunk, (jnp.int32(0), start))[1]
