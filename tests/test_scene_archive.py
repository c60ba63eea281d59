"""A scene in a file is the scene itself."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from jax.tree_util import Partial
from own_term import Push

from eslr_jax import AssetError, ConfigError, load_scene, prepare_scene, save_scene, scene_terms
from eslr_jax.terms import Air, Damping, Ground
from eslr_jax.terms.air import blowing


@pytest.fixture(scope="module")
def scene():
    garment = square(5, 0.12, is_pinned=np.array([0, 3]))
    others = blowing((3.0, 0.0, 0.0), 0.3), Damping(0.01), Push(0.5)
    terms = scene_terms(Ground(is_always=True), *others)
    return prepare_scene(garment, drifting_ball(3), terms=terms, integrator="bdf2", substeps=2)


def test_a_scene_survives_its_file_with_all_that_it_models(tmp_path, scene):
    save_scene(tmp_path / "scene.npz", scene)
    again = load_scene(tmp_path / "scene.npz")
    assert jax.tree.structure(again) == jax.tree.structure(scene)
    jax.tree.map(np.testing.assert_array_equal, again, scene)
    types = [[np.asarray(leaf).dtype for leaf in jax.tree.leaves(each)] for each in (scene, again)]
    assert types[0] == types[1]


def test_a_term_whose_module_is_not_there_is_named(tmp_path, scene):
    save_scene(tmp_path / "scene.npz", scene)
    code = "import sys, eslr_jax\ntry: eslr_jax.load_scene(sys.argv[1])\nexcept eslr_jax.EslrError as e: print(e)"
    command = [sys.executable, "-c", code, str(tmp_path / "scene.npz")]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.strip().endswith(
        "run the command where own_term.py is, or put its folder on PYTHONPATH"
    )


def test_a_function_of_ones_own_is_refused_when_it_is_written(tmp_path, scene):
    scene = scene.with_term(Air(Partial(lambda points, time: 2.0 * points)))
    with pytest.raises(ConfigError, match=r"scene\.terms\.\d+\.wind is a function of your own"):
        save_scene(tmp_path / "scene.npz", scene)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("tree", ['{"type": "os:system", "parts": {}}', "{", '{"array": "nothing"}', "3"])
def test_a_file_that_holds_no_scene_is_refused_in_one_line(tmp_path, tree):
    np.savez(tmp_path / "scene.npz", tree=np.array(tree), x=jnp.zeros(2))
    with pytest.raises(AssetError, match=r"\A[^\n]+\Z"):
        load_scene(tmp_path / "scene.npz")
