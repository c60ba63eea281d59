"""Error and cost of the gradient of a walking T-shirt, by the tolerances of the solver and the linear system.

    python experiments/inverse accuracy [--smoke] [--out DIR]

Two losses after five frames (the shirt's mean x, its stretch energy in all frames) by three parameters (stiffness
of the fabric, density, a shift of the body), in float32, the default. They are compared with central
differences in float64, whose solver ends where float64 ends. The cost is the time of loss and gradient relative
to that of the loss alone, for the frame after these five, timed alternately.
Writes accuracy.json.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from harness import keep, parser

from eslr_jax import SimConfig, Trajectory, load_body, load_garment, load_motion, pose_body, prepare_scene
from eslr_jax.evaluation.report import environment
from eslr_jax.evaluation.scene_parts import time_in_turns
from eslr_jax.physics import solve
from eslr_jax.scene.build import slice_tracks
from eslr_jax.scene.plan import first_frames
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.types import Scene, tree_cast
from inverse.sheet import RESULTS

STEPS = {"fabric": 1e-4, "density": 1e-4, "body": 1e-6}  # of central differences; a share, a share, [m]
LOSSES = ("mean x", "stretch energy")
FRAMES = 6
ITERATIONS = (50, 100, 200, 400, 800, 1600)  # of a frame, without a tolerance
TOLERANCES = (1e-2, 1e-4, 1e-7)  # of a frame, with at most MOST iterations
MOST = 1600
LINEAR = (1e-2, 1e-3, 1e-5)  # of the linear system, besides the default


def losses(
    scene: Scene, change: dict[str, jax.Array], config: SimConfig, iterations: jax.Array | int
) -> tuple[jax.Array, Trajectory]:
    """Return both losses, and the motion."""
    material, body = scene.material, scene.body
    fabric = 1 + change["fabric"]
    stiffer = material.replace(
        lame_mu=material.lame_mu * fabric,
        lame_lambda=material.lame_lambda * fabric,
        bending_stiffness=material.bending_stiffness * fabric,
        density=material.density * (1 + change["density"]),
    )
    shift = change["body"] * jnp.array([[[1.0, 0.0, 0.0]]], body.positions.dtype)
    moved = scene.replace(material=stiffer, body=body.replace(positions=body.positions + shift))
    trajectory = rollout_scene(None, moved, config, iterations)
    return jnp.stack(
        [jnp.mean(trajectory.positions[-1, :, 0]), jnp.sum(trajectory.energies["stretch"])]
    ), trajectory


def unchanged() -> dict[str, jax.Array]:
    """Return no change of any parameter."""
    return dict.fromkeys(STEPS, jnp.zeros(()))


def reference(scene: Scene, iterations: int) -> np.ndarray:
    """Return central differences in float64, shape [parameters, losses]."""
    with jax.enable_x64(True):
        wide = tree_cast(jax.tree.map(jnp.asarray, scene), jnp.float64)
        run = jax.jit(lambda scene, change: losses(scene, change, SimConfig(tolerance=0.0), iterations)[0])
        rows = []
        for name, step in STEPS.items():
            ends = [
                np.asarray(run(wide, {**unchanged(), name: jnp.asarray(sign * step)})) for sign in (1.0, -1.0)
            ]
            rows.append((ends[0] - ends[1]) / (2 * step))
    return np.array(rows)


def loss(change: dict, scene: Scene, weights: jax.Array, iterations: jax.Array, config: SimConfig):
    """Return a weighted sum of the losses, and the motion."""
    both, trajectory = losses(scene, change, config, iterations)
    return both @ weights, trajectory


def measure(
    scenes: tuple[Scene, Scene], expected: np.ndarray, config: SimConfig, counts: tuple, turns: int
) -> dict:
    """Return errors of gradients in float32 (None: refused) and their cost, by bounds of iterations.

    `scenes` are the walk and its next frame, `expected` the right gradients, shape [parameters, losses]. Without
    turns no cost is measured.
    """
    walk, frame = scenes
    value = jax.jit(partial(loss, config=config))
    slope = jax.jit(jax.value_and_grad(partial(loss, config=config), has_aux=True))
    rows: dict = {}
    for count in counts:
        row = rows[count] = {}
        for index, name in enumerate(LOSSES):
            (_, motion), gradient = slope(unchanged(), walk, jnp.eye(2)[index], jnp.int32(count))
            found = np.array([float(gradient[parameter]) for parameter in STEPS])
            errors = np.abs(found / expected[:, index] - 1).tolist()
            row[name] = {
                key: None if np.isnan(error) else error for key, error in zip(STEPS, errors, strict=True)
            }
        row["residual"] = float(motion.residuals.max())
        if turns:
            arguments = (unchanged(), frame, jnp.ones(2), jnp.int32(count))
            times = time_in_turns({"value": (value, arguments), "gradient": (slope, arguments)}, turns)
            row["frame_ms"] = round(min(times["value"]), 1)
            row["cost"] = round(min(times["gradient"]) / min(times["value"]), 2)
        print(config.tolerance, count, row, flush=True)
    return rows


def main() -> None:
    options = parser(__doc__, "a few steps", RESULTS).parse_args()
    turns = 1 if options.smoke else 15
    counts, tolerances, linear = (
        (ITERATIONS[:1], (), ()) if options.smoke else (ITERATIONS, TOLERANCES, LINEAR)
    )
    frames = 2 if options.smoke else FRAMES
    poses = pose_body(load_body(), load_motion("cmu_016_32"), num_frames=frames + 1)
    scene = prepare_scene(load_garment("tshirt"), poses)
    walk = first_frames(scene, frames)
    # The reference is one more program to compile.
    expected = np.ones((len(STEPS), len(LOSSES))) if options.smoke else reference(walk, 3000)
    _, motion = losses(walk, unchanged(), SimConfig(tolerance=0.0), MOST)
    start = scene.initial_state.replace(
        position=motion.positions[-1], velocity=motion.velocities[-1], friction_load=motion.friction_loads[-1]
    )
    frame = slice_tracks(scene, slice(frames - 1, None)).replace(initial_state=start, num_frames=2)
    scenes = (walk, frame)
    result: dict = {"float64": {name: expected[:, i].tolist() for i, name in enumerate(LOSSES)}}
    result["iterations"] = measure(scenes, expected, SimConfig(), counts, turns)
    result["tolerance"] = {
        f"{tolerance:g}": measure(scenes, expected, SimConfig(tolerance=tolerance), (MOST,), turns)[MOST]
        for tolerance in tolerances
    }
    result["linear"] = {}
    default = solve._LINEAR_STOP["float32"]
    for share in linear:
        solve._LINEAR_STOP["float32"] = (share, default[1])
        jax.clear_caches()
        result["linear"][f"{share:g}"] = measure(scenes, expected, SimConfig(), (MOST,), 0)[MOST]
    solve._LINEAR_STOP["float32"] = default
    keep(options.out / "accuracy.json", result | environment())
