"""What a scene says that it models."""

import pytest

from eslr_jax.config import SimConfig
from eslr_jax.evaluation.scene_parts import describe_scene, take_turns, time_parts
from eslr_jax.scene import SceneOptions, prepare_scene

PHYSICS = SimConfig(simulator="physics")


def test_what_a_scene_lacks_is_left_out(tshirt, walk):
    parts = describe_scene(prepare_scene(tshirt, walk), walk, PHYSICS)
    assert {"stretch", "bending", "inertia and gravity", "collision and friction"} <= set(parts.modelled)
    assert {"other body faces", "pins", "self-contact", "network"} <= set(parts.left_out)
    bare = prepare_scene(tshirt, walk, options=SceneOptions(has_body=False))
    assert "collision and friction" in describe_scene(bare, walk, PHYSICS).left_out


def test_turns_return_a_time_for_each_part():
    times = take_turns({"twice": (lambda x: 2 * x, (1.0,)), "thrice": (lambda x: 3 * x, (1.0,))}, turns=2)
    assert set(times) == {"twice", "thrice"}
    assert all(value > 0 for value in times.values())


@pytest.mark.slow
def test_parts_of_a_frame_are_timed(tshirt, walk):
    times = time_parts(None, prepare_scene(tshirt, walk), PHYSICS)
    assert times["whole frame"] > times["contact search"] > 0
