import dataclasses
import json
import re
from pathlib import Path

import pytest
from commands import eslr_here, succeeded

from eslr_jax import ConfigError, TrainConfig
from eslr_jax.config import apply_overrides, parse_override
from eslr_jax.networks.registry import MODELS
from eslr_jax.training.recipe import describe_train_config, load_recipe, read_train_config

RECIPES = Path(__file__).parents[1] / "experiments" / "configs"


def test_train_shows_what_every_key_is():
    done = succeeded(eslr_here("train", "--keys"))
    shown = " ".join(done.stdout.replace("│", " ").split())
    kinds = {type(model) for model in MODELS.values()}
    parts = shown.split("usage: eslr train --keys")
    assert len(parts) == 2 + len(kinds)
    for config in (TrainConfig, *kinds):
        names = [field.name for field in dataclasses.fields(config)]
        (part,) = (
            part for part in parts if set(re.findall(r" --(\w+) ", part)) - {"help", "set"} == set(names)
        )
        for name in names:
            says = re.search(
                rf"--{name} (?:\[.*?\]\]|{{.*?}}(?:\|[A-Z]+)?|[A-Z]+) (.*?)\((?:default: |required)", part
            )
            assert says, name
            assert says[1], name


def test_overrides_reach_into_tables():
    values = {"model": {"refinement_steps": 1}}
    apply_overrides(values, dict([parse_override("model.refinement_steps=4"), parse_override("split=test")]))
    assert values == {"model": {"refinement_steps": 4}, "split": "test"}
    with pytest.raises(ConfigError, match="key=value"):
        parse_override("refinement_steps")
    with pytest.raises(ConfigError, match="not a table"):
        apply_overrides({"split": "train"}, {"split.x": 1})


def test_recipe_takes_a_model_by_name(tmp_path):
    path = tmp_path / "recipe.toml"
    path.write_text('model = "eslr-small"\nsteps = 10\n')
    config = load_recipe(path, {"model.refinement_steps": 2})
    assert (config.steps, config.model.refinement_steps, config.model.latent_size) == (10, 2, 32)
    assert read_train_config(json.loads(json.dumps(describe_train_config(config)))) == config
    path.write_text("steps = 10\n")
    assert load_recipe(path, {"model.base": "eslr-small", "model.refinement_steps": 2}) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('model = "eslr-tiny"', "unknown model"),
        ("steps = 10", "names no model"),
        ("model = [", "not valid TOML"),
        ('model = "eslr-small"\nstebs = 3', "did you mean steps"),
        ('model = "eslr-small"\nhorizon = 0', "horizon must be at least 1"),
        ('[model]\nbase = "mgn-5"\nrefinement_steps = 3', "unknown option model.refinement_steps"),
        ("[model]\nlatent_size = 64", "the model has no base"),
        ("model = 3", "the model is 3"),
        (
            'model = "smooth-small"\niterations = 9\nrefinement_weights = "contraction"',
            "needs iterations = 0",
        ),
        ('model = "mgn-5"\nrefinement_weights = "contraction"', "refinement_steps > 1"),
        ('model = "mgn-5"\nschedule = "hood"\nwarmup = 5', 'warmup needs schedule = "cosine"'),
        ('model = "mgn-5"\nschedule = "hood"\nfinal_learning_rate = 0.0', "final_learning_rate needs"),
        ('model = "mgn-5"\nenergy_set = "hood"\ncollision_stiffness = 1e7', "collision_stiffness needs"),
        ('model = "mgn-5"\ncriterion = "cvpr"', '"cvpr" needs energy_set = "hood"'),
        ('model = "mgn-5"\nwarmup = -1', "warmup must not be negative"),
        ('model = "mgn-5"\nfinal_learning_rate = -1e-5', "final_learning_rate must not be negative"),
        ('model = "mgn-5"\ncollision_stiffness = 0', "collision_stiffness must be positive"),
        ('model = "mgn-5"\ngarments = [1]', "garments = 1 has the wrong type"),
    ],
)
def test_broken_recipes_are_refused(tmp_path, text, message):
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_recipe(path)


def test_a_gradient_sees_the_collision_stiffness_beside_any_set_of_energies():
    TrainConfig(model=MODELS["eslr-small"], energy_set="hood", collision_stiffness=1e7)


def test_shipped_recipes_load():
    recipes = sorted(RECIPES.rglob("*.toml"))
    assert recipes
    for recipe in recipes:
        load_recipe(recipe)


def test_the_papers_networks_have_a_recipe_each():
    """They differ in the network alone."""
    folder = RECIPES / "paper"
    shared = load_recipe(folder / "full-size.toml")
    for name in ("eslr-15", "eslr-10", "lsdmp-15", "gsa-15", "mgn-15", "mgn-48", "hood"):
        assert load_recipe(folder / f"{name}.toml") == dataclasses.replace(shared, model=MODELS[name])
    assert load_recipe(folder / "full-size.toml", {"batch_size": 8}).batch_size == 8  # for eight devices


def test_a_recipe_changes_the_values_of_its_base(tmp_path):
    (tmp_path / "base.toml").write_text('model = "eslr-small"\nsteps = 7\nseed = 3')
    recipe = tmp_path / "recipe.toml"
    recipe.write_text('base = "base.toml"\nsteps = 9\n[model]\nbase = "mgn-small"')
    config = load_recipe(recipe, {"seed": 4})
    assert (config.steps, config.seed, config.model) == (9, 4, MODELS["mgn-small"])
    (tmp_path / "base.toml").write_text('base = "recipe.toml"')
    with pytest.raises(ConfigError, match="has a base of its own"):
        load_recipe(recipe)
    recipe.write_text('base = "missing.toml"')
    with pytest.raises(ConfigError, match="no config file"):
        load_recipe(recipe)
