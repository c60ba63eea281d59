"""Recover two stiffnesses and the density of a fabric from the positions of a swinging sheet.

    python experiments/inverse fabric [--smoke] [--out DIR]

The sheet hangs from two corners, one of which a hand moves. Motion in the air shows only stiffness over density;
a washer of known mass on a free corner tells the three apart. "Measured" is a simulation with the true fabric,
without noise. Writes fabric.json and fabric.png.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from harness import keep, parser, save

from eslr_jax import Material, SimConfig, rollout_scene
from eslr_jax.fabric.materials import COTTON
from eslr_jax.pipeline.report.report import environment
from eslr_jax.types import Scene
from inverse.search import Search, descend, gradient_cost, search_simplex
from inverse.sheet import RESULTS, TIMESTEP, held_scene, square

SIDE, SIZE = 11, 0.3  # vertices, [m]
FRAMES = 13
WASHER = 0.004  # [kg]; the sheet has 0.018
BENDING = 8e-4  # [J], of a stiff canvas: it folds in few places, and its motion is a smooth function
NAMES = ("stretch stiffness", "bending stiffness", "density")
STARTS = ((3.0, 0.33, 2.0), (0.4, 3.0, 0.5), (2.0, 2.0, 0.5))  # factors on the truth
BAR = 0.05  # of every factor


def make_scene() -> Scene:
    """Return the sheet, level and at rest, with one of its two pinned corners moved by 4 cm to and fro."""
    swing = np.sin(2 * np.pi * TIMESTEP * np.arange(FRAMES) / 0.4)
    shift = np.zeros((FRAMES, SIDE * SIDE, 3), np.float32)
    shift[:, 0, 0], shift[:, 0, 2] = 0.04 * swing, 0.03 * swing
    return held_scene(square(SIDE, SIZE, [0, SIDE - 1]), jnp.asarray(shift))


def fabric(logs: jax.Array, scene: Scene) -> Material:
    """Return the fabric with the washer from the logarithms of its three factors."""
    stretch, bending, density = jnp.exp(logs)
    washer = jnp.zeros(SIDE * SIDE).at[-1].set(WASHER) / scene.garment.vertex_areas
    return COTTON.replace(
        lame_mu=COTTON.lame_mu * stretch,
        lame_lambda=COTTON.lame_lambda * stretch,
        bending_stiffness=BENDING * bending,
        density=COTTON.density * density + washer,
    )


def main() -> None:
    options = parser(__doc__, "a few steps", RESULTS).parse_args()
    steps, turns, iterations = (3, 1, 30) if options.smoke else (25, 25, 150)
    scene = make_scene()

    def simulate(logs: jax.Array) -> jax.Array:
        changed = scene.replace(material=fabric(logs, scene))
        return rollout_scene(None, changed, SimConfig(iterations=iterations)).positions

    def loss(logs: jax.Array) -> jax.Array:
        return jnp.mean(jnp.sum((simulate(logs) - measured) ** 2, axis=-1)) * 1e6  # [mm^2]

    measured = simulate(jnp.zeros(3))
    value, value_and_grad = jax.jit(loss), jax.jit(jax.value_and_grad(loss))
    cost = gradient_cost(value, value_and_grad, np.log(STARTS[0]), turns)
    runs = []
    for start in np.log(STARTS[:1] if options.smoke else STARTS):
        by_gradient = descend(value_and_grad, start, steps)
        runs.append((by_gradient, search_simplex(value, start, round(cost * steps))))
    result = {
        "what": NAMES, "starts": STARTS, "gradient_in_evaluations": round(cost, 2),
        "lbfgs": [report(run, cost) for run, _ in runs],
        "nelder_mead": [report(run, 1.0) for _, run in runs], "sensitivity_mm": sensitivities(simulate),
    }  # fmt: skip
    keep(options.out / "fabric.json", result | environment())
    save(draw(runs, cost, np.asarray(measured), scene), options.out / "fabric.png")


def report(run: Search, cost: float) -> dict:
    """Return the factors that a search ended with, and what it took."""
    factors = np.exp(run.best)
    return {
        "factors": np.round(factors.astype(float), 4),
        "is_recovered": bool(np.all(np.abs(factors - 1) < BAR)),
        "evaluations": round(cost * len(run.losses)),
        "rms_mm": float(np.sqrt(min(run.losses))),
        "refused": run.refused,
    }


def sensitivities(simulate) -> dict[str, float]:
    """Return the least that positions move [mm, root mean square] for a factor of e.

    One direction is the easiest change to see, one the hardest; the third lies between. What no motion shows, as
    all three at once without a washer, would be zero.
    """
    moves = [(simulate(0.1 * axis) - simulate(-0.1 * axis)).ravel() / 0.2 * 1e3 for axis in jnp.eye(3)]
    singular = np.linalg.svd(np.stack(moves), compute_uv=False)
    scale = np.sqrt(len(moves[0]) / 3)
    return dict(zip(("most", "middle", "least"), (singular / scale).tolist(), strict=True))


def draw(runs: list[tuple[Search, Search]], cost: float, measured: np.ndarray, scene: Scene) -> plt.Figure:
    figure = plt.figure(figsize=(12, 5), layout="constrained")
    motion = figure.add_subplot(1, 2, 1, projection="3d")
    shades = plt.get_cmap("viridis")(np.linspace(0, 0.9, FRAMES))
    for index in range(0, FRAMES, 4):
        x, y, z = measured[index].T
        faces = np.asarray(scene.garment.faces)
        motion.plot_trisurf(x, z, y, triangles=faces, color=shades[index], edgecolor="k", linewidth=0.1)
    motion.set(title="frames 0, 4, 8 and 12")
    for axis, name in zip((motion.xaxis, motion.yaxis, motion.zaxis), "xzy", strict=True):
        axis.set_label_text(f"{name} [m]")
        axis.labelpad = 10  # [points], beside the numbers
        axis.set_major_locator(plt.MaxNLocator(4))
    curve = figure.add_subplot(1, 2, 2)
    for index, (by_gradient, simplex) in enumerate(runs):
        evaluations = cost * np.arange(1, len(by_gradient.losses) + 1)
        lowest = np.sqrt(np.minimum.accumulate(by_gradient.losses))
        curve.semilogy(evaluations, lowest, f"C{index}-", label=f"start {STARTS[index]}")
        curve.semilogy(np.sqrt(np.minimum.accumulate(simplex.losses)), f"C{index}:")
    curve.set(xlabel="evaluations of the loss (a gradient counts by its time)", ylabel="distance, rms [mm]")
    curve.set_title("solid: L-BFGS, dotted: Nelder-Mead")
    curve.legend(loc="lower left")
    return figure
