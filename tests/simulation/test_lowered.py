"""A frame's lowered program holds operations of optional parts only where they were asked for."""

import inspect
import re
from collections.abc import Callable
from types import ModuleType

import jax
import numpy as np
import pytest
from draped_ball import drifting_ball, square

from eslr_jax.config import SimConfig
from eslr_jax.contact import crossing, edges, ground, layer_edges, self_contact, skin
from eslr_jax.fabric import Described, on_threads
from eslr_jax.geometry.weave import warp_directions
from eslr_jax.physics import air, bending, damping, membrane, repulsion
from eslr_jax.physics.materials import COTTON, Weave
from eslr_jax.scene.plan import SceneOptions, prepare_scene
from eslr_jax.simulation import frame
from eslr_jax.simulation.stepper import make_stepper
from eslr_jax.types import Air

# Where operations of a part come from.
SOURCES = {
    "air": (air,),
    "damping": (damping,),
    "skin": (skin, edges),
    "self-contact": (self_contact, crossing, layer_edges, repulsion),
    "ground": (ground,),
    "bdf2": (frame._second_order,),
    "threads": (membrane.thread_strains,),
    "plate": (bending.plate_curvatures,),
}
EVERYTHING = SceneOptions(
    air=Air((0.0, 0.0, 0.0)), damping=0.01, has_skin=True, self_contact=True, ground="on", integrator="bdf2"
)


def woven(garment):
    """Cotton with a stiffness and a rigidity along its threads."""
    warp = warp_directions(garment, direction=(0.0, 0.0, 1.0))
    weave = Weave(stiffness=(900.0, 200.0, 60.0, 25.0), rigidity=(2e-5, 1e-5))
    return on_threads(COTTON, garment, warp, [(np.ones(len(warp), bool), Described(COTTON, weave))])


def lowered(options=None, material=COTTON):
    """The step of one frame as XLA gets it, with the line of code behind every operation."""
    scene = prepare_scene(square(), drifting_ball(13), material=material, options=options)
    stepper = make_stepper(None, SimConfig(iterations=5))
    inputs = jax.tree.map(lambda leaf: leaf[0], frame.frame_inputs(scene))

    def step(scene, state, inputs):
        return stepper(frame.frame_problem(scene, state, inputs), state)

    return jax.jit(step).lower(scene, scene.initial_state, inputs).as_text(debug_info=True)


def count_from(program: str, source: ModuleType | Callable) -> int:
    """Return how many places in a module, or in a function, operations of a program come from."""
    source = inspect.unwrap(source) if callable(source) else source  # tests check types by wrappers
    path = inspect.getsourcefile(source)
    places = [int(line) for line in re.findall(rf'loc\("{re.escape(str(path))}":(\d+)', program)]
    if isinstance(source, ModuleType):
        return len(places)
    lines, first = inspect.getsourcelines(source)
    return sum(first <= line < first + len(lines) for line in places)


@pytest.fixture(scope="module")
def default():
    return lowered()


@pytest.fixture(scope="module")
def everything():
    return lowered(EVERYTHING, woven(square()))


def test_what_every_scene_has_is_found(default):
    assert count_from(default, membrane.stretch_energy) > 0
    assert count_from(default, bending) > 10


@pytest.mark.parametrize("part", SOURCES)
def test_a_part_is_in_the_program_only_where_it_is_modelled(default, everything, part):
    for source in SOURCES[part]:
        assert count_from(default, source) == 0, source
        assert count_from(everything, source) > 0, source


def test_physics_multiplies_in_full_precision(everything):
    """A GPU rounds the operands of other products of float32 to ten bits."""
    products = [line for line in everything.splitlines() if "stablehlo.dot_general" in line]
    assert products
    assert not [line for line in products if "HIGHEST" not in line]
