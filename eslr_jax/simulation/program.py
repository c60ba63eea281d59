"""Programs that are traced once for all runs, and compiled while the host prepares what they will run on.

To trace and lower a rollout takes five seconds, as long as a hundred of its frames. So where JAX keeps compiled
programs (`jax_compilation_cache_dir`), traced ones are kept beside them, in the portable form of `jax.export`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import jax
from jax import export

from eslr_jax.files.atomic import atomic_write
from eslr_jax.files.kept import path_of, source_hash, write_kept

_compiler = ThreadPoolExecutor(1)
# Programs that are kept in memory. One with self-contact takes 2,700 of the 65,530 memory maps that Linux gives a
# process; of 32 kept ones, a batch of scenes ended in "LLVM compilation error: Cannot allocate memory".
_KEPT = 12
_KEPT_TRACES = 200  # files, of half a megabyte at most; those that were not used for longest go first
# XLA's options on a CPU for what runs once: a scene's start at 1k compiles in 5.5 in place of 14.5 s of processor
# time, and takes 0.14 in place of 0.04 s.
_BRIEF = (("xla_backend_optimization_level", 0), ("xla_cpu_use_fusion_emitters", False))
_SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision", "jax_debug_nans")  # what a trace depends on


class Program:
    """A traced function. It is compiled in a thread where that is begun, else when it is first waited for."""

    def __init__(self, lowered: jax.stages.Lowered, results: Any, options: tuple):
        self.results = results
        """Shapes of what it returns."""
        self._lowered = lowered
        self._options = dict(options)
        self._compiled: Future[jax.stages.Compiled] | None = None

    def begin(self) -> None:
        """Begin to compile it in a thread."""
        if self._compiled is None:
            self._compiled = _compiler.submit(self._compile)

    def wait(self) -> Program:
        """Return it when it is compiled."""
        if self._compiled is None:
            compiled: Future[jax.stages.Compiled] = Future()
            compiled.set_result(self._compile())  # it may be interrupted
            self._compiled = compiled
        self._compiled.result()
        return self

    def _compile(self) -> jax.stages.Compiled:
        with contextlib.suppress(jax.errors.JaxRuntimeError):  # of a release that does not know an option
            return self._lowered.compile(self._options)
        return self._lowered.compile()

    def __call__(self, *arguments: Any) -> Any:
        """Return the function's results for arrays of its shapes."""
        assert self._compiled is not None
        leaves = self._compiled.result()(*jax.tree.leaves(arguments))
        return jax.tree.unflatten(jax.tree.structure(self.results), leaves)


def find_program(function: Callable, arguments: tuple, *, is_brief: bool = False, **static: Any) -> Program:
    """Return the program of a function for arguments of these shapes.

    It is traced here, where JAX's settings of this thread hold.

    Args:
        function: A pure function of arrays and of static keywords.
        arguments: Arrays, or their shapes, of `jax.eval_shape`.
        is_brief: It runs once, so that it may rather run slowly than compile slowly.
        static: Its keywords; they can be hashed.
    """
    leaves, structure = jax.tree.flatten(arguments)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    settings = tuple(getattr(jax.config, name) for name in _SETTINGS)
    options = _BRIEF if is_brief and jax.default_backend() == "cpu" else ()
    return _program(function, structure, shapes, tuple(sorted(static.items())), settings, options)


@lru_cache(maxsize=_KEPT)
def _program(
    function: Callable, structure: Any, shapes: tuple, static: tuple, settings: tuple, options: tuple
) -> Program:
    described = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes]
    seen = []

    def flat(*leaves: Any) -> list:
        results = function(*jax.tree.unflatten(structure, leaves), **dict(static))
        seen.append(jax.tree.structure(results))
        return jax.tree.leaves(results)

    version = settings, jax.__version__, jax.default_backend()
    key = repr((function.__module__, function.__qualname__, structure, shapes, static, version))
    name = hashlib.sha256(source_hash() + key.encode()).hexdigest()
    path = path_of("traced", f"{name}.pickle")
    if path is None or not all(map(_is_known, (function, structure, static))):
        lowered = jax.jit(flat).lower(*described)
        return Program(lowered, jax.tree.unflatten(seen[-1], lowered.out_info), options)
    with contextlib.suppress(Exception):  # missing or damaged: it is traced again
        found, module = pickle.loads(path.read_bytes())  # of the folder from which JAX loads machine code
        exported = export.deserialize(module)
        os.utime(path)
        seen.append(found)
    if not seen:
        exported = export.export(jax.jit(flat))(*described)
        content = pickle.dumps((seen[-1], exported.serialize()))
        write_kept(path, partial(_write, content), _KEPT_TRACES)
    shapes_out = [jax.ShapeDtypeStruct(out.shape, out.dtype) for out in exported.out_avals]
    lowered = jax.jit(exported.call).lower(*described)
    return Program(lowered, jax.tree.unflatten(seen[-1], shapes_out), options)


def _write(content: bytes, path: Path) -> None:
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _is_known(part: Any) -> bool:
    """Return whether a part of a program's description is the package's own, whose source is hashed."""
    if isinstance(part, jax.tree_util.PyTreeDef):
        node = part.node_data()
        return node is None or (all(map(_is_known, node)) and all(map(_is_known, part.children())))
    if isinstance(part, (tuple, list)):
        return all(map(_is_known, part))
    if isinstance(part, dict):
        return all(map(_is_known, part.items()))
    owner = part.__module__ if isinstance(part, type) or callable(part) else type(part).__module__
    return owner.split(".")[0] in ("builtins", __name__.split(".")[0])
