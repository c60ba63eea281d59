"""Training on the physics loss: data, pool, loss, step, loop, checkpoints (the only room that imports orbax)."""
