"""Where the camera stands: it looks level at a box and sees all of it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from eslr_jax.errors import ConfigError

_ANGLES = {"front": 0.0, "side": 90.0, "back": 180.0}  # degrees around +Y from +Z, where a body faces
_VIEW_ANGLE = math.radians(24.0)  # of the longer picture side: a portrait lens, little perspective
_ELEVATION = math.radians(9.0)  # the camera looks down a little, so that the ground shows
_MARGIN = 1.12  # share of the picture left around the box


@dataclasses.dataclass(frozen=True)
class Camera:
    """A perspective camera."""

    origin: np.ndarray  # [3], [m]
    target: np.ndarray  # [3], [m]
    view_angle: float  # vertical [rad]


def parse_angle(camera: str | float) -> float:
    """Turn a camera's name or its angle in degrees into an angle in radians.

    Args:
        camera: "front" (+Z, where a body in rest pose faces), "side" (+X, its left), "back", or degrees from
            the front towards the side.

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


def place_camera(
    center: np.ndarray, half_height: float, radius: float, angle: float, aspect: float
) -> Camera:
    """Look at an upright cylinder so that it fits the picture, from whatever side.

    Args:
        center: Centre of the cylinder [m], shape [3].
        half_height: Half its height [m].
        radius: Its radius [m].
        angle: Direction of the camera around +Y, from +Z towards +X [rad].
        aspect: Picture width over height.

    Returns:
        The camera.
    """
    view_angle = 2 * math.atan(math.tan(_VIEW_ANGLE / 2) / max(aspect, 1.0))
    half_needed = max(half_height + radius * math.sin(_ELEVATION), radius / aspect, 1e-3)
    distance = _MARGIN * half_needed / math.tan(view_angle / 2)
    level = math.cos(_ELEVATION)
    direction = np.array([math.sin(angle) * level, math.sin(_ELEVATION), math.cos(angle) * level])
    return Camera(origin=center + distance * direction, target=np.asarray(center), view_angle=view_angle)
