"""Programs: traced once for all runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from jax import export
from own_term import Push

from eslr_jax import SimConfig, prepare_scene, scene_terms
from eslr_jax.numerics import masked_sum
from eslr_jax.simulation import program
from eslr_jax.simulation.frame import first_problem
from eslr_jax.simulation.program import find_program
from eslr_jax.simulation.stepper import make_stepper
from eslr_jax.terms import Air, Damping, Friction, Ground

VALUES = (jnp.arange(5.0), jnp.arange(5) > 1)


@pytest.fixture
def folder(tmp_path):
    """A folder for traced programs, which nobody has used."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    program._program.cache_clear()
    yield tmp_path / "traced"
    jax.config.update("jax_compilation_cache_dir", before)
    program._program.cache_clear()


def find_again():
    """Find a program as another process would; return it and whether it was traced."""
    program._program.cache_clear()
    traced = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "export", lambda *given: (traced.append(given), EXPORT(*given))[1])
        found = find_program(masked_sum, VALUES)
    assert found.results.shape == ()
    assert float(found.wait()(*VALUES)) == 9.0
    return bool(traced)


EXPORT = export.export


@pytest.mark.parametrize("content", [b"", b"not a pickle", b"\x80\x04N."])
def test_another_run_does_not_trace_again_but_where_the_file_is_damaged(folder, content):
    assert find_again()
    assert not find_again()
    (path,) = folder.iterdir()
    path.write_bytes(content)
    assert find_again()
    assert not find_again()


@pytest.mark.parametrize(
    ("owner", "name", "other"),
    [(program, "source_hash", lambda: b"another version"), (masked_sum, "__module__", "eslr_jax.another")],
    ids=["changed source", "another function of that name"],
)
def test_what_is_not_the_same_is_traced_again(folder, monkeypatch, owner, name, other):
    find_again()
    monkeypatch.setattr(owner, name, other)
    assert find_again()


def test_the_oldest_files_go(folder, monkeypatch):
    monkeypatch.setattr(program, "_KEPT_TRACES", 2)
    for size in range(1, 5):
        find_program(masked_sum, (jnp.zeros(size), jnp.zeros(size, bool)))
    assert len(list(folder.iterdir())) == 2


def test_a_folder_that_cannot_be_written_costs_time_alone(folder):
    folder.write_text("a file in its place")
    assert find_again()
    assert find_again()


@pytest.mark.parametrize("setting", [None, "gs://bucket/programs"])
def test_without_a_folder_of_this_machine_nothing_is_kept(folder, setting, monkeypatch):
    monkeypatch.chdir(folder.parent)
    jax.config.update("jax_compilation_cache_dir", setting)
    assert float(find_program(masked_sum, VALUES).wait()(*VALUES)) == 9.0
    assert not list(folder.parent.iterdir())


@pytest.mark.parametrize(
    ("part", "is_known"),
    [
        (masked_sum, True),
        (("config", SimConfig()), True),
        (jax.tree.structure((Friction(0.2), {"a": [1.0]}, None)), True),
        (jax.tree.structure((Friction(0.2), Push(1.0))), False),  # its code may change, and its name stay
        (np.sin, False),
        (lambda x: x, False),
    ],
)
def test_only_code_of_the_package_is_kept(part, is_known):
    assert program._is_known(part) == is_known


# --- a frame's program multiplies in full precision ---------------------------------------------------------


@pytest.mark.slow
def test_physics_multiplies_in_full_precision():
    """A GPU rounds the operands of other products of float32 to ten bits."""
    terms = scene_terms(Ground(is_always=True), Air((0.0, 0.0, 0.0)), Damping(0.01))
    scene = prepare_scene(square(), drifting_ball(13), terms=terms, integrator="bdf2")
    stepper = make_stepper(None, SimConfig(iterations=5))

    def step(scene, state):
        return stepper(first_problem(scene), state)

    program = jax.jit(step).lower(scene, scene.initial_state).as_text()
    products = [line for line in program.splitlines() if "stablehlo.dot_general" in line]
    assert products
    assert not [line for line in products if "HIGHEST" not in line]
