"""Let out a T-shirt that is too tight, so that its stretch on the body stays under a limit.

    python experiments/inverse fit [--smoke] [--out DIR]

The shirt is cut 3 cm narrower all around. Parameters say how far each band of it (four heights of the trunk, the
sleeves) is let out along its normals. The loss is the stretch on the body above the limit, after a few long
frames in which the cloth comes to rest, and a small price for letting out. Writes fit.json.
"""

import jax
import jax.numpy as jnp
import numpy as np
from harness import keep, parser

from eslr_jax import SimConfig, load_body, load_garment, pose_body, prepare_scene, rollout_scene
from eslr_jax.mesh.prepare import with_rest_positions
from eslr_jax.mesh.topology import vertex_normals
from eslr_jax.pipeline.report.report import environment
from eslr_jax.pose.motion import still_motion
from eslr_jax.pose.retarget import ARM_ABDUCTION
from eslr_jax.terms import FAST
from eslr_jax.terms.stretch import principal_stretches
from inverse.search import race
from inverse.sheet import RESULTS

BAR = 1.08  # largest principal stretch
TIGHT = -0.03  # [m], how far the shirt is taken in
UNIT = 0.02  # [m] of a parameter
PRICE = 1e-6  # of a squared parameter, besides squared strain
TIMESTEP = 0.1  # [s]: implicit Euler damps a long frame's motion away
BANDS = ("hem", "waist", "chest", "shoulders", "sleeves")


def band_weights(rest: np.ndarray) -> np.ndarray:
    """Return the share of every band in every vertex, shape [vertices, bands]; rows sum to one."""
    height = np.interp(rest[:, 1], np.quantile(rest[:, 1], [0.02, 0.98]), [0.0, 3.0])
    trunk = np.maximum(1 - np.abs(height[:, None] - np.arange(4)), 0.0)
    chest = np.quantile(np.abs(rest[rest[:, 1] < np.median(rest[:, 1]), 0]), 0.98)  # half the width [m]
    sleeve = np.clip((np.abs(rest[:, 0]) - chest) / 0.04, 0.0, 1.0)[:, None]
    return np.concatenate([trunk * (1 - sleeve), sleeve], axis=1)


def main() -> None:
    options = parser(__doc__, "a few steps", RESULTS).parse_args()
    frames, steps, turns = (2, 2, 1) if options.smoke else (5, 20, 9)
    config = SimConfig(iterations=20 if options.smoke else 100)
    body, garment = load_body(), load_garment("tshirt")
    still = pose_body(body, still_motion(body, frames, arm_angle=ARM_ABDUCTION))
    scene = prepare_scene(garment, still, terms=FAST).replace(timestep=jnp.float32(TIMESTEP))
    garment = scene.garment
    weights = jnp.asarray(band_weights(np.asarray(garment.rest_positions)), jnp.float32)
    normals = vertex_normals(np.asarray(garment.rest_positions), np.asarray(garment.faces))
    normals = jnp.asarray(normals, jnp.float32)

    def loss(parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the loss, and the larger principal stretch of every face."""
        ease = TIGHT + UNIT * (weights @ parameters)
        cut = with_rest_positions(garment, garment.rest_positions + ease[:, None] * normals)
        worn = rollout_scene(None, scene.replace(garment=cut), config).positions[-1]
        stretch = principal_stretches(worn, cut)[0]
        over = jnp.average(jnp.maximum(stretch - BAR, 0.0) ** 2, weights=garment.rest_areas)
        return over + PRICE * jnp.sum(parameters**2), stretch

    start = np.zeros(len(BANDS))
    both, cost, evaluations, by_gradient, simplex = race(loss, start, steps, turns, unit=1e-4)
    shirts = {"tight": start, "lbfgs": by_gradient.best, "nelder_mead": simplex.best}
    worn = {name: np.asarray(both(jnp.asarray(best, jnp.float32))[1]) for name, best in shirts.items()}
    areas = np.asarray(garment.rest_areas)
    result = {
        "bar": BAR,
        "bands": BANDS,
        "gradient_in_evaluations": round(cost, 2),
        "evaluations": evaluations,
        "refused": by_gradient.refused,
        "let_out_mm": {name: np.round(1e3 * UNIT * best, 1) for name, best in shirts.items()},
        "stretch_99": {name: stretch_below(0.99, stretch, areas) for name, stretch in worn.items()},
        "area_above_bar": {name: np.average(stretch > BAR, weights=areas) for name, stretch in worn.items()},
        "loss_1e-4": {"lbfgs": min(by_gradient.losses), "nelder_mead": min(simplex.losses)},
    }
    keep(options.out / "fit.json", result | environment())


def stretch_below(share: float, stretch: np.ndarray, areas: np.ndarray) -> float:
    """Return the stretch that this share of the cloth's area stays below."""
    order = np.argsort(stretch)
    covered = np.cumsum(areas[order]) / areas.sum()
    return float(stretch[order][np.searchsorted(covered, share)])
