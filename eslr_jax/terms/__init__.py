"""Energies of cloth, one a file: each with its constants, its curvature and its name in every report.

Two sets: the terms of `scene.build.scene_terms` (set `consistent`), which simulate and train, and `hood`, HOOD's
published losses, for tables. Side by side, from x_t to x_{t+1}:

| term      | `consistent`                                  | `hood`                                      |
|-----------|-----------------------------------------------|---------------------------------------------|
| stretch   | StVK: A h (mu tr G^2 + lambda/2 tr(G)^2)      | the same                                    |
| bending   | k l^2 / (4 sum A) theta^2 / 2, l at rest      | l of the predicted mesh, differentiated     |
| inertia   | m abs(x - x_t - dt v)^2 / (2 dt^2)            | with dt v = x_t - x_{t-1}; pins count       |
| gravity   | m g height above x_t                          | m g height above the world's origin         |
| collision | k a max(eps - d, 0)^3, a vertex area [J/m^5]  | w max(eps - d, 0)^3 per vertex [J/m^3]      |
|   plane   | of the closest point on the triangles, smooth | of the face whose centroid is nearest       |
|           | normal; found at t, carried to t + 1          | found at t or, in tables, at t + 1          |
|   eps     | 2 mm plus the sagitta of the mesh's edges     | 2 mm in training, 1 mm in tables            |
|   sides   | also the body part on the cloth's other side  | one                                         |
| friction  | mu N (sqrt(u^2 + s^2) - s), N contact force   | mu m g s abs(u) within 5.5 cm, whatever the |
|           | at t, u in the tangent plane                  | contact force; s a slope against the z axis |
|   motion  | of the body under the vertex, t to t + 1      | of a face centroid, t - 1 to t in training  |
| repulsion | between layers of cloth, where they can meet  | none                                        |
| ground    | collision and friction as with the body       | none                                        |
| air       | drag and lift of faces, `terms.air`           | none                                        |
| damping   | of the fabric's strain, `terms.damping`       | none                                        |
| your own  | a subclass of `terms.term.Term`               | none                                        |
"""
