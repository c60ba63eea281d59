"""Error and cost of gradients with the defaults: T-shirt and dress on a walk, after one, three and ten frames.

    python experiments/inverse accuracy [--smoke] [--out DIR]

The loss is the garment's mean height, the parameters are stretch stiffness, bending stiffness, density and a lift
of the body. Float32 is compared with central differences in float64. A crumpled sheet has many minima beside each
other, so float64 starts each frame where float32 came to rest; how far it goes from there is in the result. The
cost is the processor time of loss and gradient over that of the loss alone, in turns. Writes accuracy.json.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import keep, machine, parser

from eslr_jax import SimConfig, Trajectory, load_body, load_garment, load_motion, pose_body, rollout_scene
from eslr_jax.fabric.materials import COTTON
from eslr_jax.simulation.frame import frame_inputs, frame_problem
from eslr_jax.simulation.scene import build_scene
from eslr_jax.simulation.stepper import next_state
from eslr_jax.solver.guess import Start
from eslr_jax.solver.solve import solve
from eslr_jax.terms import CLOTH, Collision, Friction
from eslr_jax.types import Scene, tree_cast
from inverse.sheet import RESULTS

GARMENTS = ("tshirt", "dress")
FRAMES = (1, 3, 10)  # after which the loss is taken
STEPS = {"stretch": 1e-4, "bending": 1e-4, "density": 1e-4, "lift": 1e-6}  # of differences; shares, and [m]
TURNS = 5
ITERATIONS = 3000  # of a frame in float64

Change = dict[str, jax.Array]


def walk(garment: str, frames: int) -> Scene:
    """Return the scene that `rollout(None, garment, poses)` simulates."""
    poses = pose_body(load_body(), load_motion("cmu_016_32"), num_frames=frames + 1)
    return build_scene(load_garment(garment), poses, COTTON, (*CLOTH, Collision(), Friction()))


def changed(scene: Scene, change: Change) -> Scene:
    """Return the scene with its fabric scaled and its body lifted."""
    material, body = scene.material, scene.body
    lift = change["lift"] * jnp.array([[[0.0, 1.0, 0.0]]], body.positions.dtype)
    return scene.replace(
        material=material.replace(
            lame_mu=material.lame_mu * (1 + change["stretch"]),
            lame_lambda=material.lame_lambda * (1 + change["stretch"]),
            bending_stiffness=material.bending_stiffness * (1 + change["bending"]),
            density=material.density * (1 + change["density"]),
        ),
        body=body.replace(positions=body.positions + lift),
    )


def unchanged() -> Change:
    return dict.fromkeys(STEPS, jnp.zeros(()))


def height(change: Change, scene: Scene, frame: jax.Array | int) -> tuple[jax.Array, Trajectory]:
    """Return the mean height at a frame [m], and the motion."""
    trajectory = rollout_scene(None, changed(scene, change), SimConfig())
    return trajectory.positions[frame, :, 1].mean(), trajectory


def differences(scene: Scene, rests: np.ndarray, iterations: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the derivatives at every frame in float64, and how far each minimum is from where float32 rests."""

    @jax.jit
    def solved(scene: Scene, rests: jax.Array) -> tuple[jax.Array, jax.Array]:
        def advance(state: Any, frame: Any) -> tuple[Any, tuple]:
            inputs, rest = frame
            problem = frame_problem(scene, state, inputs)
            position = solve(problem, Start(rest, jnp.zeros(())), iterations=iterations).position
            moved = jnp.median(jnp.linalg.norm(position - rest, axis=1))
            return next_state(position, problem, state, jnp.int32(0)), (position[:, 1].mean(), moved)

        return jax.lax.scan(advance, scene.initial_state, (frame_inputs(scene), rests))[1]

    with jax.enable_x64(True):
        wide = tree_cast(jax.tree.map(jnp.asarray, scene), jnp.float64)
        starts = jnp.asarray(rests, jnp.float64)
        found = {}
        for name, step in STEPS.items():
            ends = [
                solved(changed(wide, unchanged() | {name: jnp.asarray(sign * step)}), starts)[0]
                for sign in (1, -1)
            ]
            found[name] = np.asarray(ends[0] - ends[1]) / (2 * step)
        return found, np.asarray(solved(wide, starts)[1])


def measure(garment: str, frames: tuple[int, ...], turns: int, iterations: int) -> dict[str, Any]:
    scene = jax.tree.map(jnp.asarray, walk(garment, frames[-1]))
    value, slope = jax.jit(height), jax.jit(jax.value_and_grad(height, has_aux=True))
    found = {frame: slope(unchanged(), scene, frame) for frame in frames}
    motion = found[frames[-1]][0][1]
    expected, moved = differences(scene, np.asarray(motion.positions[1:]), iterations)
    rows = {
        str(frame): {
            name: {
                "gradient": float(gradient[name]),
                "differences": float(expected[name][frame - 1]),
                "error": abs(float(gradient[name]) / float(expected[name][frame - 1]) - 1),
            }
            for name in STEPS
        }
        for frame, (_, gradient) in found.items()
    }
    plain = value(unchanged(), scene, frames[-1])[1]
    arguments = (unchanged(), scene, frames[-1])
    costs = [processor_time(slope, arguments) / processor_time(value, arguments) for _ in range(turns)]
    return {
        "gradients": rows,
        "moved_m": moved.tolist(),
        "status": int(motion.status),
        "iterations": {"motion": plain.iterations[1:], "derivative": motion.iterations[1:]},
        "cost": float(np.median(costs)),
    }


def processor_time(function: Callable, arguments: tuple) -> float:
    began = time.process_time()
    jax.block_until_ready(function(*arguments))
    return time.process_time() - began


def main() -> None:
    options = parser(__doc__, "one frame of one garment, few iterations", RESULTS).parse_args()
    garments, frames, turns, iterations = GARMENTS, FRAMES, TURNS, ITERATIONS
    if options.smoke:
        garments, frames, turns, iterations = GARMENTS[:1], (1,), 1, 300
    rows = {garment: measure(garment, frames, turns, iterations) for garment in garments}
    for garment, row in rows.items():
        print(f"{garment}: cost {row['cost']:.1f}, status {row['status']}")
        for frame, gradients in row["gradients"].items():
            print(f"  {frame} frames:", {name: f"{one['error']:.2%}" for name, one in gradients.items()})
    keep(options.out / "accuracy.json", rows | machine())
