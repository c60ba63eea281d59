"""`python -m eslr_jax.pipeline.cli`."""

from eslr_jax.pipeline.cli import main

if __name__ == "__main__":  # workers of a batch import it, too
    main()
