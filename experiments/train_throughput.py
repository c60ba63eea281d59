"""Compare a training step with the forward pass, backward pass and update of the same model alone.

    python experiments/train_throughput.py [--smoke] [--out DIR]

The whole step also poses the body, searches contacts, states the problem, advances the trajectory and keeps the
metrics. The bare step is given a problem of the same size. They take turns. Writes train_throughput.json.
"""

import jax
import jax.numpy as jnp
import optax
from harness import EXPERIMENTS, keep, machine, parser

from eslr_jax import load_body, load_motion, pose_body, prepare_scene
from eslr_jax.pipeline.assets import split_clips
from eslr_jax.pipeline.assets.models import load_training_data
from eslr_jax.pipeline.report.scene_parts import take_turns
from eslr_jax.simulation.frame import frame_inputs, frame_problem
from eslr_jax.terms import FAST
from eslr_jax.training.loop import keep_memory
from eslr_jax.training.loss import physics_loss
from eslr_jax.training.recipe import load_recipe
from eslr_jax.training.step import init_train_state, make_optimizer, make_train_step

RECIPE = EXPERIMENTS / "configs" / "eslr-small.toml"


def main() -> None:
    chosen = parser(__doc__, "a small model, one turn").parse_args()
    small = {"model": "mgn-small", "model.refinement_steps": 2, "garments": ["tshirt"]}
    config = load_recipe(RECIPE, {"split": "validation", **(small if chosen.smoke else {})})
    data = load_training_data(config, config.vertices[0])
    state = init_train_state(config, (data,))
    poses = pose_body(load_body(), load_motion(split_clips(config.split)[0]), num_frames=2)
    scene = prepare_scene(data.garment(jnp.int32(0)), poses, surface=data.surface, terms=FAST)
    cloth = scene.initial_state
    problem = jax.jit(frame_problem)(scene, cloth, jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene)))
    optimizer = make_optimizer(config)

    def bare(trained, moments, problem):
        def loss_of(trained):
            return physics_loss(state.network.replace(params=trained), problem, cloth, config)[0]

        gradient = jax.grad(loss_of)(trained)
        updates, moments = optimizer.update(gradient, moments, trained)
        return optax.apply_updates(trained, updates), moments

    keep_memory()  # as `eslr train` does
    step = make_train_step(config, 0)
    times = take_turns(
        {
            "whole step": (lambda state: step.__wrapped__(state, data), (state,)),
            "forward, backward, update": (bare, (state.network.params, state.optimizer, problem)),
        },
        1 if chosen.smoke else 40,
    )
    overhead = times["whole step"] / times["forward, backward, update"] - 1
    result = {
        "model_parameters": sum(leaf.size for leaf in jax.tree.leaves(state.network.params)),
        "vertices": config.vertices[0],
        "ms": times,
        "overhead": overhead,
        **machine(),
    }
    keep(chosen.out / "train_throughput.json", result)
    print(f"{times}, overhead {overhead:.1%}")


if __name__ == "__main__":
    main()
