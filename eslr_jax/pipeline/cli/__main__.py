"""`python -m eslr_jax.pipeline.cli`."""

from eslr_jax.pipeline.cli import main

main()
