"""The terms that a scene has if nobody asks for others."""

from __future__ import annotations

from eslr_jax.terms.bending import Bending
from eslr_jax.terms.collision import Collision
from eslr_jax.terms.contact import Contact
from eslr_jax.terms.friction import Friction
from eslr_jax.terms.gravity import Gravity
from eslr_jax.terms.ground import Ground
from eslr_jax.terms.inertia import Inertia
from eslr_jax.terms.stretch import Stretch
from eslr_jax.terms.term import Term

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
