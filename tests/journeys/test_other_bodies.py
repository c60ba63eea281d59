"""Bundled garments on bodies of other rigs, shapes and rest poses: they sit, and they walk.

`experiments/other_bodies.py` measures all nine garments on all five bodies.
"""

import pytest
from other_bodies import BODIES, measure

from eslr_jax.pipeline.rigs.rig import make_body


@pytest.mark.parametrize(("name", "garment"), [("figure", "longsleeve"), ("smpl_female", "pants")])
def test_a_bundled_garment_sits_and_walks_on_another_body(name, garment):
    ((row, *_),) = measure(make_body(BODIES[name]()), (garment,), frames=60)
    assert row["inside_at_rest"] == 0
    assert row["rest_inside_mm"] < 0.1
    assert row["standing_p99_stretch"] < 1.15
    assert row["standing_max_stretch"] < 1.2
    assert row["rest_p99_stretch"] < 1.2  # with the arms up, where the body rests so
    assert row["walk_finite"]
    assert row["walk_p99_stretch"] < 1.4
