"""Table V of the paper: layers, parameters, loss, latency and memory of the full-size networks and of ours.

    python experiments/paper/model_cost.py [--smoke]

Latency is a frame of the T-shirt at 4k vertices, contacts included, the networks in turns. Memory is what XLA
sets aside for the call, weights included. Loss is the Total of `native_garments.json`: full-size networks have
none, to train them takes a GPU.
"""

from __future__ import annotations

import json

import jax
from native_garments import ABLATION
from rollouts import RESULTS, arguments, write

from eslr_jax.assets import load_body, load_garment, load_model, load_motion
from eslr_jax.assets.load import START_MODEL, default_model
from eslr_jax.body.motion import pose_body
from eslr_jax.evaluation.calibrate import device_name
from eslr_jax.evaluation.scene_parts import take_turns
from eslr_jax.models.registry import MODELS, count_parameters, init_model
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.scene import prepare_scene
from eslr_jax.simulation.network import network_step
from eslr_jax.simulation.scan import frame_inputs
from eslr_jax.simulation.step import frame_problem

FULL_SIZE = ("mgn-48", "mgn-15", "eslr-15", "eslr-10")
TRAINED = (default_model(), START_MODEL, *ABLATION)


def main() -> None:
    """Measure and write."""
    chosen = arguments(__doc__)
    names, size, turns = (*FULL_SIZE, *TRAINED), "4k", 7
    if chosen.smoke:
        names, size, turns = (FULL_SIZE[-1], START_MODEL), "1k", 1
    losses = json.loads((RESULTS / "native_garments.json").read_text())["mean"]
    poses = pose_body(load_body(), load_motion("cmu_016_32"), num_frames=2)
    parts, rows = {}, {}
    for name in names:
        params, config = (init_model(MODELS[name]), MODELS[name]) if name in FULL_SIZE else load_model(name)
        embedding = {"embedding_size": config.embedding_size, "embedding_mode": config.embedding_mode}
        scene = prepare_scene(load_garment("tshirt", vertices=size, **embedding), poses)  # type: ignore[arg-type]
        inputs = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))

        def forward(params, state, config=config, scene=scene, inputs=inputs):
            problem = frame_problem(
                scene.garment, state, inputs, scene.surface, scene.timestep, PhysicsParameters()
            )
            return network_step(params, scene.garment, scene.material, problem, state, config)[0]

        memory = jax.jit(forward).lower(params, scene.start).compile().memory_analysis()
        parts[name] = (forward, (params, scene.start))
        rows[name] = {
            "layers": config.message_passing_steps,
            "refinement_steps": config.refinement_steps,
            "parameters": count_parameters(params),
            "memory_mb": (memory.temp_size_in_bytes + memory.argument_size_in_bytes) / 1e6,
            **({"loss": losses[name]["total"]} if name in losses else {}),
        }
    for name, milliseconds in take_turns(parts, turns).items():
        rows[name]["latency_ms"] = milliseconds
    write({"vertices": size, "device": device_name(), "mean": rows}, chosen.out / "model_cost.json")


if __name__ == "__main__":
    main()
