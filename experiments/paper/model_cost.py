"""Table V of the paper: layers, parameters, latency and memory of the full-size networks.

    python experiments/paper/model_cost.py [--smoke]

Latency is a frame of the T-shirt at 4k vertices, contacts included, the networks in turns. Memory is what XLA
sets aside for the call, weights included. The loss column needs networks of this size trained, which takes a GPU.
"""

from __future__ import annotations

import jax
from rollouts import arguments, write

from eslr_jax.assets import load_body, load_garment, load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.evaluation.calibrate import device_name
from eslr_jax.evaluation.scene_parts import take_turns
from eslr_jax.models.registry import MODELS, count_parameters, init_model
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.scene import prepare_scene
from eslr_jax.simulate.network import network_step
from eslr_jax.simulate.scan import frame_inputs
from eslr_jax.simulate.step import frame_problem

NAMES = ("mgn-48", "mgn-15", "eslr-15", "eslr-10")


def main() -> None:
    """Measure and write."""
    chosen = arguments(__doc__)
    names, size, turns = (NAMES, "4k", 7) if not chosen.smoke else (NAMES[-1:], "1k", 1)
    poses = pose_body(load_body(), load_motion("cmu_016_32"), num_frames=2)
    scene = prepare_scene(load_garment("tshirt", vertices=size), poses)  # type: ignore[arg-type]
    inputs = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))
    parts, rows = {}, {}
    for name in names:
        config = MODELS[name]
        params = init_model(config)

        def forward(params, state, config=config):
            problem = frame_problem(
                scene.garment, state, inputs, scene.surface, scene.timestep, PhysicsParameters()
            )
            return network_step(params, scene.garment, scene.material, problem, state, config)[0]

        memory = jax.jit(forward).lower(params, scene.start).compile().memory_analysis()
        parts[name] = (forward, (params, scene.start))
        rows[name] = {
            "layers": config.message_passing_steps,
            "parameters": count_parameters(params),
            "memory_mb": (memory.temp_size_in_bytes + memory.argument_size_in_bytes) / 1e6,
        }
    for name, milliseconds in take_turns(parts, turns).items():
        rows[name]["latency_ms"] = milliseconds
    write({"vertices": size, "device": device_name(), "mean": rows}, chosen.out / "model_cost.json")


if __name__ == "__main__":
    main()
