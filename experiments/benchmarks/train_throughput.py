"""What a training step costs beside the forward pass, backward pass and update of the same model alone.

    python experiments/benchmarks/train_throughput.py [--json] [--smoke]

The whole step also poses the body, searches contacts, states the frame's problem, moves the trajectory on and
keeps the metrics. The bare step has its problem given. Both are called in turns on the same frame.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import optax

from eslr_jax.evaluation.calibrate import device_name
from eslr_jax.evaluation.report import environment
from eslr_jax.evaluation.scene_parts import take_turns
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.simulation.step import FrameInput, frame_problem
from eslr_jax.training.data import load_training_data
from eslr_jax.training.loss import physics_loss
from eslr_jax.training.pool import skin, start_trajectory
from eslr_jax.training.recipe import load_recipe
from eslr_jax.training.step import init_train_state, make_optimizer, make_train_step

RECIPE = Path(__file__).parents[1] / "configs" / "eslr-small.toml"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--smoke", action="store_true", help="a small model, one turn")
    arguments = parser.parse_args()
    changes = (
        {"model": "mgn-small", "model.refinement_steps": 1, "garments": ["tshirt"]} if arguments.smoke else {}
    )
    config = load_recipe(RECIPE, {"split": "validation", **changes})
    data = load_training_data(config, config.vertices[0])
    state = init_train_state(config, (data,))
    garment = data.garment(jnp.int32(0))
    slot = jax.jit(partial(start_trajectory, data=data, garment=garment, config=config))(jax.random.key(0))
    before, after = (data.transforms(slot.frame + k, slot.yaw) for k in (0, 1))
    frame = FrameInput(data.body(before, slot.girth), data.body(after, slot.girth), skin(garment, after))
    problem = frame_problem(
        garment, slot.state, frame, data.surface, jnp.float32(1 / 30), PhysicsParameters()
    )
    optimizer = make_optimizer(config)

    def bare(trained, moments):
        def loss_of(trained):
            weights = {**state.params, "params": trained}
            return physics_loss(weights, garment, slot.material, problem, slot.state, config)[0]

        gradient = jax.grad(loss_of)(trained)
        updates, moments = optimizer.update(gradient, moments, trained)
        return optax.apply_updates(trained, updates), moments

    step = make_train_step(config, 0)
    times = take_turns(
        {
            "whole step": (lambda state: step.__wrapped__(state, data), (state,)),
            "forward, backward, update": (bare, (state.params["params"], state.optimizer)),
        },
        1 if arguments.smoke else 40,
    )
    whole, alone = times.values()
    result = {
        "model_parameters": sum(leaf.size for leaf in jax.tree.leaves(state.params["params"])),
        "vertices": config.vertices[0],
        "ms": times,
        "overhead": whole / alone - 1,
        "device": device_name(),
        "environment": environment(),
    }
    print(
        json.dumps(result, indent=1)
        if arguments.json
        else f"{result['ms']}, overhead {result['overhead']:.1%}"
    )


if __name__ == "__main__":
    main()
