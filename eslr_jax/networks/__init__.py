"""The networks; only this room imports flax.linen.

Symbols of the paper and where they stand:

| paper | here |
|---|---|
| V, E^M, E^W: features of vertices, mesh edges and world edges | nodes and edges of `networks.build` |
| v_i, e_ij: latents of vertices and edges | `lsdmp.Latents` |
| N(i): neighbours of vertex i | `networks.operators.MeshTables.neighbors`, and the body point of its world edge |
| f_e, f_v: perceptrons of message passing, eqs. 1 and 2 | `mesh_mlp`, `world_mlp`, `vertex_mlp` of `LsdmpLayer` |
| p_i, f'_v: smoothed latents and their perceptron, eqs. 3 and 4 | `propagate`, `smooth_mlp` of `LsdmpLayer` |
| E_G: geodesic embedding | `Garment.geodesic_embedding` |
| Q, K, V and the attention of GSA | `query`, `key`, `value` of `GsaBlock`, `attention.linear_attention` |
| A: accelerations | `apply.scale_output` of the decoder's output |
"""
