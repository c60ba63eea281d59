"""What a scene says that it models."""

import jax.numpy as jnp
import pytest

from eslr_jax.pipeline.report.scene_parts import describe_scene, take_turns, time_parts
from eslr_jax.simulation.scene import start_integrator
from eslr_jax.terms import CLOTH, Air, Damping
from eslr_jax.types import Threads


def test_what_a_scene_lacks_is_left_out(small_poses, small_scene):
    parts = describe_scene(small_scene, small_poses, None)
    assert set(parts.modelled) == {
        "stretch", "bending", "inertia", "gravity", "collision", "friction", "contact", "body",
    }  # fmt: skip
    assert set(parts.left_out) == {
        "pins", "ground", "air", "damping", "fabric by part", "network",
    }  # fmt: skip
    assert parts.modelled["stretch"] == "100 faces"
    bare = small_scene.replace(terms=(*CLOTH, Air((3.0, 0.0, 4.0)), Damping(0.01)), body=None)
    bare = describe_scene(bare, small_poses, None)
    assert bare.left_out["collision"] == "no body in reach"
    assert (bare.modelled["air"], bare.modelled["damping"]) == ("5.0 m/s", "0.01 s")
    start = start_integrator(small_scene.initial_state, "bdf2")
    scene = small_scene.replace(initial_state=start, substeps=2)
    threads = Threads(warp=jnp.ones((100, 2)), stiffness=jnp.ones((4, 100)))
    woven = scene.replace(material=scene.material.replace(threads=threads))
    parts = describe_scene(woven, small_poses, None)
    assert parts.modelled["fabric by part"] == "threads"
    assert parts.modelled["substeps"] == "2 a frame"
    assert "BDF2" in parts.modelled


def multiply(x):
    for _ in range(20):
        x = x @ x / 300
    return x


def test_the_slower_of_two_functions_takes_longer_in_turns():
    matrix = jnp.ones((300, 300))
    times = take_turns({"sum": (jnp.sum, (matrix,)), "products": (multiply, (matrix,))}, turns=5)
    assert times["products"] > 3 * times["sum"]


@pytest.mark.slow
def test_parts_of_a_frame_are_timed(small_scene, small_config):
    times = time_parts(None, small_scene, small_config)
    assert times["whole frame"] > times["searches for contacts"]
    assert times["whole frame"] > times["preconditioner"]
