"""Compiler options of small runs, which spend their time in the compiler: tests, and scripts with --smoke."""

import os

import jax

# Without optimisation a rollout compiles in a third of the time; the pass takes a part of what is left. With
# while-loop-invariant-code-motion off beside it, jaxlib 0.10 computes falling cloth wrongly: see tried.md.
_FLAGS = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_disable_hlo_passes=simplify-while-loops"
)


def compile_fast() -> None:
    """Compile fast from here on, in this process and those that it starts; call this before JAX compiles."""
    if jax.__version__.startswith("0.10."):  # other releases may not know these flags, and abort
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_FLAGS}".strip()
