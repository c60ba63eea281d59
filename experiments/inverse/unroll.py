"""Train a small network frame by frame, and through time.

    python experiments/inverse unroll [--smoke] [--out DIR]

The network simulates a swinging sheet alone, from its own states. Three losses, the same steps and motions:
- "per frame": the potential of every frame, each from a given state (as `eslr train` does);
- "potential through time": the same sum, with gradients through the states that a frame hands on;
- "distance through time": the squared distance from the solver's motion, gradients through the states.
Judged on a longer motion that none has seen. Writes unroll.json.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
from harness import keep, parser

from eslr_jax import Network, SimConfig, rollout_scene
from eslr_jax.fabric.materials import COTTON
from eslr_jax.networks.registry import MODELS
from eslr_jax.pipeline.report.gap import trajectory_gap
from eslr_jax.pipeline.report.report import environment
from eslr_jax.simulation.frame import frame_inputs, frame_problem
from eslr_jax.simulation.stepper import make_stepper
from eslr_jax.types import Scene
from inverse.sheet import RESULTS, TIMESTEP, held_scene, square

SIDE, SIZE = 7, 0.24  # vertices, [m]
FRAMES, TEST_FRAMES = 9, 25
FABRIC = COTTON.replace(bending_stiffness=8e-4)
MODEL = dataclasses.replace(MODELS["smooth-small"], latent_size=16, refinement_steps=3)
ALONE, SOLVER = SimConfig(iterations=0), SimConfig(iterations=150)
ENERGY, DISTANCE = 1e-3, 1e-2  # [J], [m]: units of the losses
LOSSES = ("per frame", "potential through time", "distance through time")
GARMENT = square(SIDE, SIZE, [0, SIDE - 1])


def make_scene(seed: int, num_frames: int) -> Scene:
    """Return the sheet with one of its two pinned corners swung in a direction of its own."""
    random = np.random.default_rng(seed)
    swing = np.sin(2 * np.pi * TIMESTEP * np.arange(num_frames) / random.uniform(0.3, 0.6))
    shift = np.zeros((num_frames, SIDE * SIDE, 3), np.float32)
    shift[:, 0] = random.uniform(-0.04, 0.04, 3) * swing[:, None]
    return held_scene(GARMENT, jnp.asarray(shift), FABRIC)


def potentials(network, scene: Scene, *, is_detached: bool) -> jax.Array:
    """Return every frame's potential [J] where the network ended it; detached: frames hand on no gradient."""
    step = make_stepper(network, ALONE)

    def advance(state, inputs):
        if is_detached:
            state = jax.lax.stop_gradient(state)
        state, report = step(frame_problem(scene, state, inputs), state)
        return state, sum(report.energies.values())

    return jax.lax.scan(advance, scene.initial_state, frame_inputs(scene))[1]


def loss(params, network: Network, scene: Scene, solved: jax.Array, *, kind: str) -> jax.Array:
    """Return one of the three losses, without unit."""
    network = network.replace(params=params)
    if kind == "distance through time":
        apart = rollout_scene(network, scene, ALONE).positions - solved
        return jnp.mean(jnp.sum(apart**2, axis=-1)) / DISTANCE**2
    return jnp.mean(potentials(network, scene, is_detached=kind == "per frame")) / ENERGY


def train(kind: str, scenes: list[Scene], solved: list[jax.Array], steps: int) -> tuple[Network, float]:
    """Return a trained network, and the milliseconds of a step."""
    network = MODEL.new_network()
    params = network.params
    optimizer = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(2e-3, steps))
    )

    @jax.jit
    def step(params, state, scene, solved):
        gradient = jax.grad(loss)(params, network, scene, solved, kind=kind)
        updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(params, updates), state

    state, times = optimizer.init(params), []
    for index in range(steps):
        began = time.perf_counter()
        row = index % len(scenes)
        params, state = jax.block_until_ready(step(params, state, scenes[row], solved[row]))
        times.append(1e3 * (time.perf_counter() - began))
    return network.replace(params=params), float(np.median(times))


def judge(network, scene: Scene, solved: jax.Array) -> dict:
    """Return the network's distance from the solver's motion by frame [mm], and its optimality gap."""
    trajectory = rollout_scene(network, scene, ALONE)
    apart = jnp.sqrt(jnp.mean(jnp.sum((trajectory.positions - solved) ** 2, axis=-1), axis=-1))
    gap = trajectory_gap(trajectory, scene, every=1)
    return {
        "rms_mm": np.round(1e3 * np.asarray(apart, float), 3),
        "gap_mj": round(float(jnp.median(gap.reached - gap.optimum)) * 1e3, 4),
        "stretch_mj": round(float(jnp.mean(trajectory.energies["stretch"])) * 1e3, 4),
    }


def main() -> None:
    options = parser(__doc__, "a few steps", RESULTS).parse_args()
    steps, count, seen = (2, 1, 3) if options.smoke else (150, 12, FRAMES)
    kinds = LOSSES[2:] if options.smoke else LOSSES
    scenes = [make_scene(seed, seen) for seed in range(count)]
    solved = [rollout_scene(None, scene, SOLVER).positions for scene in scenes]
    test = make_scene(1000, 3 if options.smoke else TEST_FRAMES)
    truth = rollout_scene(None, test, SOLVER).positions
    result = {"steps": steps, "untrained": judge(MODEL.new_network(), test, truth)}
    for kind in kinds:
        network, milliseconds = train(kind, scenes, solved, steps)
        result[kind] = {"step_ms": round(milliseconds, 2), **judge(network, test, truth)}
    keep(options.out / "unroll.json", result | environment())
