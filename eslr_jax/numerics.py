"""Numerical primitives with safe gradients; the only caller of `jax.ops`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Bool, Float, Int

_DTYPES = {"f": np.float32, "i": np.int32, "u": np.int32, "b": np.bool_}  # by kind


def to_device(tree: Any) -> Any:
    """Return a tree of arrays and numbers with float32, int32 and bool JAX leaves (host).

    NumPy converts them: `jnp.asarray` would compile a program for every shape, 34 ms each.
    """
    return jax.device_put(jax.tree.map(_converted, tree))


def _converted(leaf: ArrayLike) -> np.ndarray:
    array = np.asarray(leaf)
    return array.astype(_DTYPES[array.dtype.kind], copy=False)


def as_partial(function: Callable) -> Partial:
    """Return a function as a pytree; what a Partial binds stays traced."""
    return function if isinstance(function, Partial) else Partial(function)


def safe_norm(x: Float[Array, ...], axis: int = -1, keepdims: bool = False) -> Float[Array, ...]:
    """Return the Euclidean norm along an axis, with a zero (not NaN) gradient at zero."""
    return safe_sqrt(jnp.sum(x * x, axis=axis, keepdims=keepdims))


def safe_sqrt(x: Float[Array, ...]) -> Float[Array, ...]:
    """Return the square root, and zero with a zero gradient where `x` is not positive."""
    is_positive = ~(x <= 0)  # NaN stays NaN
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, x, 1.0)), 0.0)


def safe_normalize(x: Float[Array, ...]) -> Float[Array, ...]:
    """Return unit vectors; a zero vector stays zero and has a zero gradient."""
    parts = jnp.split(x, x.shape[-1], axis=-1)  # added one by one: a sum is a kernel of its own on a CPU
    squared = sum(part * part for part in parts)
    is_zero = squared == 0
    return jnp.where(is_zero, 0.0, x * jax.lax.rsqrt(jnp.where(is_zero, 1.0, squared)))


def sum_products(subscripts: str, left: Float[Array, ...], right: Float[Array, ...]) -> Float[Array, ...]:
    """Return jnp.einsum with all bits of its arguments; a GPU rounds those of float32 to ten by default.

    Positions of metres would be off by half a millimetre.
    """
    return jnp.einsum(subscripts, left, right, precision=jax.lax.Precision.HIGHEST)


def product(left: Float[Array, ...], right: Float[Array, ...]) -> Float[Array, ...]:
    """Return left @ right with all bits of its arguments; see `sum_products`."""
    return jnp.matmul(left, right, precision=jax.lax.Precision.HIGHEST)


def masked_sum(x: Float[Array, "rows ..."], mask: Bool[Array, " rows"]) -> Float[Array, ...]:
    """Sum the rows of `x` where `mask` holds; masked rows may be anything, also NaN."""
    mask = mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim))
    return jnp.sum(jnp.where(mask, x, 0), axis=0)


def true_rows(mask: Bool[Array, " rows"], capacity: int) -> tuple[Int[Array, " capacity"], Int[Array, ""]]:
    """Return the first `capacity` rows where `mask` holds (the rest is past the end), and how many hold.

    A binary search in the running count: `jnp.nonzero` scatters, one element at a time on a CPU.
    """
    running = jnp.cumsum(mask, dtype=jnp.int32)
    rows = jnp.searchsorted(running, jnp.arange(1, capacity + 1, dtype=jnp.int32), side="left")
    return rows, running[-1]


class TrueEntries(NamedTuple):
    """The true entries of a matrix in order, each to be found by its number."""

    words: Int[Array, " words"]  # 32 columns each, the first in the lowest bit, row after row
    running: Int[Array, " words"]  # true entries up to the end of every word
    words_per_row: int

    @property
    def count(self) -> Int[Array, ""]:
        """Number of true entries."""
        return self.running[-1]

    def find(self, number: Int[Array, " entries"]) -> tuple[Int[Array, " entries"], Int[Array, " entries"]]:
        """Return row and column of the entries with these numbers; of some entry where there is none."""
        word = jnp.searchsorted(self.running, number, side="right")
        word = jnp.minimum(word, self.running.shape[0] - 1).astype(jnp.int32)
        bits = self.words[word].astype(jnp.uint32)
        left = number - self.running[word] + jax.lax.population_count(bits).astype(jnp.int32)
        bit = jnp.zeros_like(word)
        # Halve the span again and again.
        for width in (16, 8, 4, 2, 1):
            low = jax.lax.population_count(bits & jnp.uint32((1 << width) - 1)).astype(jnp.int32)
            is_higher = left >= low
            left = jnp.where(is_higher, left - low, left)
            bits = jnp.where(is_higher, bits >> jnp.uint32(width), bits)
            bit = bit + jnp.where(is_higher, width, 0)
        return word // self.words_per_row, 32 * (word % self.words_per_row) + bit


def true_entries(mask: Bool[Array, "rows columns"]) -> TrueEntries:
    """Return the true entries of a matrix, to be found by number without a list of them all."""
    padded = jnp.pad(mask, ((0, 0), (0, -mask.shape[1] % 32))).reshape(mask.shape[0], -1, 32)
    bits = jnp.left_shift(jnp.uint32(1), jnp.arange(32, dtype=jnp.uint32))
    words = jnp.sum(jnp.where(padded, bits[None, None], jnp.uint32(0)), axis=2, dtype=jnp.uint32)
    return entries_of_words(words.astype(jnp.int32))


def entries_where(
    is_true: Callable[[Int[Array, " words"]], Bool[Array, "words rows"]], num_rows: int, num_columns: int
) -> TrueEntries:
    """Return the true entries of a matrix, given by a function of some of its columns.

    The matrix itself is never in memory: for boxes that meet this takes a quarter of the time.
    """
    first = jnp.arange(0, num_columns, 32, dtype=jnp.int32)

    def add_columns(k: Array, words: Int[Array, "words rows"]) -> Int[Array, "words rows"]:
        column = first + k
        mask = is_true(jnp.minimum(column, num_columns - 1)) & (column < num_columns)[:, None]
        return words | jnp.where(mask, jnp.left_shift(jnp.int32(1), k), 0)

    # Rows last: XLA vectorises the longer of the two axes.
    words = jax.lax.fori_loop(0, 32, add_columns, jnp.zeros((len(first), num_rows), jnp.int32))
    return entries_of_words(words.T)


def entries_of_words(words: Int[Array, "rows words"]) -> TrueEntries:
    """Return the true entries of a matrix that is given by its bits, 32 columns a word."""
    flat = words.ravel()
    return TrueEntries(flat, jnp.cumsum(jax.lax.population_count(flat), dtype=jnp.int32), words.shape[1])


def segment_sum(
    data: Float[Array, "rows ..."],
    segment_ids: Int[Array, " rows"],
    num_segments: int,
    *,
    is_sorted: bool = False,
) -> Float[Array, "segments ..."]:
    """Sum rows of `data` that share a segment."""
    return jax.ops.segment_sum(data, segment_ids, num_segments, indices_are_sorted=is_sorted)


Vector3 = tuple[Array, Array, Array]
"""Component arrays x, y, z of many vectors: on a CPU XLA vectorises these, but not a trailing axis of three."""


_Component = TypeVar("_Component", Array, np.ndarray)  # NumPy's on the host, in float64
_Vector = tuple[_Component, _Component, _Component]


def dot3(a: _Vector[_Component], b: _Vector[_Component]) -> _Component:
    """Return the dot products of vectors given by components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross3(a: _Vector[_Component], b: _Vector[_Component]) -> _Vector[_Component]:
    """Return the cross products of vectors given by components."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def sub3(a: _Vector[_Component], b: _Vector[_Component]) -> _Vector[_Component]:
    """Return the differences of vectors given by components."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def pierces(
    start: _Vector[_Component], end: _Vector[_Component], triangle: Sequence[_Vector[_Component]]
) -> _Component:
    """Return which segments pass through which triangles, given by their ends and their three corners.

    One that only touches the plane does not.
    """
    a, b, c = triangle
    normal = cross3(sub3(b, a), sub3(c, a))
    before, after = dot3(sub3(start, a), normal), dot3(sub3(end, a), normal)
    is_inside = before * after < 0
    span = before - after
    share = before / (span + (span == 0).astype(span.dtype))
    x, y, z = (u + share * (v - u) for u, v in zip(start, end, strict=True))
    for first, second in ((a, b), (b, c), (c, a)):
        inwards = dot3(cross3(sub3(second, first), sub3((x, y, z), first)), normal)
        is_inside = is_inside & (inwards >= 0)
    return is_inside


def components(x: Float[Array, "rows 3"] | Vector3) -> Vector3:
    """Split vectors into component arrays; vectors given by components stay as they are."""
    if isinstance(x, tuple):
        return x
    # The transpose of a split joins; that of slices pads every component to the whole and adds.
    x_part, y_part, z_part = jax.lax.split(x, (1, 1, 1), axis=1)
    return x_part[:, 0], y_part[:, 0], z_part[:, 0]


def in_memory(*arrays: Float[ArrayLike, ...]) -> tuple[Array, ...]:
    """Return the arrays, JAX's or NumPy's, each computed once and stored before it is read.

    Use it for coefficients that contain a scalar of the scene. XLA does not vectorise a loop on a CPU that reads
    a scalar from memory; such loops took four fifths of an energy's time. It also keeps XLA from computing a
    gather again in each of its consumers.
    """
    return jax.lax.optimization_barrier(tuple(jnp.asarray(array) for array in arrays))


def gather_corners(
    x: Float[Array, "rows 3"] | Vector3,
    indices: Int[Array, "items corners"],
    incidence: Int[Array, "rows degree"],
) -> tuple[Vector3, ...]:
    """Return the corner positions of every item, by components.

    Its transpose sums each row's incoming values through a fixed-degree table instead of scattering them: XLA's
    scatter on a CPU adds one element at a time, and its order is open on a GPU.

    Args:
        x: Vertex positions, shape [rows, 3].
        indices: Vertex of every corner of every item (a face or a hinge), shape [items, corners].
        incidence: For each vertex the flat positions in `indices.T` that name it, padded with
            `indices.size` (one past the end), shape [rows, degree].

    Returns:
        For each corner the x, y and z arrays, each of shape [items].
    """
    flat = indices.T.ravel()
    gathered = [_gather_flat.bind(component, flat, incidence) for component in components(x)]
    parts = [jax.lax.split(component, indices.shape[:1] * indices.shape[1]) for component in gathered]
    return tuple(zip(*parts, strict=True))  # type: ignore[return-value]


def gather_values(
    x: Float[Array, " rows"], indices: Int[Array, "items corners"], incidence: Int[Array, "rows degree"]
) -> tuple[Float[Array, " items"], ...]:
    """Return one number of every corner of every item, corner by corner; see `gather_corners`."""
    gathered = _gather_flat.bind(x, indices.T.ravel(), incidence)
    return tuple(jax.lax.split(gathered, indices.shape[:1] * indices.shape[1]))


# Two linear maps, each the other's transpose, as primitives of JAX. A `custom_vjp` would rule out forward mode,
# and a second derivative would leave it behind.
_gather_flat = Primitive("gather_flat")
_sum_flat = Primitive("sum_flat")


def _gather_flat_impl(x, flat, incidence):
    """Return x[flat]."""
    return x[flat]


def _sum_flat_impl(values, flat, incidence):
    """Return for every row the sum of the values whose flat position its table names."""
    padded = jnp.concatenate([values, jnp.zeros(1, values.dtype)])
    return sum(padded[incidence[:, k]] for k in range(incidence.shape[1]))


def _define(primitive: Primitive, transposed: Primitive, impl, length) -> None:
    """Give a primitive its rules; only its first argument is real.

    Args:
        primitive: To be defined.
        transposed: Its transpose.
        impl: What it computes, in other primitives.
        length: From the integer arguments to the length of the result.
    """
    primitive.def_impl(jax.jit(impl))
    primitive.def_abstract_eval(
        lambda x, flat, incidence: jax.core.ShapedArray((length(flat, incidence),), x.dtype)
    )
    mlir.register_lowering(primitive, mlir.lower_fun(impl, multiple_results=False))

    def differentiate(primals, tangents):
        x_dot, flat, incidence = tangents[0], *primals[1:]
        if isinstance(x_dot, ad.Zero):
            x_dot = ad.instantiate_zeros(x_dot)
        return primitive.bind(*primals), primitive.bind(x_dot, flat, incidence)

    def transpose(cotangent, x, flat, incidence):
        if isinstance(cotangent, ad.Zero):
            return ad.Zero(x.aval), None, None
        return transposed.bind(cotangent, flat, incidence), None, None

    def batch(arguments, axes):
        return jax.vmap(impl, in_axes=axes)(*arguments), 0

    ad.primitive_jvps[primitive] = differentiate
    ad.primitive_transposes[primitive] = transpose
    batching.primitive_batchers[primitive] = batch


_define(_gather_flat, _sum_flat, _gather_flat_impl, lambda flat, incidence: flat.shape[0])
_define(_sum_flat, _gather_flat, _sum_flat_impl, lambda flat, incidence: incidence.shape[0])


def scatter_corners(
    values: Float[Array, "items corners"], incidence: Int[Array, "rows degree"]
) -> Float[Array, " rows"]:
    """Sum over every row the values of the corners that name it; the transpose of `gather_corners`."""
    return _sum_flat_impl(values.T.ravel(), None, incidence)


def sum_incident(
    values: Float[Array, "items features"], incidence: Int[Array, "rows degree"], *, corners: int
) -> Float[Array, "rows features"]:
    """Sum over every row the values of the items that name it, each with so many corners.

    For `incidence` see `gather_corners`.
    """
    items = _incident_items(incidence, values.shape[0], corners=corners)
    padded = jnp.concatenate([values, jnp.zeros((1, *values.shape[1:]), values.dtype)])
    return sum(padded[items[:, k]] for k in range(items.shape[1]))  # type: ignore[return-value]


def _incident_items(
    incidence: Int[Array, "rows degree"], num_items: int, *, corners: int
) -> Int[Array, "rows degree"]:
    """Return the items around every row, padded with their number."""
    return jnp.where(incidence < corners * num_items, incidence % max(num_items, 1), num_items)


def vertex_normals(
    positions: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    incidence: Int[Array, "vertices degree"],
) -> Float[Array, "vertices 3"]:
    """Return unit normals weighted by the areas of the incident faces; zero where there is none.

    Faces are counter-clockwise seen from outside; for `incidence` see `gather_corners`.
    """
    a, b, c = gather_corners(positions, faces, incidence)
    normals = jnp.stack(cross3(sub3(b, a), sub3(c, a)))
    padded = jnp.pad(normals, ((0, 0), (0, 1)))
    around = _incident_items(incidence, faces.shape[0], corners=3)
    return safe_normalize(jnp.sum(padded[:, around.T], axis=1).T)


@jax.custom_jvp
def arctan2(y: Float[Array, ...], x: Float[Array, ...]) -> Float[Array, ...]:
    """Return the angle of (x, y), with a zero gradient at the origin.

    In float32 a polynomial within 2 ulp replaces the library call, which XLA does not vectorise on a CPU
    (it took half the time of the bending energy); float64 calls the library.
    """
    if y.dtype != jnp.float32:
        return jnp.arctan2(y, x)
    absolute_x, absolute_y = jnp.abs(x), jnp.abs(y)
    larger = jnp.maximum(absolute_x, absolute_y)
    ratio = jnp.minimum(absolute_x, absolute_y) / jnp.where(larger == 0, 1.0, larger)
    squared = ratio * ratio
    angle = jnp.zeros_like(ratio)
    for coefficient in _ARCTAN_COEFFICIENTS[::-1]:
        angle = angle * squared + coefficient
    angle = angle * ratio
    angle = jnp.where(absolute_y > absolute_x, jnp.float32(jnp.pi / 2) - angle, angle)
    angle = jnp.where(x < 0, jnp.float32(jnp.pi) - angle, angle)
    return jnp.where(y < 0, -angle, angle)


# arctan(t) / t in powers of t^2 on [0, 1]: least squares at 4000 Chebyshev nodes, error 7e-9.
_ARCTAN_COEFFICIENTS = (
    0.9999998712,
    -0.33332524,
    0.1998488469,
    -0.1415480604,
    0.104775392,
    -0.07194384542,
    0.03934541315,
    -0.01415234803,
    0.002398139012,
)


@arctan2.defjvp
def _arctan2_jvp(primals, tangents):
    y, x = primals
    y_dot, x_dot = tangents
    squared = x * x + y * y
    inverse = jnp.where(squared == 0, 0.0, 1.0 / jnp.where(squared == 0, 1.0, squared))
    return arctan2(y, x), (x * y_dot - y * x_dot) * inverse
