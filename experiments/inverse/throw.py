"""Find the hand's acceleration that throws a cloth so that its centre comes to a target.

    python experiments/inverse throw [--smoke] [--out DIR]

A scene cannot let go of its pins, so a throw is two scenes: in the first a hand holds a corner; in the second,
which begins with the last state of the first, nothing is pinned. Gradients pass from one into the other. The air
is empty: the target is a point. Writes throw.json.
"""

import jax
import jax.numpy as jnp
import numpy as np
from harness import keep, parser

from eslr_jax import SimConfig, rollout_scene
from eslr_jax.pipeline.report.report import environment
from inverse.search import race
from inverse.sheet import RESULTS, TIMESTEP, held_scene, square

SIDE, SIZE = 7, 0.24  # vertices, [m]
HELD, FLIGHT = 9, 8  # frames in the hand and in the air
KNOTS = 4  # accelerations of the hand, linear between
UNIT = 10.0  # [m/s^2] of a parameter
EFFORT = 1e-4  # [m^2] per squared parameter: of all throws that meet the target, a gentle one
TARGET = np.array([0.9, 0.4, 0.2], np.float32)  # [m]
CONFIG = SimConfig(iterations=60)
GARMENT = square(SIDE, SIZE, [0])


def hand_track(parameters: jax.Array) -> jax.Array:
    """Return where the hand is in every frame that it holds the cloth [m], shape [frames, 3]."""
    frames = jnp.linspace(0.0, KNOTS - 1.0, HELD - 1)
    knots = UNIT * parameters.reshape(KNOTS, 3)
    acceleration = jax.vmap(lambda column: jnp.interp(frames, jnp.arange(KNOTS), column), 1, 1)(knots)
    velocity = jnp.cumsum(acceleration, axis=0) * TIMESTEP
    return jnp.concatenate([jnp.zeros((1, 3)), jnp.cumsum(velocity, axis=0) * TIMESTEP])


def throw(parameters: jax.Array) -> jax.Array:
    """Return the cloth while it is held and while it flies [m], shape [frames, vertices, 3]."""
    held = held_scene(GARMENT, hand_track(parameters)[:, None])
    swung = rollout_scene(None, held, CONFIG)
    loose = held.garment.replace(is_pinned=jnp.zeros_like(held.garment.is_pinned))
    state = held.initial_state.replace(position=swung.positions[-1], velocity=swung.velocities[-1])
    flight = held.replace(garment=loose, initial_state=state, pin_targets=None, num_frames=FLIGHT + 1)
    return jnp.concatenate([swung.positions, rollout_scene(None, flight, CONFIG).positions[1:]])


def miss(positions: jax.Array) -> jax.Array:
    """Return how far the cloth's centre is from the target in the last frame [m], shape [3]."""
    areas = GARMENT.vertex_areas[:, None]
    return jnp.sum(areas * positions[-1], axis=0) / jnp.sum(areas) - TARGET


def loss(parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the squared miss with the price of effort [m^2], and the throw."""
    positions = throw(parameters)
    return jnp.sum(miss(positions) ** 2) + EFFORT * jnp.sum(parameters**2), positions


def main() -> None:
    options = parser(__doc__, "a few steps", RESULTS).parse_args()
    steps, turns = (3, 1) if options.smoke else (30, 25)
    both, cost, _, by_gradient, simplex = race(loss, np.zeros(3 * KNOTS), steps, turns)
    throws = [np.asarray(both(jnp.asarray(run.best, jnp.float32))[1]) for run in (by_gradient, simplex)]
    result = {
        "target_m": TARGET,
        "hand_acceleration_m_s2": UNIT * by_gradient.best.reshape(KNOTS, 3),
        "gradient_in_evaluations": round(cost, 2),
        "refused": by_gradient.refused,
    }
    for name, run, positions in zip(("lbfgs", "nelder_mead"), (by_gradient, simplex), throws, strict=True):
        calls = round(len(run.losses) * (cost if run is by_gradient else 1.0))
        distance = 1e3 * float(jnp.linalg.norm(miss(positions)))
        result[name] = {"evaluations": calls, "miss_mm": distance, "loss": min(run.losses)}
    keep(options.out / "throw.json", result | environment())
