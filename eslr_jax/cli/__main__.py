"""`python -m eslr_jax.cli`."""

from eslr_jax.cli import main

main()
