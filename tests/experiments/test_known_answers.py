"""Large rotations and drape: their references, and what is found on coarse meshes."""

import numpy as np
import pytest
from known_answers.cases import OURS
from known_answers.rotations import bend, column, elastica, stick_slip

END = np.ones(1)


@pytest.mark.parametrize(("weight", "known"), [(1, 0.1246), (20, 1.864), (100, 5.888)])
def test_heavy_elastica_has_the_published_drop_over_reach(weight, known):
    reach, drop = elastica(weight, 0.0)(END)[:, 0]
    assert -drop / reach == pytest.approx(known, rel=1e-3)


@pytest.mark.parametrize(("load", "drop", "shortening"), [(1, 0.3017, 0.0564), (10, 0.8106, 0.5550)])
def test_end_load_has_the_published_drop_and_shortening(load, drop, shortening):
    x, y = elastica(0.0, load)(END)[:, 0]
    assert (-y, 1 - x) == pytest.approx((drop, shortening), abs=1e-4)


def test_column_by_quadrature_is_that_of_elliptic_integrals():
    for tilt in (1.0, 2.0):
        load, along, aside = column(tilt)
        assert elastica(0.0, 0.0, -load)(END)[:, 0] == pytest.approx((along, aside), abs=1e-5)
    assert column(1e-3)[0] == pytest.approx(np.pi**2 / 4, rel=1e-5)  # Euler's load


@pytest.mark.slow
@pytest.mark.parametrize(("mesh", "bar"), [("grid", 0.02), ("irregular", 0.04)])
def test_strip_bends_as_far_as_it_should(mesh, bar):
    curve = elastica(20.0, 0.0)
    x, y = bend(mesh, 0.02, curve, weight=20.0)
    reach, drop = curve(END)[:, 0]
    assert y / x == pytest.approx(drop / reach, rel=bar)


@pytest.mark.slow
def test_start_does_not_decide_where_a_strip_comes_to_rest():
    """Or else a solver that stays where it starts would be right."""
    curve, off = elastica(5.0, 0.0), elastica(4.0, 0.0)
    loads = {"weight": 5.0}
    assert bend("grid", 0.02, off, **loads) == pytest.approx(bend("grid", 0.02, curve, **loads), abs=1e-6)


@pytest.mark.slow
def test_sheet_sticks_slides_and_slides_again():
    assert all(answer.is_within for answer in stick_slip(OURS[0]))
