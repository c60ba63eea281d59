"""The report of a simulation: plain values, and words on what is good and what a person would see as wrong."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from eslr_jax.mesh.closest import nearest_places
from eslr_jax.mesh.topology import vertex_normals
from eslr_jax.pipeline.formats.garment import split_outfit
from eslr_jax.pipeline.report.crossing import find_crossings
from eslr_jax.pipeline.report.metrics import face_stretches, measure_frames, penetration_p999_mm
from eslr_jax.terms import Ground
from eslr_jax.terms.contact import keeps_layers
from eslr_jax.types import BodyMotion, Scene, Trajectory

_EVERY = 10  # frames between those whose crossings are counted
_DEEP = 1e-3  # [m] inside the body, from which a depth is measured again
_PACKAGES = ("eslr-jax", "jax", "jaxlib", "flax", "numpy")
# From where on a report in words warns.
_STRETCH = 1.5  # of one face in a hundred, from which cloth looks stretched
_TORN = 2.0  # of a single face, from which it looks torn
_PENETRATION_MM = 5.0
_THROUGH_MM = 1.0  # of skin in front of cloth
# Pinned cloth that gives way is worth a line, and farther a warning: its pins lie in the body.
_YIELDED_MM, _YIELDED_FAR_MM = 1.0, 20.0
_SLID_M = 0.25
_EDGE_SLID_M = 0.2  # of an edge that lies on the skin, as at neck, waist and wrists; sleeves ride up by less
_LEFT = 0.75  # of the covered skin that cloth should still be near


Parts = tuple[np.ndarray | None, tuple[str, ...]]
"""Number of the part of every face, shape [faces], and the names of the parts; see `GarmentFile`."""


def trajectory_report(
    trajectory: Trajectory,
    scene: Scene,
    *,
    parts: Parts = (None, ()),
    poses: BodyMotion | None = None,
    outfit: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """Measure a trajectory.

    Args:
        trajectory: What to measure.
        scene: Its scene.
        parts: Parts of the garment, which the worst places are named by.
        poses: The whole body: what seems to be deep in the part that was searched for contacts is measured again.
        outfit: Numbers of vertices of garments that are worn together, by name and in order.

    Returns:
        Plain values: energies [J] as means over frames, largest stretch, penetration [mm] and the share of
        vertices that penetrate; without a body the penetration values are None. `worst_stretch` and
        `worst_penetration` hold frame, time [s], vertex and part of the largest values. `garments` holds stretch
        and penetration of every garment of an outfit by name; None for a single garment. `crossing_pairs` are the
        most pairs of faces of cloth that intersect in a frame, `crossing_share` the share of frames that have
        any, of every tenth simulated frame and the last; None where self-contact is not modelled. `let_through`
        are the frames in which something may have passed through cloth; None where contact is not strict.
        `pins_yield_mm` is how far pinned cloth was pushed from its place at most; None without pins.
        `refined_frames` are those that `simulate` took again in smaller steps; None where it did not simulate.
    """
    measures = jax.device_get(measure_frames(trajectory.positions, scene))
    trajectory = jax.device_get(trajectory)  # to be cut on the host, where it compiles nothing
    is_real = np.asarray(scene.garment.vertex_mask)
    positions = trajectory.positions[:, is_real]

    def stretches(frame: int) -> np.ndarray:
        return np.asarray(face_stretches(trajectory.positions[frame][None], scene.garment))[0]

    depth, worst = None, None
    if measures.distances is not None:
        depth = -measures.distances[:, is_real]
        if poses is not None:
            depth = _measured_again(depth, positions[1:], poses)
        if depth.max() > 0:
            frame, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
            worst = _place(int(frame) + 1, int(np.flatnonzero(is_real)[column]), scene, parts)
    stretched = int(np.argmax(measures.max_stretch)) + 1
    torn = int(np.asarray(scene.garment.faces)[stretches(stretched).argmax(), 0])
    several = dict(outfit) if outfit is not None and len(outfit) > 1 else None
    return {
        "finite": bool(np.isfinite(positions).all()),
        "num_frames": trajectory.num_frames,
        "num_vertices": int(is_real.sum()),
        **mean_energies(trajectory),
        "max_principal_stretch": float(measures.max_stretch.max()),
        "p99_principal_stretch": float(measures.p99_stretch.max()),
        "start_principal_stretch": float(stretches(0).max()),
        "worst_stretch": _place(stretched, torn, scene, parts),
        "penetration_p999_mm": None if depth is None else penetration_p999_mm(depth),
        **_penetration(depth),
        "worst_penetration": worst,
        "rms_speed_m_s": float(measures.speed.mean()),
        "residual_median": float(np.median(trajectory.residuals[1:])),
        "iterations_mean": float(np.mean(trajectory.iterations[1:])),
        "garments": None if several is None else _garments(trajectory, scene, depth, several),
        **_crossings(trajectory, scene, parts),
        "let_through": None if trajectory.is_passed is None else int(np.sum(trajectory.is_passed)),
        "pins_yield_mm": _pins_yield_mm(trajectory, scene),
        "refined_frames": None if (own := trajectory.substeps) is None else int(np.sum(own > scene.substeps)),
    }


def describe_terms(scene: Scene) -> dict[str, str]:
    """Return a few words on the terms that a scene models, by the names of their types."""
    return {type(term).__name__.lower(): term.describe(scene.garment) for term in scene.terms}


def describe_model(scene: Scene) -> dict[str, Any]:
    """Return what a scene models, in words for a report; a scene is read from its own file."""
    return {
        "modelled": describe_terms(scene),
        "integrator": "euler" if scene.initial_state.past is None else "bdf2",
        "substeps": scene.substeps,
        "ground_m": None if (ground := scene.term(Ground)) is None else float(ground.height),
    }


def _penetration(depth: np.ndarray | None) -> dict[str, float | None]:
    """Return the largest of depths in a body [m], and the share that is inside; None without a body."""
    return {
        "penetration_max_mm": None if depth is None else float(max(depth.max(), 0.0) * 1e3),
        "penetrating_share": None if depth is None else float((depth > 0).mean()),
    }


def _crossings(trajectory: Trajectory, scene: Scene, parts: Parts) -> dict[str, Any]:
    """Return where cloth passes through cloth in spite of self-contact."""
    if not keeps_layers(scene):
        return {"crossing_pairs": None, "crossing_share": None, "worst_crossing": None}
    faces = _real_faces(scene)
    last = trajectory.num_frames - 1
    frames = sorted({*range(_EVERY, last, _EVERY), last})
    pairs = [find_crossings(np.asarray(trajectory.positions[frame]), faces).faces for frame in frames]
    counts = [len(rows) for rows in pairs]
    worst = int(np.argmax(counts))
    vertex = int(faces[pairs[worst][0, 0], 0]) if counts[worst] else None
    return {
        "crossing_pairs": counts[worst],
        "crossing_share": float(np.mean(np.array(counts) > 0)),
        "worst_crossing": None if vertex is None else _place(frames[worst], vertex, scene, parts),
    }


def _pins_yield_mm(trajectory: Trajectory, scene: Scene) -> float | None:
    if scene.pin_targets is None:
        return None
    is_pinned = np.asarray(scene.garment.is_pinned)
    targets = np.asarray(scene.pin_targets)[: trajectory.num_frames, is_pinned]
    away = np.linalg.norm(trajectory.positions[:, is_pinned] - targets, axis=2)
    return 1e3 * float(np.max(away, initial=0.0))


def _real_faces(scene: Scene) -> np.ndarray:
    return np.asarray(scene.garment.faces)[np.asarray(scene.garment.rest_areas) > 0]


def start_crossing(scene: Scene, *, parts: Parts = (None, ())) -> dict[str, Any] | None:
    """Return where cloth lies deepest behind cloth in frame 0, where contact then keeps it.

    Returns: Plain values: pairs of faces that intersect, `depth_mm` of the deepest vertex, its `position_m` and
    its place, with its part. None where nothing is behind a layer that it passed, or self-contact is not
    modelled.
    """
    if not keeps_layers(scene):
        return None
    positions = np.asarray(scene.initial_state.position)
    crossings = find_crossings(positions, _real_faces(scene))
    vertex = int(np.argmax(crossings.depths))
    if crossings.depths[vertex] == 0:
        return None
    return {
        "crossing_pairs": len(crossings.faces),
        "depth_mm": 1e3 * float(crossings.depths[vertex]),
        "position_m": positions[vertex].tolist(),
        "place": _place(0, vertex, scene, parts),
    }


def _garments(
    trajectory: Trajectory, scene: Scene, depth: np.ndarray | None, outfit: dict[str, int]
) -> dict[str, dict[str, Any]]:
    """Return stretch and penetration of the garments of an outfit, as the report has them of the whole.

    `depth` is that of real vertices in simulated frames [m], None without a body.
    """
    stretches = np.asarray(face_stretches(trajectory.positions[1:], scene.garment))
    is_face = np.asarray(scene.garment.rest_areas) > 0
    found: dict[str, dict[str, Any]] = {}
    for name, rows, is_own in split_outfit(np.asarray(scene.garment.faces), outfit):
        stretch = stretches[:, is_own & is_face]
        found[name] = {
            "num_vertices": outfit[name],
            "p99_principal_stretch": float(np.quantile(stretch, 0.99, axis=1, method="lower").max()),
            "max_principal_stretch": float(stretch.max()),
            **_penetration(None if depth is None else depth[:, rows]),
        }
    return found


def _measured_again(depth: np.ndarray, positions: np.ndarray, poses: BodyMotion) -> np.ndarray:
    """Return depths [m], shape [frames, vertices], with the large ones as they are in the whole body.

    Contacts are searched among the faces in reach, approximately. Where that part ends, they may be far off.
    `positions` are of the same frames; the body has one more, the first.
    """
    faces, depth = np.asarray(poses.faces), np.array(depth)
    for frame in np.flatnonzero((depth > _DEEP).any(axis=1)):
        body, deep = np.asarray(poses.positions[frame + 1]), np.flatnonzero(depth[frame] > _DEEP)
        place = nearest_places(positions[frame, deep], body, faces, vertex_normals(body, faces))
        is_outside = np.einsum("px,px->p", place.offsets, place.normals) > 0
        depth[frame, deep] = np.where(is_outside, -1, 1) * np.linalg.norm(place.offsets, axis=1)
    return depth


def _place(frame: int, vertex: int, scene: Scene, parts: Parts) -> dict[str, Any]:
    """Return a frame and a vertex as plain values, with the frame's time [s] and the vertex's part."""
    numbers, names = parts
    part = None
    if numbers is not None and names:
        around = (np.asarray(scene.garment.faces)[: len(numbers)] == vertex).any(axis=1)
        part = names[int(np.bincount(numbers[around]).argmax())] if around.any() else None
    return {"frame": frame, "time_s": frame * float(scene.timestep), "vertex": vertex, "part": part}


def mean_energies(trajectory: Trajectory) -> dict[str, Any]:
    """Return the energies as means over simulated frames by name [J], `terms`, and their `total`."""
    means = {name: float(np.mean(np.asarray(values)[1:])) for name, values in trajectory.energies.items()}
    return {"terms": means, "total": sum(means.values())}


def environment() -> dict[str, Any]:
    """Return the device and the versions that a figure was measured with."""
    device = jax.devices()[0]
    kind = device.device_kind
    if device.platform == "cpu":
        try:
            lines = Path("/proc/cpuinfo").read_text().splitlines()
        except OSError:  # not Linux
            lines = []
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        kind = f"{platform.machine()}, {names[0] if names else platform.processor()}"
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return {
        "device": f"{device.platform}: {kind}",
        "versions": versions | {"python": platform.python_version()},
    }


class Words(NamedTuple):
    """Lines for a person."""

    good: list[str]
    warnings: list[str]


def describe_report(report: dict[str, Any]) -> Words:
    """Put a run's report into words.

    It has the values of `trajectory_report` and of `wear_report`, the `tolerance` that was asked for, and the
    share of frames within it, `within_tolerance`.
    """
    good, warnings = words = Words([], [])
    if report["error"] is not None:
        warnings.append(report["error"])
    if report["tolerance"] is not None:
        tolerance, late = 100 * report["tolerance"], 100 * (1 - report["within_tolerance"])
        if late:
            warnings.append(
                f"{late:.1f} % of the frames ended before they were within a gap of {tolerance:g} %"
            )
        else:
            good.append(f"within a gap of {tolerance:g} % on every frame")

    depth, through, pairs = (
        report[name] for name in ("penetration_max_mm", "skin_through_mm", "crossing_pairs")
    )
    if depth is not None and depth > _PENETRATION_MM:
        place = _where(report["worst_penetration"])
        warnings.append(f"cloth is up to {depth:.1f} mm inside the body, {place}")
    elif depth is not None:
        good.append(f"no vertex {f'deeper than {depth:.2g} mm ' if depth else ''}inside the body")
    if through is not None and through > _THROUGH_MM:
        share = f"{100 * report['skin_through_share']:.2f} % of the covered skin"
        place = _where(report["worst_skin_through"])
        warnings.append(f"skin shows through the cloth, by up to {through:.1f} mm, {place}; {share}")
    elif through is not None:
        good.append("no skin shows through the cloth")
    if pairs:
        share = f"in {100 * report['crossing_share']:.0f} % of the frames that were looked at"
        place = _where(report["worst_crossing"])
        warnings.append(f"cloth passes through cloth: {pairs} pairs of faces intersect, {place}; {share}")
    elif pairs is not None:
        good.append("no cloth passes through cloth")

    if report["let_through"]:
        warnings.append(
            f"in {report['let_through']} frames parts of the body left cloth no room, or cloth came out of them: "
            "something may have passed through it"
        )
    elif report["let_through"] == 0:
        good.append("nothing passed through cloth on the way from frame to frame")

    if (yielded := report["pins_yield_mm"]) is not None and yielded > _YIELDED_MM:
        told = warnings if yielded > _YIELDED_FAR_MM else good
        told.append(f"pinned cloth gave way to what came through it, by up to {yielded:.0f} mm")

    slide, frame, coverage = report["slide_m"], report["below_feet_at"], report["coverage"]
    if frame is not None:
        warnings.append(f"the garment fell off: in frame {frame} it is below the feet")
    elif slide > _SLID_M:
        place = _where(report["worst_slide"])
        warnings.append(f"the garment slid or fell: its centre is {slide:.2f} m from its place, {place}")
    elif report["edge_slide_m"] > _EDGE_SLID_M:
        worst = report["worst_edge_slide"]
        warnings.append(
            f"a part of the garment slid: its edge {worst['height_m']:.2f} m above the soles is "
            f"{report['edge_slide_m']:.2f} m from its place, {_where(worst)}"
        )
    elif coverage is not None and coverage < _LEFT:
        warnings.append(f"the garment left skin that it covered: {100 * (1 - coverage):.0f} % of it")
    else:
        good.append("the garment stays where it was put on")

    if report.get("refined_frames"):
        good.append(f"{report['refined_frames']} frames were simulated in several steps: one tore the cloth")
    most, largest = report["p99_principal_stretch"], report["max_principal_stretch"]
    text = f"cloth is stretched by {100 * (most - 1):.0f} % (99 % of it), {100 * (largest - 1):.0f} % at most"
    if most > _STRETCH or largest > _TORN:
        more = f"; try --substeps {4 * report['substeps']}" if "substeps" in report else ""
        warnings.append(f"{text}, {_where(report['worst_stretch'])}{more}")
    else:
        good.append(text)
    return words


def describe_start(crossing: dict[str, Any] | None, *, is_put_on: bool) -> str | None:
    """Return a warning where cloth begins behind cloth that it passes through; else None.

    `crossing` is of `start_crossing`; `is_put_on`: the garment begins on the body's rest pose.
    """
    if crossing is None:
        return None
    x, y, z = crossing["position_m"]
    place = _where(crossing["place"], "on the rest pose" if is_put_on else None)
    other = "begin with another frame (--start), lift the arms (--arm-abduction), or "
    return (
        f"cloth begins {crossing['depth_mm']:.0f} mm behind cloth that it passes through, at {x:.2f} {y:.2f} "
        f"{z:.2f} m, {place}, with {crossing['crossing_pairs']} pairs of faces, and will stay "
        f"there: {'' if is_put_on else other}mend the garment there"
    )


def _where(place: dict[str, Any], moment: str | None = None) -> str:
    """Return a place as text; `moment` stands for its frame."""
    text = moment or f"frame {place['frame']} ({place['time_s']:.2f} s)"
    if place.get("part"):
        text += f", part {place['part']}"
    for key, word in (("vertex", "vertex"), ("body_vertex", "body vertex")):
        if key in place:
            text += f", {word} {place[key]}"
    return text
