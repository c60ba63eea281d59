"""Table V of the paper: layers, parameters, loss, latency and memory of the full-size networks and of ours.

    python experiments/paper/model_cost.py [--smoke]

Latency is the time of one frame of the T-shirt at 4k vertices, contact search included; the networks run in
turns. Memory is what XLA allocates for the call, weights included. Loss is the Total of `native_garments.json`.
Full-size networks have none, because training them takes a GPU.
"""

from __future__ import annotations

import json

import jax
from native_garments import ABLATION
from rollouts import RESULTS, arguments, embedding_options, write

from eslr_jax.assets import load_body, load_garment, load_model, load_motion
from eslr_jax.assets.load import START_MODEL, default_model
from eslr_jax.body.motion import pose_body
from eslr_jax.evaluation.scene_parts import take_turns
from eslr_jax.models.registry import MODELS, count_parameters, init_model
from eslr_jax.scene.plan import prepare_scene
from eslr_jax.simulation.budget import device_name
from eslr_jax.simulation.frame import frame_inputs, frame_problem
from eslr_jax.simulation.network import predict

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
        scene = prepare_scene(load_garment("tshirt", vertices=size, **embedding_options(config)), poses)
        inputs = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))

        def forward(params, state, config=config, scene=scene, inputs=inputs):
            return predict(params, frame_problem(scene, state, inputs), state, config).position

        memory = jax.jit(forward).lower(params, scene.initial_state).compile().memory_analysis()
        parts[name] = (forward, (params, scene.initial_state))
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
