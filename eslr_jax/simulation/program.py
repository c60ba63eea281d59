"""Programs that a thread compiles while the host prepares what they will run on."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache, partial
from typing import Any

import jax

from eslr_jax.config import SimConfig

_compiler = ThreadPoolExecutor(1)
# Programs that are kept. One with self-contact takes 2,700 of the 65,530 memory maps that Linux gives a process;
# of 32 kept ones, a batch of scenes ended in "LLVM compilation error: Cannot allocate memory".
_KEPT = 12


def begin_program(function: Callable, config: SimConfig, arguments: tuple) -> None:
    """Trace a function here, and begin to compile it in a thread; `find_program` waits for it.

    Args:
        function: A pure function of arrays and of the keyword `config`.
        config: Static.
        arguments: Arrays, or their shapes, of `jax.eval_shape`.
    """
    _compile(function, config, *_signature(arguments))


def find_program(function: Callable, config: SimConfig, arguments: tuple) -> Callable:
    """Return the compiled function for arguments of these shapes; compile it if nobody has begun to."""
    return _compile(function, config, *_signature(arguments)).result()


def _signature(arguments: tuple) -> tuple[Any, tuple]:
    """Return the structure of arguments, and shapes and types of their arrays."""
    leaves, structure = jax.tree.flatten(arguments)
    return structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)


@lru_cache(maxsize=_KEPT)
def _compile(function: Callable, config: SimConfig, structure: Any, shapes: tuple) -> Future[Callable]:
    """Begin to compile a function, once for every configuration and every set of shapes.

    It is traced here, where JAX's settings of this thread hold.
    """
    described = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes]
    lowered = jax.jit(partial(function, config=config)).lower(*jax.tree.unflatten(structure, described))
    return _compiler.submit(lowered.compile)
