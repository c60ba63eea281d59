"""Energies of cloth, one a file: each with its constants, its curvature and its name in every report.

Two sets: the terms of `scene_terms` (set `consistent`), which simulate and train, and `hood`, HOOD's
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
| ground    | collision and friction as with the body       | none                                        |
| contact   | collision and friction of pairs that are near | none                                        |
|           | at t; then ends of the frame are pushed until |                                             |
|           | nothing has passed through cloth on the way   |                                             |
| air       | drag and lift of faces, `terms.air`           | none                                        |
| damping   | of the fabric's strain, `terms.damping`       | none                                        |
| your own  | a subclass of `terms.term.Term`               | none                                        |
"""

from eslr_jax.terms.air import Air
from eslr_jax.terms.bending import Bending
from eslr_jax.terms.collision import Collision
from eslr_jax.terms.contact import Contact
from eslr_jax.terms.damping import Damping
from eslr_jax.terms.friction import Friction
from eslr_jax.terms.gravity import Gravity
from eslr_jax.terms.ground import Ground
from eslr_jax.terms.inertia import Inertia
from eslr_jax.terms.stretch import Stretch
from eslr_jax.terms.term import Elements, Term

__all__ = [
    "CLOTH", "FAST", "Air", "Bending", "Collision", "Contact", "Damping", "Elements", "Friction", "Gravity",
    "Ground", "Inertia", "Stretch", "Term", "scene_terms",
]  # fmt: skip

CLOTH: tuple[Term, ...] = (Stretch(), Bending(), Inertia(), Gravity())
"""The terms of every cloth, without anything that it could touch."""


def scene_terms(*changed: Term, without: tuple[type[Term], ...] = ()) -> tuple[Term, ...]:
    """Return what a scene models by default, with changes: cloth, body, ground, friction, strict contact.

    A scene leaves out those of them that it does not need, see `simulation.plan.plan_scene`.

    Args:
        changed: Terms in the place of the default ones of their types; others are added behind them, or before
            friction where cloth rubs on them.
        without: Types of default terms to leave out.
    """
    usual = (*CLOTH, Collision(), Ground(), Friction(), Contact())
    given = {type(term): term for term in changed}
    kinds = {type(term) for term in usual}
    kept = tuple(given.get(type(term), term) for term in usual if not isinstance(term, without))
    others = [term for term in changed if type(term) not in kinds]
    rubbed = [term for term in others if type(term).touched is not Term.touched]
    behind = (term for term in others if type(term).touched is Term.touched)
    first = next((i for i, term in enumerate(kept) if isinstance(term, Friction)), len(kept))
    return (*kept[:first], *rubbed, *kept[first:], *behind)


FAST: tuple[Term, ...] = scene_terms(without=(Contact,))
"""The default terms without strict contact, as networks were trained with them."""
