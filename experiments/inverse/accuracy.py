"""How far the gradient of a walking T-shirt is off, by what the solver and the linear system leave.

    python experiments/inverse/accuracy.py [--smoke] [--out DIR]

Two losses after five frames (the shirt's mean x, its stretch energy in all frames) by three parameters (stiffness
of the fabric, density, a shift of the body), in float32 as a user has it. They are held against central
differences in float64 with a solver that ends where float64 ends. A cost is the time of loss and gradient over
the time of the loss alone, in turns. Writes accuracy.json and accuracy.png.
"""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from sheet import keep, parse_options

from eslr_jax.assets import load_body, load_garment, load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.config import SimConfig
from eslr_jax.evaluation.scene_parts import time_in_turns
from eslr_jax.physics import solve
from eslr_jax.scene.plan import prepare_scene
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.types import Scene, tree_cast

STEPS = {"fabric": 1e-4, "density": 1e-4, "body": 1e-6}  # of central differences; a share, a share, [m]
LOSSES = ("mean x", "stretch energy")
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)  # of a frame
LINEAR = (1e-1, 1e-2, 1e-4)  # of the linear system, besides the default


def losses(scene: Scene, change: dict[str, jax.Array], config: SimConfig) -> tuple[jax.Array, jax.Array]:
    """Return both losses, and the largest residual of a frame."""
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
    trajectory = rollout_scene(None, moved, config)
    both = jnp.stack([jnp.mean(trajectory.positions[-1, :, 0]), jnp.sum(trajectory.terms.stretch)])
    return both, trajectory.residuals.max()


def reference(scene: Scene, iterations: int) -> np.ndarray:
    """Return central differences in float64, shape [parameters, losses]."""
    with jax.enable_x64(True):
        wide = tree_cast(jax.tree.map(jnp.asarray, scene), jnp.float64)
        run = jax.jit(lambda scene, change: losses(scene, change, SimConfig(iterations=iterations))[0])
        zeros = dict.fromkeys(STEPS, jnp.zeros(()))
        rows = []
        for name, step in STEPS.items():
            ends = [np.asarray(run(wide, {**zeros, name: jnp.asarray(sign * step)})) for sign in (1.0, -1.0)]
            rows.append((ends[0] - ends[1]) / (2 * step))
    return np.array(rows)


def measure(scene: Scene, tolerance: float, expected: np.ndarray, turns: int) -> dict:
    """Return errors and cost of the float32 gradients at a tolerance of the frames."""
    config = SimConfig(iterations=1500, tolerance=tolerance)
    zeros = dict.fromkeys(STEPS, jnp.zeros(()))

    def loss(change: dict, scene: Scene, weights: jax.Array) -> tuple[jax.Array, jax.Array]:
        both, residual = losses(scene, change, config)
        return both @ weights, residual

    value, slope = jax.jit(loss), jax.jit(jax.value_and_grad(loss, has_aux=True))
    row: dict = {}
    for index, name in enumerate(LOSSES):
        (_, residual), gradient = slope(zeros, scene, jnp.eye(2)[index])
        found = np.array([float(gradient[parameter]) for parameter in STEPS])
        row[name] = dict(zip(STEPS, np.abs(found / expected[:, index] - 1).tolist(), strict=True))
    row["residual"] = float(residual)
    arguments = (zeros, scene, jnp.eye(2)[0])
    times = time_in_turns({"value": (value, arguments), "gradient": (slope, arguments)}, turns)
    row["loss_ms_per_frame"] = round(float(np.median(times["value"])) / (scene.num_frames - 1), 1)
    row["cost"] = round(float(np.median(np.array(times["gradient"]) / np.array(times["value"]))), 2)
    return row


def main() -> None:
    """Measure all tolerances of the frame, and of the linear system at the second tightest of them."""
    options = parse_options(__doc__)
    turns, iterations = (1, 300) if options.smoke else (7, 3000)
    body = load_body()
    poses = pose_body(body, load_motion("cmu_016_32"), num_frames=2 if options.smoke else 6)
    scene = prepare_scene(load_garment("tshirt"), poses)
    expected = reference(scene, iterations)
    default = solve._LINEAR_STOP["float32"]
    tolerances = TOLERANCES[:1] if options.smoke else TOLERANCES
    result: dict = {"float64": {name: expected[:, i].tolist() for i, name in enumerate(LOSSES)}}
    result["frame"] = {
        f"{tolerance:g}": measure(scene, tolerance, expected, turns) for tolerance in tolerances
    }
    result["linear"] = {}
    for linear in () if options.smoke else LINEAR:
        solve._LINEAR_STOP["float32"] = (linear, default[1])
        jax.clear_caches()
        result["linear"][f"{linear:g}"] = measure(scene, TOLERANCES[-2], expected, turns)
    solve._LINEAR_STOP["float32"] = default
    keep(options.out, Path(__file__).stem, result, draw(result["frame"]))


def draw(rows: dict[str, dict]) -> plt.Figure:
    """Return the errors by the tolerance of a frame."""
    figure, axis = plt.subplots(figsize=(7, 5), layout="constrained")
    for style, name in zip("-:", LOSSES, strict=True):
        for color, parameter in enumerate(STEPS):
            errors = [row[name][parameter] for row in rows.values()]
            places = [float(tolerance) for tolerance in rows]
            axis.loglog(places, errors, f"C{color}o{style}", label=f"{name} by {parameter}")
    axis.set(xlabel="tolerance of a frame", ylabel="relative error of the gradient")
    axis.legend()
    return figure


if __name__ == "__main__":
    main()
