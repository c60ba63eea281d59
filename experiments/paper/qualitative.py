"""The paper's two figures: how the networks' cloth looks, and where it stores stretch energy.

    python experiments/paper qualitative [--models NAME ...] [--garments NAME ...] [--smoke]

Free rollouts on an unseen clip, the same frame of each. Our optimum takes the place of the paper's reference,
ARCSim. A name is one of `rollouts.read_system`. Writes qualitative.png (cloth), stretch_energy.png (energy per
area on cloth, one scale for all), stretch_energy_distribution.png (all faces and frames) and stretch_energy.json.
"""

from typing import Any

import harness
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.pipeline.assets import load_body, load_splits
from eslr_jax.pipeline.pictures import color_scale, render_frame, side_by_side, write_png
from eslr_jax.pipeline.report.report import environment
from eslr_jax.terms.stretch import stretch_energy
from eslr_jax.types import Scene
from paper.rollouts import OPTIMUM, RESULTS, read_system, roll
from paper.worn import Setting, Worn, check_optimum, not_finite

GARMENTS = ("tshirt", "dress")
DEEP = tuple(f"{name}-5-correction" for name in ("hood", "mgn", "gsa", "lsdmp", "eslr"))
MODELS = (*DEEP, "eslr-small", "smooth-small+20", OPTIMUM)
_SIZE = (240, 340)  # of a picture, width and height [pixels]
_CAMERA = 25.0  # [degrees] from the front towards the side
_FULL_SCALE = 0.98  # quantile of the optimum's energy per area at which the colours end
_SHARES = (0.5, 0.9, 0.99)  # quantiles in the table


@jax.jit
def face_energies(positions: Float[Array, "frames vertices 3"], scene: Scene) -> Float[Array, "frames faces"]:
    """Return the stretch energy of every face per area [J/m2]: it is linear in each face's thickness."""
    garment, material = scene.garment, scene.material
    thickness = jnp.broadcast_to(material.thickness, garment.rest_areas.shape)

    def frame(position: Float[Array, "vertices 3"]) -> Float[Array, " faces"]:
        def energy(thickness):
            return stretch_energy(position, garment, material.replace(thickness=thickness))

        return jax.grad(energy)(thickness) * thickness / jnp.maximum(garment.rest_areas, 1e-12)

    return jax.lax.map(frame, positions)


def at_vertices(energies: np.ndarray, scene: Scene) -> np.ndarray:
    """Return the mean over a vertex' faces, weighted by area."""
    corners, areas = np.asarray(scene.garment.faces).ravel(), np.asarray(scene.garment.rest_areas)
    count = len(scene.garment.rest_positions)
    total, weight = (np.bincount(corners, x.repeat(3), count) for x in (areas * energies, areas))
    return total / np.maximum(weight, 1e-12)


def draw_distribution(energies: dict[str, np.ndarray], path) -> None:
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6.4, 3.6))
    levels = np.geomspace(0.01, 1e3, 200)  # [J/m2]
    for name, values in energies.items():
        share = 1.0 - np.searchsorted(np.sort(values), levels) / len(values)
        axis.loglog(levels, np.maximum(share, 1e-7), label=name, color="#1b1b1b" if name == OPTIMUM else None)
    axis.set_ylim(1e-5, 1.2)
    axis.set_xlabel("stretch energy per area [J/m2]")
    axis.set_ylabel("share of faces above it")
    axis.grid(True, which="both", alpha=0.2)
    axis.legend(fontsize=8)
    figure.tight_layout()
    harness.save(figure, path)


def main() -> None:
    parser = harness.parser(__doc__, "the optimum on one garment, few frames", RESULTS)
    parser.add_argument("--vertices", default="1k", choices=["1k", "4k", "10k"])
    parser.add_argument("--frames", type=int, default=90, help="of every rollout")
    parser.add_argument("--models", nargs="+", default=list(MODELS), help="columns, the optimum added")
    parser.add_argument("--garments", nargs="+", default=list(GARMENTS), help="rows")
    chosen = parser.parse_args()
    clip = load_splits()["motions"]["test"][0]
    if chosen.smoke:
        chosen.models, chosen.garments, chosen.frames = [OPTIMUM], chosen.garments[:1], 5
    models, garments = list(dict.fromkeys([*chosen.models, OPTIMUM])), chosen.garments
    setting = Setting(tuple(garments), (clip,), chosen.frames, chosen.vertices)
    body = load_body()
    results: dict[tuple[str, str], tuple[Any, Worn, np.ndarray]] = {}
    broken = dict.fromkeys(models, 0.0)
    for name in models:
        system = read_system(name)
        for worn, _, trajectory in roll(system, setting):
            if name == OPTIMUM:
                check_optimum(trajectory, worn.garment)
            broken[name] += not_finite(trajectory) / len(garments)
            energies = face_energies(trajectory.positions, worn.scene)
            results[name, worn.garment] = np.asarray(trajectory.positions), worn, np.asarray(energies)
            print(name, worn.garment, flush=True)

    view = {"camera": _CAMERA, "size": _SIZE, "rest_positions": np.asarray(body.rest_positions), "rig": body}
    plain, colored = [], []
    for garment in garments:
        reference = results[OPTIMUM, garment][2][-1]
        limit = float(np.quantile(reference[reference > 0], _FULL_SCALE))
        for name in models:
            positions, (_, scene, poses), energies = results[name, garment]
            is_face = np.asarray(scene.garment.rest_areas) > 0
            cloth = positions[-1], np.asarray(scene.garment.faces)[is_face]
            mesh = (np.asarray(poses.positions)[-1], np.asarray(poses.faces), *cloth)
            colors = color_scale(at_vertices(energies[-1], scene), 0.0, limit)
            plain.append(render_frame(*mesh, **view))
            colored.append(render_frame(*mesh, **view, vertex_colors=colors))
    labels = [name.partition("@")[0] for name in models] * len(garments)
    for pictures, file in ((plain, "qualitative.png"), (colored, "stretch_energy.png")):
        write_png(chosen.out / file, side_by_side(pictures, labels, columns=len(models)))

    joined: dict[str, Any] = {}
    for (name, _), (_, worn, energies) in results.items():
        is_face = np.asarray(worn.scene.garment.rest_areas) > 0
        joined.setdefault(name, []).append(energies[1:][:, is_face].ravel())
    joined = {name: np.concatenate(parts) for name, parts in joined.items()}
    draw_distribution(joined, chosen.out / "stretch_energy_distribution.png")
    rows = {
        name: {
            "not_finite": broken[name],  # share of rollouts, see `worn.not_finite`
            "mean_j_m2": float(values.mean()),
            **{f"p{100 * share:g}_j_m2": float(np.quantile(values, share)) for share in _SHARES},
        }
        for name, values in joined.items()
    }
    result = {"clip": clip, "frames": chosen.frames, "vertices": chosen.vertices, "garments": garments}
    result |= {"mean": rows, "environment": environment()}
    harness.keep(chosen.out / "stretch_energy.json", result)
