"""The README's animation: four garments on one walk, simulated as `eslr simulate` does.

    python experiments/animation.py [--smoke] [--out DIR]

Each garment is put on over the rest pose and simulated by the solver with BDF2, faces kept off the skin, every
frame within 1 % of its optimum.
Writes animation.webp.
"""

from __future__ import annotations

import numpy as np
from harness import parser
from PIL import Image

from eslr_jax.config import SimConfig
from eslr_jax.fabric.materials import fabric_material
from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.assets import load_body, load_garment, load_motion
from eslr_jax.pipeline.pictures import render_frames, side_by_side
from eslr_jax.pose.motion import pose_body
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling
from eslr_jax.simulation.plan import prepare_scene
from eslr_jax.simulation.simulate import simulate

CLIP = "cmu_069_23"
# Garment, fabric, and colour in sRGB.
WORN = (
    ("tshirt", "jersey", (0.30, 0.50, 0.70)),
    ("dress", "satin", (0.70, 0.28, 0.36)),
    ("longsleeve", "ponte", (0.36, 0.58, 0.42)),
    ("pants", "cotton", (0.36, 0.36, 0.55)),
)
_FRAMES, _EVERY = 91, 2  # of the motion, simulated; and shown, one in so many
_SIZE = (190, 340)  # of one garment, width and height [pixels]
_CAMERA = 20.0  # [degrees] from the front towards the side
_CONFIG = SimConfig(iterations=300, tolerance=1e-2)


def main() -> None:
    chosen = parser(__doc__, "one garment at 1k, three frames").parse_args()
    worn, frames, vertices = (WORN[:1], 5, "1k") if chosen.smoke else (WORN, _FRAMES, "4k")
    body = load_body()
    poses = pose_body(body, load_motion(CLIP), num_frames=frames)
    moving, strips = with_settling(poses, SETTLE_FRAMES, body), []
    look = {"rest_positions": np.asarray(poses.rest_positions), "rig": body, "camera": _CAMERA, "size": _SIZE}
    for name, fabric, color in worn:
        options = {"integrator": "bdf2"}
        scene = prepare_scene(
            load_garment(name, vertices=vertices), moving, material=fabric_material(fabric), **options
        )
        trajectory = simulate(None, scene, config=_CONFIG).trajectory
        print(f"{name}: {float(np.mean(trajectory.iterations[1:])):.0f} iterations a frame", flush=True)
        cloth = np.asarray(trajectory.positions)[SETTLE_FRAMES:], np.asarray(scene.garment.faces)
        shown = {"frame_indices": range(0, frames, _EVERY), "garment_color": color, **look}
        strips.append(
            list(render_frames(np.asarray(poses.positions), np.asarray(poses.faces), *cloth, **shown))
        )
    labels = [f"{name}, {fabric}" for name, fabric, _ in worn]
    images = [Image.fromarray(side_by_side(row, labels)) for row in zip(*strips, strict=True)]
    with atomic_write(chosen.out / "animation.webp") as temporary:
        images[0].save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=images[1:] + images[-2:0:-1],  # forth and back: a loop without a jump
            duration=round(1000 * _EVERY * float(poses.timestep)),
            loop=0,
            quality=50,
        )


if __name__ == "__main__":
    main()
