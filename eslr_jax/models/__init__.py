"""The networks: LSDMP, GSA, MeshGraphNet (the only room that imports flax.linen)."""
