"""Where the camera stands: it follows a subject, looks at it from one side, and sees all of it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from eslr_jax.errors import ConfigError

_ANGLES = {"front": 0.0, "side": 90.0, "back": 180.0}  # degrees around +Y from the front towards the left
_VIEW_ANGLE = math.radians(24.0)  # of the longer picture side: a portrait lens, little perspective
_ELEVATION = math.radians(9.0)  # the camera looks down a little, so that the ground shows
_MARGIN = 1.12  # share of the picture left around the subject
_CALM = 8.0  # [frames] over which the camera's place and direction are averaged


@dataclasses.dataclass(frozen=True)
class Camera:
    """A perspective camera."""

    origin: np.ndarray  # [3], [m]
    target: np.ndarray  # [3], [m]
    view_angle: float  # vertical [rad]
    angle: float  # direction from the target to the camera, around +Y from +Z towards +X [rad]


def parse_angle(camera: str | float) -> float:
    """Return an angle [rad] from "front", "side" (the subject's left), "back", or degrees from front to left.

    Raises:
        ConfigError: If the name is unknown or the angle is not finite.
    """
    if isinstance(camera, str):
        if camera not in _ANGLES:
            raise ConfigError(f"unknown camera {camera!r}; use {', '.join(_ANGLES)}, or an angle in degrees")
        return math.radians(_ANGLES[camera])
    if not math.isfinite(camera):
        raise ConfigError(f"camera angle is {camera}; give a finite number of degrees")
    return math.radians(camera)


def facing_angles(
    positions: Float[np.ndarray, "frames vertices 3"], rest_positions: Float[np.ndarray, "vertices 3"]
) -> Float[np.ndarray, " frames"]:
    """Return where a body faces in every frame, around +Y from +Z towards +X [rad], without jumps of a turn.

    It is the turn about the vertical that brings the resting body, which faces +Z, closest to the posed one.
    """
    rest = rest_positions - rest_positions.mean(axis=0)
    posed = positions - positions.mean(axis=1, keepdims=True)
    sine = posed[..., 0] @ rest[:, 2] - posed[..., 2] @ rest[:, 0]
    cosine = posed[..., 0] @ rest[:, 0] + posed[..., 2] @ rest[:, 2]
    return np.unwrap(np.arctan2(sine, cosine))


def follow(
    subject: Float[np.ndarray, "frames vertices 3"],
    angles: Float[np.ndarray, " frames"],
    *,
    aspect: float,
    zoom: float = 1.0,
    focus: Float[np.ndarray, "frames points 3"] | None = None,
) -> tuple[list[Camera], float]:
    """Return a camera per frame that sees the whole subject [m], in the middle, at one distance; and the floor.

    `angles` are directions of the camera around +Y, from +Z towards +X [rad], `aspect` is picture width over
    height. `focus` are points whose centre is looked at [m], by default the subject's. The floor is the height of
    the lowest point over all frames [m].
    """
    floor, top = float(subject[..., 1].min()), float(subject[..., 1].max())
    centers = subject.mean(axis=1)
    centers[:, 1] = (floor + top) / 2
    offsets = subject - centers[:, None]
    radius = float(np.hypot(offsets[..., 0], offsets[..., 2]).max())
    half_view = math.atan(math.tan(_VIEW_ANGLE / 2) / max(aspect, 1.0))
    # An upright cylinder around the subject is seen whole, from whatever side.
    half_needed = max((top - floor) / 2 + radius * math.sin(_ELEVATION), radius / aspect, 1e-3)
    distance = _MARGIN * half_needed / math.tan(half_view)
    zoomed_view, level = 2 * math.atan(math.tan(half_view) / zoom), math.cos(_ELEVATION)
    cameras = []
    targets = _calm(centers if focus is None else focus.mean(axis=1))
    for target, angle in zip(targets, _calm(angles), strict=True):
        direction = np.array([math.sin(angle) * level, math.sin(_ELEVATION), math.cos(angle) * level])
        cameras.append(Camera(target + distance * direction, target, zoomed_view, float(angle)))
    return cameras, floor


def _calm(values: np.ndarray) -> np.ndarray:
    """Return values over time without their quick changes; what changes evenly stays as it is."""
    even = np.linspace(values[0], values[-1], len(values))
    return even + gaussian_filter1d(values - even, _CALM, axis=0, mode="nearest")
