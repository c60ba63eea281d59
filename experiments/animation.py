"""The README's animation: four garments on one walk, simulated as `eslr simulate` does.

    python experiments/animation.py [--smoke] [--out DIR]

Each garment is put on over the rest pose and simulated by the solver with BDF2, faces kept off the skin, every
frame within 1 % of its optimum. Writes animation.webp.
"""

import numpy as np
from docs_pictures import figures, shoot
from harness import parser
from PIL import Image

from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.pictures import side_by_side

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


def main() -> None:
    chosen = parser(__doc__, "one garment at 1k, three frames").parse_args()
    worn, frames, vertices = (WORN[:1], 5, "1k") if chosen.smoke else (WORN, _FRAMES, "4k")
    strips = []
    for name, fabric, color in worn:
        shot = shoot((name,), frames, fabric=(fabric,), vertices=vertices)
        print(f"{name}: {float(np.mean(shot.trajectory.iterations[1:])):.0f} iterations a frame", flush=True)
        look = {"vertex_colors": None, "garment_color": color, "camera": _CAMERA, "size": _SIZE}
        strips.append(figures(shot, range(0, frames, _EVERY), **look))
    labels = [f"{name}, {fabric}" for name, fabric, _ in worn]
    images = [Image.fromarray(side_by_side(row, labels)) for row in zip(*strips, strict=True)]
    with atomic_write(chosen.out / "animation.webp") as temporary:
        images[0].save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=images[1:] + images[-2:0:-1],  # forth and back: a loop without a jump
            duration=round(1000 * _EVERY * float(shot.scene.timestep)),
            loop=0,
            quality=50,
        )


if __name__ == "__main__":
    main()
