"""Read Acclaim motions, CMU's own format: a skeleton of bones (.asf), and their angles over time (.amc).

Each bone starts where its parent ends. It turns by C R C^-1, where C are its resting axes and R its angles,
applied in the order in which the skeleton lists them. A joint of the result is the start of a bone; the rest pose
has all angles zero. Units are the file's own.

Source: Acclaim format, https://research.cs.wisc.edu/graphics/Courses/cs-838-1999/Jeff/ASF-AMC.html
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from eslr_jax.errors import AssetError
from eslr_jax.files.parsing import parsing, read_lines
from eslr_jax.pipeline.formats.registry import reader
from eslr_jax.pose.skeleton import MAX_FRAMES, MAX_JOINTS, SkeletonMotion, pose_offsets

FPS = 120.0  # [1/s] of CMU's recordings; the files tell none


@dataclasses.dataclass
class _Bone:
    """One bone of a skeleton file; the first one is the root, which has no length."""

    end: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))  # from its start, at rest
    axes: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    channels: tuple[str, ...] = ()  # "tx", "rz", ..., in the order of their values
    parent: str = ""


@reader("motion", [".amc"])
def read_amc(path: Path, _clip: str = "") -> SkeletonMotion:
    """Read a motion at 120 frames per second, in the files' own unit and axes, and the skeleton beside it.

    The skeleton is the .asf of the same name, or of the name before the first "_" (CMU's `01.asf` for
    `01_02.amc`), or the only one in the folder.
    """
    with parsing(_skeleton_of(path), "skeleton") as skeleton:
        bones, in_degrees = _read_bones(_lines(skeleton))
    values = _read_frames(_lines(path), bones)
    names = list(bones)
    parents = [names.index(bone.parent) if bone.parent else -1 for bone in bones.values()]
    rest = np.array([bones[bone.parent].end if bone.parent else np.zeros(3) for bone in bones.values()])
    shifts = np.tile(rest, (len(values["root"]), 1, 1))
    local = np.tile(np.eye(3), (*shifts.shape[:2], 1, 1))
    for index, (name, bone) in enumerate(bones.items()):
        turns = [place for place, channel in enumerate(bone.channels) if channel[0] == "r"]
        for place, channel in enumerate(bone.channels):
            if channel[0] == "t":
                shifts[:, index, "xyz".index(channel[1])] = values[name][:, place]
        if turns:
            order = "".join(bone.channels[place][1] for place in turns)  # lower case: about axes that stay
            turned = Rotation.from_euler(order, values[name][:, turns], degrees=in_degrees).as_matrix()
            local[:, index] = bone.axes @ turned @ bone.axes.T
    return pose_offsets(path.stem, names, parents, rest, local, shifts, FPS)


def _skeleton_of(file: Path) -> Path:
    """Return the path of a motion's skeleton."""
    for name in (file.stem, file.stem.partition("_")[0]):
        if file.with_name(f"{name}.asf").is_file():
            return file.with_name(f"{name}.asf")
    found = sorted(file.parent.glob("*.asf"))
    if len(found) != 1:
        raise AssetError(f"motion file {file} needs its skeleton; put {file.stem}.asf beside it")
    return found[0]


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Return the number and the words of every line that is not empty or a comment."""
    lines = read_lines(path)
    words = [(number, line.partition("#")[0].split()) for number, line in enumerate(lines, 1)]
    return [(number, line) for number, line in words if line]


def _read_bones(lines: list[tuple[int, list[str]]]) -> tuple[dict[str, _Bone], bool]:
    """Return the bones by name, the root first, and whether angles are degrees."""
    bones, in_degrees, section, name, resting = {"root": _Bone()}, True, "", "root", {}
    for number, (key, *rest) in lines:
        if key.startswith(":"):
            section, name = key.lower(), "root"
        elif section == ":units" and key == "angle":
            in_degrees = rest[0].lower().startswith("deg")
        elif section == ":hierarchy" and key not in ("begin", "end"):
            for child in rest:
                if child not in bones or key not in bones or bones[child].parent or child == "root":
                    raise ValueError(f"line {number}: {child[:40]!r} is no bone, or has a parent")
                bones[child].parent = key
        elif section == ":bonedata" and key == "name":
            name = rest[0]
            if name in bones or len(bones) == MAX_JOINTS:
                raise ValueError(f"line {number}: bone {name[:40]!r} stands twice, or is one too many")
            bones[name] = _Bone()
        elif section in (":root", ":bonedata"):
            if key in ("direction", "length", "position", "orientation"):
                resting[name, key] = _numbers(number, rest)
            elif key == "axis":
                resting[name, key] = _numbers(number, rest[:-1]), rest[-1].lower()
            elif key in ("dof", "order"):
                bones[name].channels = tuple(word.lower() for word in rest)
    for name, bone in bones.items():
        angles, order = resting.get((name, "axis"), ([], "xyz"))
        angles = angles or resting.get((name, "orientation"), [0.0] * 3)
        bone.axes = Rotation.from_euler(order, angles, degrees=in_degrees).as_matrix()
        if name != "root":
            bone.end = np.array(resting[name, "direction"]) * resting[name, "length"][0]
            if not bone.parent:
                raise ValueError(f"bone {name[:40]!r} is not in the hierarchy")
        if any(word not in ("rx", "ry", "rz") for word in bone.channels if name != "root"):
            raise ValueError(f"bone {name[:40]!r} has {bone.channels}; only rotations are read")
    return bones, in_degrees


def _read_frames(lines: list[tuple[int, list[str]]], bones: dict[str, _Bone]) -> dict[str, np.ndarray]:
    """Return the values of every bone's channels, [frames, channels]."""
    starts, width = {}, 0
    for name, bone in bones.items():
        starts[name], width = width, width + len(bone.channels)
    frames: list[np.ndarray] = []
    for number, (key, *rest) in lines:
        if key.isdigit() and not rest:
            if len(frames) == MAX_FRAMES:
                raise ValueError(f"line {number}: more than {MAX_FRAMES} frames")
            frames.append(np.zeros(width))
        elif not key.startswith(":"):
            if key not in bones or len(rest) != len(bones[key].channels) or not frames:
                raise ValueError(f"line {number}: {len(rest)} values for {key[:40]!r}")
            frames[-1][starts[key] : starts[key] + len(rest)] = _numbers(number, rest)
    if not frames:
        raise ValueError("it has no frames")
    table = np.stack(frames)
    return {name: table[:, start : start + len(bones[name].channels)] for name, start in starts.items()}


def _numbers(number: int, words: list[str]) -> list[float]:
    """Return the finite numbers of a line."""
    values = [float(word) for word in words]
    if not np.isfinite(values).all():
        raise ValueError(f"line {number}: a value is not finite")
    return values
