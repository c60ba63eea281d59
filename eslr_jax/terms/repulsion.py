"""Repulsion: a one-sided barrier between layers of cloth, or between cloth and tips of the body.

It is cubic, but between layers linear once they have passed through each other. Two limbs that intersect force
the layers between them through each other, and no force can keep these layers apart. A force without a bound
grew to 100,000 times the weight of the cloth, and tore it.

Layers are vertices over faces and edges over edges (`LayerPairs`). Tips are vertices of the body over faces of
the cloth (`TipPairs`); they don't give way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.layer_edges import LayerPairs, layer_heights, with_edges
from eslr_jax.contact.self_contact import TipPairs, default_rows, find_self_contacts, starting_rows
from eslr_jax.errors import ConfigError
from eslr_jax.numerics import (
    Vector3,
    components,
    cross3,
    dot3,
    in_memory,
    safe_normalize,
    segment_sum,
    sub3,
    take3,
)
from eslr_jax.terms.problem import (
    CONTACT_STIFFNESS,
    STIFFNESS_RANGE,
    THICKNESS_RANGE,
    FrameProblem,
    contact_thickness,
)
from eslr_jax.terms.stretch import contact_excess
from eslr_jax.terms.term import Elements, Term
from eslr_jax.terms.worn import Worn
from eslr_jax.types import Garment

Pairs = LayerPairs | TipPairs
_HEADROOM = 1.25  # of a buffer made larger: later frames may need more
# Sizes of buffers from one to twice as large: few, since each is compiled, and close, since every row costs time.
_SIZES = 4
_SWEEPS = 4  # of `push_apart`


class LayerContact(NamedTuple):
    """Contact between layers of the cloth during a frame."""

    pairs: LayerPairs
    stiffness: Float[Array, ""]  # [J/m^5]
    thickness: Float[Array, " pairs"]  # distance kept [m]
    limit: Float[Array, ""]  # overlap beyond which the force grows no further [m]


@struct.dataclass
class Repulsion(Term):
    """Layers of cloth keep apart.

    A piece is a connected component of the mesh. "pieces" keeps different pieces apart that come close to each
    other; "folds" also a garment of one piece off itself, if it can meet itself; "all" keeps all cloth apart.
    """

    name = "repulsion"
    unless_needed = "no layers that can meet"
    ranges = MappingProxyType({"stiffness": STIFFNESS_RANGE, "thickness": THICKNESS_RANGE})

    stiffness: Float[Array, ""] | float = CONTACT_STIFFNESS  # [J/m^5]
    thickness: Float[Array, ""] | float = 3e-3  # [m] (ContourCraft)
    where: Literal["pieces", "folds", "all"] = struct.field(pytree_node=False, default="pieces")
    # Rows for pairs of a vertex and a face; None: to be planned. `simulate` enlarges them where they are too few.
    num_rows: int | None = struct.field(pytree_node=False, default=None)
    pieces: Int[Array, " vertices"] | None = None  # of every vertex, where only different ones keep apart

    def check(self) -> None:
        """Check its constants and choices (host)."""
        super().check()
        if self.where not in ("pieces", "folds", "all"):
            raise ConfigError(f"repulsion where = {self.where!r}; give one of pieces, folds, all")
        if self.num_rows is not None and self.num_rows < 1:
            raise ConfigError(f"a buffer for {self.num_rows} pairs: give one row or more")

    def plan(self, worn: Worn, others: Sequence[Term]) -> Repulsion | None:
        """Return repulsion with a small buffer, or None where no layers can meet.

        The buffer starts small because `simulate` enlarges it. A pure `rollout` can't: give
        it `num_rows`, or check the status of the trajectory.
        """
        is_one_piece, pieces = worn.num_pieces == 1, None
        if is_one_piece and self.where == "pieces":
            return None
        if self.where != "all":
            if not (worn.meets_itself() if is_one_piece else worn.pieces_meet()):
                return None
            pieces = None if is_one_piece else jnp.asarray(worn.pieces)
        rows = starting_rows(len(worn.pieces), worn.num_pieces) if self.num_rows is None else self.num_rows
        return self.replace(num_rows=rows, pieces=pieces)

    def alike(self, worn: Worn, planned: Sequence[Any]) -> Repulsion:
        """Return repulsion with the largest of the buffers; of different pieces only if all scenes have it so."""
        has_pieces = all(one.pieces is not None for one in planned)
        rows = max(one.num_rows or 0 for one in planned)
        return self.replace(num_rows=rows, pieces=jnp.asarray(worn.pieces) if has_pieces else None)

    def prepare(self, problem: FrameProblem) -> LayerContact:
        """Return the pairs of a frame.

        A vertex on the wrong side of a face is pushed back by one contact thickness a frame. Pushed back within
        one frame, from centimetres deep, it tore the cloth: neighbouring pairs with opposite sides pulled with
        thousands of times the weight.
        """
        cloth, garment = (problem.position, problem.inertial_guess), problem.garment
        rows = default_rows(len(problem.position)) if self.num_rows is None else self.num_rows
        pairs = with_edges(*cloth, find_self_contacts(*cloth, garment, rows, pieces=self.pieces), garment)
        thickness = contact_thickness(garment, self.thickness)
        height, _ = pair_heights(problem.position, pairs)
        stiffness = self.stiffness * contact_excess(problem.material)
        return LayerContact(pairs, stiffness, thickness + jnp.minimum(height, 0.0), limit=thickness)

    def elements(self, x: Vector3, problem: FrameProblem, data: LayerContact) -> tuple[Elements, ...]:
        """Return the energy of every pair [J]; see `repulsion_energies`."""
        return (Elements(repulsion_energies(x, *data), data.pairs.corners),)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: LayerContact) -> Float[Array, " vertices"]:
        """Return an estimate of the curvature [N/m]; see `repulsion_diagonal`."""
        return repulsion_diagonal(x, *data)

    def separate(
        self, position: Float[Array, "vertices 3"], problem: FrameProblem, data: LayerContact
    ) -> Float[Array, "vertices 3"]:
        """Return positions [m] with layers pushed apart."""
        return push_apart(position, data.pairs, data.thickness)

    def status(self, problem: FrameProblem, data: LayerContact) -> Int[Array, ""]:
        """Return whether the buffer was too small."""
        return data.pairs.status

    def demand(self, data: LayerContact) -> Int[Array, ""]:
        """Return the number of pairs found."""
        return data.pairs.count

    def enlarged(self, demand: int) -> Repulsion | None:
        """Return repulsion with room for so many pairs and a quarter more; None where they have room.

        Sizes are rounded up: each is compiled anew, and scenes of one shape share a few of them.
        """
        if self.num_rows is None or demand <= self.num_rows:
            return None
        steps = math.ceil(_SIZES * math.log2(_HEADROOM * demand / self.num_rows))
        return self.replace(num_rows=round(self.num_rows * 2 ** (steps / _SIZES)))

    def describe(self, garment: Garment) -> str:
        """Return what touches what."""
        return "layers of cloth"


def pair_heights(
    position: Float[Array, "vertices 3"] | Vector3,
    pairs: Pairs,
) -> tuple[Float[Array, " pairs"], Vector3]:
    """Return the height d of every pair's first place over its second one [m], and the direction of that height.

    For a tip x_p, d = side (x_p + sum_k w_k x_k) . n with the face's unit normal n at `position`; for layers see
    `layer_heights`. An energy of d does not change when the cloth turns, so the forces between layers have no
    resultant and no moment. Unused rows give zero.
    """
    x = components(position)
    if isinstance(pairs, LayerPairs):
        return layer_heights(x, pairs)
    point, places = components(pairs.next_points), take3(x, pairs.corners.T)
    corners = [tuple(c[k] for c in places) for k in range(3)]
    weights = [pairs.weights[:, k] for k in range(3)]
    offset = tuple(point[axis] + sum(weights[k] * corners[k][axis] for k in range(3)) for axis in range(3))
    normal = cross3(sub3(corners[1], corners[0]), sub3(corners[2], corners[0]))  # type: ignore[arg-type]
    unit = safe_normalize(jnp.stack(normal, axis=0), axis=0)
    direction = (pairs.side * unit[0], pairs.side * unit[1], pairs.side * unit[2])
    return dot3(offset, direction), direction  # type: ignore[arg-type]


def overlaps(
    position: Float[Array, "vertices 3"] | Vector3,
    pairs: Pairs,
    thickness: Float[Array, " pairs"] | Float[Array, ""] | float,
) -> Float[Array, " pairs"]:
    """Return max(thickness - d, 0) per pair [m]; zero where a row is not used."""
    height, _ = pair_heights(position, pairs)
    return jnp.where(pairs.side != 0, jnp.maximum(thickness - height, 0.0), 0.0)


def repulsion_energies(
    position: Float[Array, "vertices 3"] | Vector3,
    pairs: Pairs,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, " pairs"] | Float[Array, ""] | float,
    limit: Float[Array, ""] | float | None = None,
) -> Float[Array, " pairs"]:
    """Return stiffness a_p f(max(thickness - d, 0)) of every pair [J]; f(x) = x^3, and linear beyond the limit.

    Args:
        position: Cloth vertices at t + 1 [m].
        pairs: Places that are close at t, with the areas a_p.
        stiffness: [J/m^5].
        thickness: Distance kept [m].
        limit: Overlap beyond which the force grows no further [m]; None: it always grows.

    Source: ContourCraft (arXiv 2405.09522), its repulsion loss, with areas in place of its count of vertices
        and the nearest place on the face in place of a corner.
    """
    depth = overlaps(position, pairs, thickness)
    (areas,) = in_memory(stiffness * pairs.areas)
    barrier = areas * depth * depth * depth
    if limit is not None:
        linear = areas * limit * limit * (3.0 * depth - 2.0 * limit)
        barrier = jnp.where(depth < limit, barrier, linear)
    return barrier


def repulsion_diagonal(
    position: Float[Array, "vertices 3"] | Vector3,
    pairs: Pairs,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, " pairs"] | Float[Array, ""] | float,
    limit: Float[Array, ""] | float | None = None,
) -> Float[Array, " vertices"]:
    """Return an estimate of the energy's curvature per vertex [N/m], a third of that along the normal.

    Beyond the limit, where the energy has none, it is that at the limit.
    """
    depth = overlaps(position, pairs, thickness)
    if limit is not None:
        depth = jnp.minimum(depth, limit)
    curvature = 2.0 * stiffness * pairs.areas * depth
    weights = pairs.weights.T
    num_vertices = components(position)[0].shape[0]
    return segment_sum((weights**2 * curvature[None]).ravel(), pairs.corners.T.ravel(), num_vertices)


def push_apart(
    position: Float[Array, "vertices 3"],
    pairs: Pairs,
    thickness: Float[Array, " pairs"] | Float[Array, ""] | float,
) -> Float[Array, "vertices 3"]:
    """Move overlapping pairs apart, a few times: layers by half the overlap each, cloth off a tip by all of it.

    Like pushing cloth out of the body, this saves the slow first iterations that the barrier would take. A vertex
    of several pairs moves by the mean of their moves.
    """
    num_vertices = position.shape[0]
    share = 0.5 if isinstance(pairs, LayerPairs) else 1.0
    ids, weights = pairs.corners.T, pairs.weights.T
    # A place moves by one if corner k of it moves by w_k / |w|^2. The sign of a weight doesn't say whose it is:
    # rounding makes some of a face's a little negative.
    is_first = _are_first(pairs)
    first, second = (jnp.sum(jnp.where(own, weights**2, 0.0), axis=0) for own in (is_first, ~is_first))
    size = jnp.where(is_first, first, second)
    scale = share * weights / jnp.where(size > 0, size, 1.0)

    def sweep(_, position: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        height, direction = pair_heights(position, pairs)
        depth = jnp.where(pairs.side != 0, jnp.maximum(thickness - height, 0.0), 0.0)
        touched = ((weights != 0) & (depth > 0)[None]).astype(position.dtype)
        lift = depth[:, None] * jnp.stack(direction, axis=-1)
        moves = jnp.concatenate([scale[:, :, None] * lift[None], touched[:, :, None]], axis=2)
        moved = segment_sum(moves.reshape(-1, 4), ids.ravel(), num_vertices)
        return position + moved[:, :3] / jnp.maximum(moved[:, 3:], 1.0)

    return jax.lax.fori_loop(0, _SWEEPS, sweep, position)  # a loop: unrolled, every sweep is compiled anew


def _are_first(pairs: Pairs) -> Bool[Array, "corners pairs"]:
    """Return which corners belong to the first place of their pair; none where that is a tip of the body."""
    if isinstance(pairs, LayerPairs):
        is_edge = pairs.is_edge
        return jnp.stack([jnp.ones_like(is_edge), is_edge, jnp.zeros_like(is_edge), jnp.zeros_like(is_edge)])
    return jnp.zeros(pairs.corners.T.shape, bool)
