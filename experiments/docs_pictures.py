"""The pictures of the guides.

    python experiments/docs_pictures.py [--smoke] [--only NAME ...] [--out DIR]

Writes PNG files of less than 150 kB. Figures of other experiments are copied from experiments/results. The
picture of `eslr play` needs Chromium and the package playwright; without them it is left as it is.
"""

import dataclasses
import shutil
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from flax import struct
from harness import EXPERIMENTS, RESULTS, parser
from other_bodies import child
from PIL import Image, ImageDraw
from scipy.spatial import Delaunay

from eslr_jax import SimConfig, load_body, load_motion, pose_body, prepare_scene, simulate
from eslr_jax.fabric.materials import WOVEN, fabric_names
from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.assets import load_garment_file, prepare_stored
from eslr_jax.pipeline.assets.garments import MEAN_SHAPE
from eslr_jax.pipeline.drape import TABLE, hang
from eslr_jax.pipeline.dressing.fit import fit_garment
from eslr_jax.pipeline.dressing.options import FitOptions
from eslr_jax.pipeline.dressing.outfit import wear_together
from eslr_jax.pipeline.dressing.panels import join_panels
from eslr_jax.pipeline.dressing.sewing import pattern_posture
from eslr_jax.pipeline.fabrics import describe_fabric, garment_material
from eslr_jax.pipeline.formats.export import export_trajectory
from eslr_jax.pipeline.formats.garment import read_garment_source
from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequences
from eslr_jax.pipeline.formats.obj import obj_text
from eslr_jax.pipeline.formats.palette import outfit_colors
from eslr_jax.pipeline.formats.pattern import read_pattern
from eslr_jax.pipeline.pictures import add_color_bar, color_scale, render_frames, side_by_side
from eslr_jax.pipeline.report.fields import Field, run_field
from eslr_jax.pipeline.report.gap import gap_medians, trajectory_gap
from eslr_jax.pipeline.report.run import read_run, write_run
from eslr_jax.pipeline.report.score import EVERY, foreign_trajectory
from eslr_jax.pipeline.rigs.rig import make_body
from eslr_jax.pose.lbs import skin_garment
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling
from eslr_jax.simulation.simulate import last_frames
from eslr_jax.terms import Term, scene_terms
from eslr_jax.terms.term import FrameProblem

COPIED = {
    "speed": RESULTS / "speed_vs_error.png",
    "train": RESULTS / "hood_5_curves.png",  # `eslr train` wrote it
    "gradients": RESULTS / "inverse" / "fabric.png",
}
MOST_BYTES = 150_000
_SIZE = (230, 330)  # of one figure, width and height [pixels]
_CAMERA = 25.0  # [degrees] from the front towards the side
_CONFIG = SimConfig(iterations=300, tolerance=1e-2)
_FRAMES, _SMOKE_FRAMES = 40, 3
_CLIP = "cmu_069_23"
PATTERN = EXPERIMENTS.parent / "data" / "patterns" / "tshirt.json"
_PANEL = 150.0  # [pixels/m] of a flat panel
_WIND = 4.0  # [N/m2], of the guide's own energy


@dataclasses.dataclass(frozen=True)
class Shot:
    """A simulated scene."""

    stored: Any  # GarmentFile
    body: Any
    poses: Any
    scene: Any
    trajectory: Any


def main() -> None:
    options = parser(__doc__, "two pictures of few frames", EXPERIMENTS.parent / "docs" / "images")
    options.add_argument("--only", nargs="*", choices=[*COPIED, *PICTURES])
    chosen = options.parse_args()
    frames = _SMOKE_FRAMES if chosen.smoke else _FRAMES
    names = chosen.only or (["install", "first-cloth"] if chosen.smoke else [*COPIED, *PICTURES])
    for name in names:
        if name in COPIED:
            picture = np.asarray(Image.open(COPIED[name]).convert("RGB"))
        else:
            picture = PICTURES[name](frames)
        if picture is not None:
            print(write_small(chosen.out / f"{name}.png", picture), flush=True)


def write_small(path: Path, picture: np.ndarray) -> str:
    """Write a picture as PNG with a palette of 256 colours, scaled down until it is small; return what it is."""
    image = Image.fromarray(picture)
    while True:
        with atomic_write(path) as temporary:
            image.quantize(256, dither=Image.Dither.NONE).save(temporary, format="PNG", optimize=True)
        if path.stat().st_size < MOST_BYTES:
            return f"{path}: {image.width} x {image.height}, {path.stat().st_size} bytes"
        image = image.resize((round(0.9 * image.width), round(0.9 * image.height)), Image.Resampling.LANCZOS)


def shoot(
    garments: tuple[str, ...],
    frames: int,
    *,
    fabric: tuple[str, ...] = (),
    vertices: Literal["1k", "4k", "10k"] = "1k",
    others: tuple[Term, ...] = (),
) -> Shot:
    """Put garments on and simulate them on a walk, as `eslr simulate` does."""
    body = load_body()
    poses = pose_body(body, load_motion(_CLIP), num_frames=frames)
    stored = wear_together([load_garment_file(name, vertices=vertices) for name in garments], garments)
    cloth = prepare_stored(stored, name="+".join(garments))
    made = {"material": garment_material(fabric, cloth, stored), "terms": scene_terms(*others)}
    scene = prepare_scene(cloth, with_settling(poses, SETTLE_FRAMES, body), integrator="bdf2", **made)
    run = simulate(None, scene, config=_CONFIG)
    trajectory, scene = last_frames(run.trajectory, run.scene, frames)
    return Shot(stored, body, poses, scene, trajectory)


def figures(shot: Shot, indices: Sequence[int], **options: Any) -> list[np.ndarray]:
    cloth = shot.trajectory.positions, shot.scene.garment.faces
    mesh = map(np.asarray, (shot.poses.positions, shot.poses.faces, *cloth))
    colors = outfit_colors(list(shot.stored.outfit.values()))
    look = {"camera": _CAMERA, "size": _SIZE, "vertex_colors": colors, **options}
    look |= {"rest_positions": np.asarray(shot.poses.rest_positions), "rig": shot.body}
    return list(render_frames(*mesh, frame_indices=indices, **look))


def spread(frames: int, count: int) -> tuple[list[int], list[str]]:
    """Return so many frames from the first to the last, and their times as labels."""
    indices = np.linspace(0, frames - 1, count).round().astype(int).tolist()
    return indices, [f"{k / 30:.2f} s" for k in indices]


def worn(stored: Any, body: Any, positions: np.ndarray | None = None, **options: Any) -> np.ndarray:
    """Render a garment on a body at rest."""
    rest = np.asarray(body.rest_positions)
    cloth = stored.rest_positions if positions is None else positions
    look = {"camera": _CAMERA, "size": _SIZE, "rest_positions": rest, "rig": body, **options}
    return next(render_frames(rest[None], np.asarray(body.faces), cloth[None], stored.faces, **look))


def install(_: int) -> np.ndarray:
    """The bundled garments on the bundled body."""
    body = load_body()
    names = ("tshirt", "longsleeve", "dress", "pants", "shorts")
    return side_by_side([worn(load_garment_file(name), body, size=(190, 330)) for name in names], names)


def first_cloth(frames: int) -> np.ndarray:
    """A T-shirt on a walk."""
    indices, labels = spread(frames, 4)
    return side_by_side(figures(shoot(("tshirt",), frames), indices), labels)


def own_garment(_: int) -> np.ndarray:
    """A shirt in centimetres, lying on its back, before and after the fit."""
    body, tshirt = load_body(), load_garment_file("tshirt")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "shirt.obj"
        scanned = 100 * np.stack([tshirt.rest_positions[:, k] for k in (0, 2, 1)], axis=1) * [1, -1, 1]
        file.write_text(obj_text("shirt", scanned, tshirt.faces))
        fitted = fit_garment(read_garment_source(file), body, FitOptions())
    lying = scanned / 100
    floor = np.asarray(body.rest_positions)[:, 1].min()
    lying += [-0.75, floor, 0.2] - np.array([lying[:, 0].mean(), lying[:, 1].min(), lying[:, 2].mean()])
    pictures = [worn(fitted, body, lying, size=(360, 330)), worn(fitted, body, size=(360, 330))]
    return side_by_side(pictures, ("before", "fitted"))


def own_body(_: int) -> np.ndarray:
    """A dress on three shapes of the bundled body, and on a child."""
    shapes = {"average": (), "tall": (2.0,), "short": (-2.0,)}
    bodies = {name: load_body(betas=betas) for name, betas in shapes.items()} | {"child": make_body(child())}
    heights = np.array([np.ptp(np.asarray(body.rest_positions)[:, 1]) for body in bodies.values()])
    pictures = [
        worn(load_garment_file("dress", body=body), body, zoom=float(size))
        for body, size in zip(bodies.values(), heights / heights.max(), strict=True)
    ]
    return side_by_side(pictures, list(bodies))


def outfits(frames: int) -> np.ndarray:
    """Trousers and a T-shirt over them."""
    shot = shoot(("pants", "tshirt"), frames, fabric=("pants:denim", "tshirt:jersey"))
    indices, labels = spread(frames, 3)
    return side_by_side(figures(shot, indices), labels)


def fabrics(frames: int) -> np.ndarray:
    """A disc of every fabric, hung over a round table as in Cusick's test."""
    names = (*fabric_names(), *WOVEN)
    size = {"spacing": 0.03, "frames": frames} if frames == _SMOKE_FRAMES else {}
    pictures = []
    for name in names:
        hung = hang(describe_fabric(name), **size)
        shown = {"camera": _CAMERA, "size": (190, 110), "zoom": 1.1}
        held = np.flatnonzero(np.hypot(hung.flat[:, 0], hung.flat[:, 2]) < TABLE)  # the ring that lies inside
        over = held[Delaunay(hung.flat[held][:, [0, 2]]).simplices]
        faces = np.concatenate([hung.faces, over])
        pictures.append(next(render_frames(None, None, hung.positions[None], faces, **shown)))
    return side_by_side(pictures, names, columns=4)


def extend(frames: int) -> np.ndarray:
    """A T-shirt without and with the guide's own energy."""
    blown = shoot(("tshirt",), frames, others=(Push(_WIND),))
    still = shoot(("tshirt",), frames, others=(Push(0.0),))
    pictures = [figures(shot, [frames - 1], camera=0.0)[0] for shot in (still, blown)]
    return side_by_side(pictures, ("0 N/m2", f"{_WIND:g} N/m2"))


@struct.dataclass
class Push(Term):
    """The guide's own energy: a steady wind along x."""

    name = "push"
    on = "vertices"

    pressure: float  # [N/m^2]

    def corner_energies(self, corners: tuple, problem: FrameProblem, data: None) -> jax.Array:
        """Return the energy of every vertex [J]."""
        return -self.pressure * problem.garment.vertex_areas * (corners[0][0] - problem.position[:, 0])


def report(frames: int) -> np.ndarray:
    """Stretch of a long-sleeved shirt, and its distance from the body."""
    shot = shoot(("longsleeve",), frames)
    pictures = []
    for name in ("stretch", "distance"):
        field = field_of(shot, name)
        label = f"{name} [{field.unit}]" if field.unit else name
        pictures.append(add_color_bar(colored(shot, field, field.high), field.low, field.high, label))
    return np.concatenate(pictures, axis=1)


def score(frames: int) -> np.ndarray:
    """What a T-shirt leaves above its optimum: carried by the joints, and simulated."""
    shot = shoot(("tshirt",), frames)
    carried = jax.jit(skin_garment)(shot.scene.garment, shot.poses.joint_transforms)
    shots = (dataclasses.replace(shot, trajectory=foreign_trajectory(carried, shot.scene)), shot)
    fields = [field_of(each, "gap") for each in shots]
    shares = []
    for each in shots:
        ends = trajectory_gap(each.trajectory, each.scene, every=EVERY)
        shares.append(gap_medians(ends, ends.reached)["gap_relative_median"])
    pictures = [colored(each, field, fields[0].high) for each, field in zip(shots, fields, strict=True)]
    names = ("carried by the joints", "simulated")
    labels = [f"{name}: {100 * share:.3g} %" for name, share in zip(names, shares, strict=True)]
    return add_color_bar(side_by_side(pictures, labels), 0.0, fields[0].high, f"gap [{fields[0].unit}]")


def field_of(shot: Shot, name: str) -> Field:
    """Return a field of a scene, as `eslr render --color` shows it."""
    with tempfile.TemporaryDirectory() as folder:
        write_run(Path(folder), shot.trajectory, shot.scene, (shot.body, shot.poses, shot.stored), report={})
        return run_field(read_run(Path(folder)), name)


def colored(shot: Shot, field: Field, high: float) -> np.ndarray:
    """Render the last frame of a scene in the colours of a field, yellow from a value on."""
    colors = color_scale(field.values, field.low, high)
    return figures(shot, [len(field.values) - 1], vertex_colors=colors)[0]


def studio(frames: int) -> np.ndarray:
    """An outfit on a walk, drawn from its Alembic file: meshes alone."""
    shot = shoot(("pants", "tshirt"), frames)
    with tempfile.TemporaryDirectory() as folder:
        write_run(Path(folder), shot.trajectory, shot.scene, (shot.body, shot.poses, shot.stored), report={})
        run = read_run(Path(folder)).trajectory
        path = export_trajectory(run, Path(folder) / "run.abc", garment=shot.stored)
        *cloths, body = read_mesh_sequences(path)
    counts = [cloth.positions.shape[1] for cloth in cloths]
    starts = np.cumsum([0, *counts])
    faces = np.concatenate([cloth.faces + start for cloth, start in zip(cloths, starts, strict=False)])
    positions = np.concatenate([cloth.positions for cloth in cloths], axis=1)
    indices, labels = spread(frames, 4)
    look = {"camera": _CAMERA, "size": _SIZE, "vertex_colors": outfit_colors(counts)}
    pictures = render_frames(body.positions, body.faces, positions, faces, frame_indices=indices, **look)
    return side_by_side(list(pictures), labels)


def limits(frames: int) -> np.ndarray:
    """A dress in all bundled resolutions: cloth folds between faces."""
    pictures, labels = [], []
    for size in ("1k", "4k", "10k"):
        shot = shoot(("dress",), frames, vertices=size)
        ends = shot.stored.rest_positions[shot.stored.faces[:, :2]]
        length = np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))
        pictures.append(figures(shot, [frames - 1])[0])
        labels.append(f"{size}: edges of {100 * length:.1f} cm")
    return side_by_side(pictures, labels)


def play(frames: int) -> np.ndarray | None:
    """The page of `eslr play`."""
    try:
        from playwright import sync_api
    except ImportError:
        return None
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        return None
    from eslr_jax.pipeline.page.live import open_live, run_live
    from eslr_jax.pipeline.page.live_controls import Choice

    shown, end = threading.Semaphore(0), threading.Event()
    live = open_live(Choice(("tshirt",), "1k", "cmu_016_32"), out=Path("live"), port=8871)
    loop = {"until": end, "on_frame": shown.release}
    thread = threading.Thread(target=run_live, args=(live,), kwargs=loop)
    thread.start()
    with sync_api.sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page(viewport={"width": 1000, "height": 680})
        page.goto(live.url)
        page.get_by_text("ms a frame").wait_for(timeout=300_000)
        for _ in range(frames):
            shown.acquire(timeout=60)
        for close in page.locator("button.mantine-Notification-closeButton").all():
            close.click()
        page.screenshot(path=Path(folder) / "page.png", timeout=180_000)
        picture = np.asarray(Image.open(Path(folder) / "page.png").convert("RGB"))
        browser.close()
    end.set()
    thread.join()
    live.server.stop()
    return picture


def pattern(frames: int) -> np.ndarray:
    """A T-shirt of four panels: cut, placed around the body, sewn, and on a walk."""
    cut, image = read_pattern(PATTERN), Image.new("RGB", _SIZE, "white")
    for k, panel in enumerate(cut.panels.values()):
        middle = np.array([(0.28 + 0.44 * (k % 2)) * _SIZE[0], (0.3 + 0.4 * (k // 2)) * _SIZE[1]])
        points = middle + _PANEL * (panel.outline - panel.outline.mean(axis=0)) * [1.0, -1.0]
        ImageDraw.Draw(image).polygon([tuple(point) for point in points], fill="#dce6f2", outline="#2a5d9a")
    body = load_body(betas=MEAN_SHAPE)
    sewn, mesh = load_garment_file(PATTERN, body=body), join_panels(cut, 1000)
    placed = mesh.placed + pattern_posture(body).stands[-1]
    pictures = [worn(dataclasses.replace(sewn, faces=mesh.faces), body, placed), worn(sewn, body)]
    walking = figures(shoot((str(PATTERN),), frames), [frames - 1])
    return side_by_side([np.asarray(image), *pictures, *walking], ("cut", "placed", "sewn", "walking"))


PICTURES: dict[str, Callable[[int], np.ndarray | None]] = {
    make.__name__.replace("_", "-"): make
    for make in (
        install, first_cloth, own_garment, pattern, own_body, outfits, fabrics, extend, report, score, studio,
        limits, play,
    )
}  # fmt: skip


if __name__ == "__main__":
    main()
