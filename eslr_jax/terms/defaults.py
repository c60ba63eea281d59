"""The terms that a scene has if nobody asks for others."""

from __future__ import annotations

from eslr_jax.terms.bending import Bending
from eslr_jax.terms.collision import Collision
from eslr_jax.terms.friction import Friction
from eslr_jax.terms.gravity import Gravity
from eslr_jax.terms.ground import Ground
from eslr_jax.terms.inertia import Inertia
from eslr_jax.terms.repulsion import Repulsion
from eslr_jax.terms.stretch import Stretch
from eslr_jax.terms.term import Term

CLOTH: tuple[Term, ...] = (Stretch(), Bending(), Inertia(), Gravity())
"""The terms of every cloth, without anything that it could touch."""


def scene_terms(*changed: Term, without: tuple[type[Term], ...] = ()) -> tuple[Term, ...]:
    """Return what a scene models by default, with changes: cloth, body, ground, friction and layers.

    A scene leaves out those of them that it does not need, see `simulation.plan.plan_scene`.

    Args:
        changed: Terms in the place of the default ones of their types; others are added behind them, or before
            friction where cloth rubs on them.
        without: Types of default terms to leave out.
    """
    usual = (*CLOTH, Collision(), Ground(), Friction(), Repulsion())
    given = {type(term): term for term in changed}
    kept = [given.pop(type(term), term) for term in usual]
    rubbed = [term for kind, term in given.items() if kind.touched is not Term.touched]
    others = [term for kind, term in given.items() if kind.touched is Term.touched]
    terms: list[Term] = []
    for term in kept:
        terms += [*rubbed, term] if isinstance(term, Friction) else [term]
    return tuple(term for term in (*terms, *others) if not isinstance(term, without))
