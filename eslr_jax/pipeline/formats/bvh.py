"""Read Biovision BVH motions: a hierarchy of offsets and Euler channels, then one line of numbers per frame.

The rest pose has all rotations zero: each joint is at the sum of the offsets above it. The unit and the up axis
are the file's own.
"""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from eslr_jax.errors import AssetError, MotionError
from eslr_jax.files.parsing import read_lines
from eslr_jax.pipeline.formats.registry import reader
from eslr_jax.pose.skeleton import MAX_FRAMES, MAX_JOINTS, SkeletonMotion, pose_offsets, whole_rate

_CHANNELS = tuple(axis + kind for kind in ("position", "rotation") for axis in "XYZ")


@dataclasses.dataclass
class _Joint:
    """One joint of the hierarchy while it is read."""

    name: str
    parent: int
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    channels: tuple[str, ...] = ()


@reader("motion", [".bvh"])
def read_bvh(path: Path, _clip: str = "") -> SkeletonMotion:
    """Read a BVH file at its own frame rate, in its own unit and axes; errors name the line.

    A frame time of 0.0333333 s is a thirtieth of a second. A header whose number of frames is off by one is a
    warning; the frames that are there are read.
    """
    words = _Words(path)
    joints = _read_hierarchy(words)
    values, frame_time = _read_frames(words, sum(len(joint.channels) for joint in joints))
    if not 1e-3 <= frame_time <= 1.0:
        raise MotionError(f"{path}: a frame time of {frame_time:g} s; expected 0.001 to 1")
    fps = whole_rate(1.0 / frame_time)
    rest = np.array([joint.offset for joint in joints])
    local = np.tile(np.eye(3), (len(values), len(joints), 1, 1))
    offsets = np.tile(rest, (len(values), 1, 1))
    columns = iter(values.T)
    for index, joint in enumerate(joints):
        angles, axes = [], ""
        for channel in joint.channels:
            if channel.endswith("position"):
                # A position replaces the offset: that is what exporters write and importers expect.
                offsets[:, index, "XYZ".index(channel[0])] = next(columns)
            else:
                angles.append(np.remainder(next(columns) + 180.0, 360.0) - 180.0)
                axes += channel[0]
        if axes:
            local[:, index] = Rotation.from_euler(axes, np.stack(angles, 1), degrees=True).as_matrix()
    names, parents = [joint.name for joint in joints], [joint.parent for joint in joints]
    return pose_offsets(path.stem, names, parents, rest, local, offsets, fps)


class _Words:
    """Yields the words of a file one by one, and knows the number of their line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines = read_lines(path)
        self.number = 0  # of the lines consumed
        self.rest: list[str] = []

    def fail(self, cause: str) -> AssetError:
        """Return the error that names this line."""
        return AssetError(f"motion file {self.path}, line {self.number}: {cause}; export it again")

    def next(self) -> str:
        """Return the next word."""
        while not self.rest:
            if self.number == len(self.lines):
                raise self.fail("the file ends here, in the middle")
            self.rest = self.lines[self.number].split()[::-1]
            self.number += 1
        return self.rest.pop()

    def expect(self, *accepted: str) -> str:
        """Return the next word, which must be one of these."""
        word = self.next()
        if word.upper() not in {option.upper() for option in accepted}:
            raise self.fail(f"{word[:40]!r} where {' or '.join(accepted)} belongs")
        return word

    def number_of(self, kind: type) -> float:
        """Return the next word as a finite number."""
        word = self.next()
        try:
            value = kind(word)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise self.fail(f"{word[:40]!r} is no finite number")
        return value


def _read_hierarchy(words: _Words) -> list[_Joint]:
    """Return the joints that stand before MOTION, without end sites."""
    words.expect("HIERARCHY")
    joints: list[_Joint] = []
    opened: list[int] = []  # joints whose brace is open; -1 is an end site
    while (word := words.next().upper()) != "MOTION":
        if word in ("ROOT", "JOINT"):
            if (word == "ROOT") == bool(opened) or len(joints) == MAX_JOINTS:
                raise words.fail(f"{word} in the wrong place, or more than {MAX_JOINTS} joints")
            name = " ".join(words.rest[::-1]) or words.next()
            words.rest = []
            joints.append(_Joint(name.rstrip("{ "), opened[-1] if opened else -1))
            if not name.endswith("{"):
                words.expect("{")
            opened.append(len(joints) - 1)
        elif word == "END":
            words.rest = []  # "Site"
            words.expect("{")
            opened.append(-1)
        elif word == "OFFSET":
            offset = tuple(words.number_of(float) for _ in range(3))
            if opened and opened[-1] >= 0:
                joints[opened[-1]].offset = offset
        elif word == "CHANNELS":
            count = int(words.number_of(int))
            if not 0 <= count <= 6 or not opened or opened[-1] < 0:
                raise words.fail(f"{count} channels")
            names = tuple(words.expect(*_CHANNELS).capitalize() for _ in range(count))
            if len(set(names)) != count:
                raise words.fail("a channel twice")
            joints[opened[-1]].channels = names
        elif word == "}" and opened:
            opened.pop()
        else:
            raise words.fail("a brace that closes nothing" if word == "}" else f"{word[:40]!r} is unknown")
    if opened or not joints:
        raise words.fail("MOTION inside the hierarchy")
    return joints


def _read_frames(words: _Words, num_channels: int) -> tuple[np.ndarray, float]:
    """Return the table of values, [frames, channels], and the time between frames [s]."""
    words.expect("Frames:")
    num_frames = int(words.number_of(int))
    words.expect("Frame")
    words.expect("Time:")
    frame_time = words.number_of(float)
    if not 0 < num_frames <= MAX_FRAMES:
        raise words.fail(f"{num_frames} frames")
    if num_channels == 0:
        raise words.fail("no channels to animate")
    text = " ".join(words.lines[words.number :]).split()
    rows = len(text) // num_channels
    if len(text) % num_channels or abs(rows - num_frames) > 1 or not rows:
        raise words.fail(
            f"{len(text)} numbers follow; {num_frames} frames of {num_channels} channels need "
            f"{num_frames * num_channels}"
        )
    if rows != num_frames:  # some exporters count wrongly
        warning = f"motion file {words.path} says {num_frames} frames and has {rows}; all {rows} are read"
        warnings.warn(warning, stacklevel=4)
    values = np.array(text, np.float64).reshape(rows, num_channels)
    is_bad = ~np.isfinite(values).all(axis=1)
    if is_bad.any():
        raise words.fail(f"frame {np.argmax(is_bad)} is not finite")
    return values, frame_time
