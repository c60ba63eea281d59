"""One picture of meshes in a small photo studio, by the ray tracer of Mitsuba 3, and where its camera stands.

The variant `scalar_rgb` runs on any CPU, needs only its wheel, and gives the same picture on every run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from eslr_jax.errors import ConfigError
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.formats.palette import linear_to_srgb, srgb_to_linear

_ANGLES = {"front": 0.0, "side": 90.0, "back": 180.0}  # degrees around +Y from the front towards the left
_VIEW_ANGLE = math.radians(24.0)  # of the longer picture side: a portrait lens, little perspective
_ELEVATION = math.radians(9.0)  # the camera looks down a little, so that the ground shows
_MARGIN = 1.12  # share of the picture left around the subject
_CALM = 8.0  # [frames] over which the camera's place and direction are averaged
_VARIANT = "scalar_rgb"
# Direct light only: at equal time a third of the noise of a path tracer, and folds keep their contrast.
_LIGHT_SAMPLES = 3  # per camera ray; four take a quarter longer, and are off by 0.7 in place of 0.8 of 255
_BACKGROUND = (0.86, 0.87, 0.88)  # sRGB; the lit floor has the same colour, so no horizon shows
_SKY_RADIANCE = np.array([0.20, 0.21, 0.23])  # the fill; radiances are scaled so that 1 is white
_SKY_SHARE = 0.25  # of the light samples
_KNEE = 0.75  # radiance from which highlights bend
_INSIDE = 0.75  # colour of the inside of cloth, over that of its outside
# Denoising.
_GUIDE_SAMPLES = 4  # camera rays per pixel for the features that guide it
_GUIDE_RANGE = 3.0  # between the features of two surfaces, whose normals span two
_GUIDE_SCALE = 0.12  # difference of features that parts two surfaces
_RADIUS = 2  # [steps] of a pass
_SPREAD = 1.5  # of the Gaussian over distance [steps]
# Step [pixels], and the difference of radiance that is a shadow's edge rather than grain (1 is white): what is
# left after the first pass is weaker and wider.
_PASSES = ((1, 0.30), (3, 0.10))


@dataclasses.dataclass(frozen=True)
class _Lamp:
    """A square area light far away: nearly parallel rays, soft shadows."""

    name: str
    turn: float  # around +Y from the camera's direction, towards the camera's right [rad]
    height: float  # above the horizon [rad]
    spread: float  # angle that it fills, seen from the subject [rad]
    irradiance: np.ndarray  # [3], on a surface facing it
    sample_share: float  # of the light samples


_LAMPS = (
    # Warm, from the camera's left, so far to the side that it grazes folds.
    _Lamp("key", math.radians(-58), math.radians(42), math.radians(9), np.array([2.70, 2.60, 2.45]), 0.50),
    # Weak and broad, low on the right, for what a bright floor would throw back.
    _Lamp("fill", math.radians(35), math.radians(16), math.radians(30), np.array([0.62, 0.61, 0.60]), 0.10),
    # Cool, from behind on the right: the rim that parts the subject from the background.
    _Lamp("rim", math.radians(140), math.radians(35), math.radians(12), np.array([0.70, 0.76, 0.85]), 0.15),
)
_LAMP_DISTANCE = 1e4  # [m]


@dataclasses.dataclass(frozen=True)
class Camera:
    """A perspective camera."""

    origin: np.ndarray  # [3], [m]
    target: np.ndarray  # [3], [m]
    view_angle: float  # vertical [rad]
    angle: float  # direction from the target to the camera, around +Y from +Z towards +X [rad]


@dataclasses.dataclass(frozen=True)
class Surface:
    """A mesh with its looks."""

    name: str
    positions: np.ndarray  # [vertices, 3], [m]
    faces: np.ndarray  # [faces, 3]
    color: np.ndarray | tuple[float, ...]  # sRGB in [0, 1], shape [3] or per vertex [vertices, 3]
    is_cloth: bool  # darker inside


def trace_picture(
    surfaces: Sequence[Surface],
    camera: Camera,
    *,
    ground_height: float,
    size: tuple[int, int],
    samples: int,
) -> np.ndarray:
    """Trace one picture, sRGB, uint8, shape [height, width, 3]; the lights turn with the camera.

    The floor has a height [m], the picture a width and height [pixels]; camera rays per pixel, `samples`, are
    rounded up to a square number.
    """
    mitsuba = require("mitsuba")
    with _variant(mitsuba):
        scene = {"sensor": _sensor(mitsuba, camera, size, samples)}
        scene |= _studio(mitsuba, camera, ground_height) | _lit(mitsuba, surfaces)
        pixels = _render(mitsuba, scene)
        guide = {"sensor": _sensor(mitsuba, camera, size, _GUIDE_SAMPLES)} | _shining(mitsuba, surfaces)
        features = _render(mitsuba, guide)[..., :3]
    color, opacity = pixels[..., :3], np.clip(pixels[..., 3:], 0.0, 1.0)
    color = color + (1 - opacity) * srgb_to_linear(_BACKGROUND)
    for step, color_scale in _PASSES:
        color = _smooth(color, features / _GUIDE_SCALE, step, color_scale)
    excess = np.maximum(color - _KNEE, 0.0)  # highlights bend towards one, and keep their shape
    color = np.minimum(color, _KNEE) + (1 - _KNEE) * (1 - np.exp(-excess / (1 - _KNEE)))
    return np.round(255 * linear_to_srgb(color)).astype(np.uint8)


@contextlib.contextmanager
def _variant(mitsuba: ModuleType) -> Iterator[None]:
    """Use our variant, and restore the one that the caller chose."""
    if mitsuba.variant() is None:
        mitsuba.set_variant(_VARIANT)  # variant_context can't return to "none chosen"
    with mitsuba.variant_context(_VARIANT):
        yield


def _render(mitsuba: ModuleType, description: dict[str, Any]) -> np.ndarray:
    scene = mitsuba.load_dict({"type": "scene"} | description, parallel=False)
    return np.array(mitsuba.render(scene, seed=0))


def _sensor(mitsuba: ModuleType, camera: Camera, size: tuple[int, int], samples: int) -> dict[str, Any]:
    """Return a perspective camera with a slightly soft pixel filter."""
    return {
        "type": "perspective",
        "fov": math.degrees(camera.view_angle),
        "fov_axis": "y",
        "to_world": _look_at(mitsuba, camera.origin, camera.target),
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "pixel_format": "rgba",
            "rfilter": {"type": "gaussian", "stddev": 0.45},
        },
        "sampler": {"type": "multijitter", "sample_count": math.ceil(math.sqrt(samples)) ** 2},
    }


def _studio(mitsuba: ModuleType, camera: Camera, ground_height: float) -> dict[str, Any]:
    """Return lamps that look at the camera's target, sky, and a floor that looks like the background."""
    studio: dict[str, Any] = {
        "integrator": {
            "type": "direct",
            "emitter_samples": _LIGHT_SAMPLES,
            "bsdf_samples": 0,
            "hide_emitters": True,
        },
        "sky": {"type": "constant", "radiance": _rgb(_SKY_RADIANCE), "sampling_weight": _SKY_SHARE},
    }
    irradiance, target = np.pi * _SKY_RADIANCE, camera.target
    for lamp in _LAMPS:
        turn, level = camera.angle + lamp.turn, math.cos(lamp.height)
        direction = np.array([level * math.sin(turn), math.sin(lamp.height), level * math.cos(turn)])
        half_size = _LAMP_DISTANCE * math.tan(lamp.spread / 2)
        radiance = _rgb(lamp.irradiance * _LAMP_DISTANCE**2 / (2 * half_size) ** 2)
        place = _look_at(mitsuba, target + _LAMP_DISTANCE * direction, target)
        # Mitsuba orders shapes that it makes from nested descriptions by chance, and samples lights in that
        # order: made one by one they keep our order, and the grain repeats from run to run.
        studio[lamp.name] = mitsuba.load_dict(
            {
                "type": "rectangle",
                "to_world": place @ mitsuba.ScalarTransform4f().scale(half_size),
                "emitter": {"type": "area", "radiance": radiance, "sampling_weight": lamp.sample_share},
            }
        )
        irradiance = irradiance + lamp.irradiance * math.sin(lamp.height)
    place = mitsuba.ScalarTransform4f().translate([float(target[0]), ground_height, float(target[2])])
    reflectance = np.pi * srgb_to_linear(_BACKGROUND) / irradiance
    studio["floor"] = {
        "type": "rectangle",
        "to_world": place.rotate([1, 0, 0], -90).scale(200.0),
        "bsdf": {"type": "diffuse", "reflectance": _rgb(reflectance)},
    }
    return studio


def _lit(mitsuba: ModuleType, surfaces: Sequence[Surface]) -> dict[str, Any]:

    def matte(scale: float) -> dict[str, Any]:
        color = {"type": "mesh_attribute", "name": "vertex_color", "scale": scale}
        return {"type": "diffuse", "reflectance": color}

    meshes = {}
    for surface in surfaces:
        inside = matte(_INSIDE if surface.is_cloth else 1.0)
        material = {"type": "twosided", "outside": matte(1.0), "inside": inside}
        colors = np.broadcast_to(srgb_to_linear(surface.color), surface.positions.shape)
        meshes[surface.name], _ = _mesh(mitsuba, surface, "vertex_color", colors, material=material)
    return meshes


def _shining(mitsuba: ModuleType, surfaces: Sequence[Surface]) -> dict[str, Any]:
    """Return meshes that shine in the colour of their normals, each in a range of its own.

    Their picture is free of noise and tells surfaces apart for the denoiser. Mitsuba's own integrator for such
    features takes ten times as long.
    """
    scene: dict[str, Any] = {"integrator": {"type": "path", "max_depth": 1}}
    light = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_feature"}}
    for number, surface in enumerate(surfaces):
        black = np.zeros(surface.positions.shape)
        scene[surface.name], parameters = _mesh(mitsuba, surface, "vertex_feature", black, light=light)
        parameters["vertex_feature"] = np.array(parameters["vertex_normals"]) + _GUIDE_RANGE * (number + 1)
        parameters.update()
    return scene


def _mesh(mitsuba: ModuleType, surface: Surface, attribute: str, values: np.ndarray, **plugins: Any):
    """Return a smooth-shaded Mitsuba mesh with three values a vertex, and its parameters."""
    properties = mitsuba.Properties()
    for name, plugin in plugins.items():
        properties[name] = mitsuba.load_dict(plugin)
    counts = len(surface.positions), len(surface.faces)
    mesh = mitsuba.Mesh(surface.name, *counts, has_vertex_normals=True, props=properties)
    mesh.add_attribute(attribute, 3, values.reshape(-1))
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = np.asarray(surface.positions, np.float32).reshape(-1)
    parameters["faces"] = np.asarray(surface.faces, np.uint32).reshape(-1)
    parameters.update()  # which computes normals
    return mesh, parameters


def _look_at(mitsuba: ModuleType, origin: np.ndarray, target: np.ndarray):
    """Return a transform at the origin that looks at the target, Y up."""
    return mitsuba.ScalarTransform4f().look_at(
        origin=[float(x) for x in origin], target=[float(x) for x in target], up=[0.0, 1.0, 0.0]
    )


def _rgb(values: np.ndarray) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(value) for value in values]}


def _smooth(color: np.ndarray, guide: np.ndarray, step: int, color_scale: float) -> np.ndarray:
    """Average every pixel with the neighbours that show the same surface under the same light.

    A neighbour weighs a Gaussian of its distance, its difference in guide and its difference in colour. A
    difference of one in the noise-free guide parts two surfaces, one of `color_scale` in the radiance [height,
    width, 3] is an edge. Neighbours are `step` pixels apart.

    Source: edge-avoiding a-trous filter, Dammertz et al. 2010, doi:10.2312/EGGH.HPG10.067-075.
    """
    height, width = color.shape[:2]
    features = np.concatenate([color / color_scale, guide], axis=-1, dtype=np.float32)
    border = _RADIUS * step
    margin = ((border, border), (border, border), (0, 0))
    padded_color, padded = np.pad(color, margin, mode="edge"), np.pad(features, margin, mode="edge")
    total, weights = np.zeros(color.shape, np.float32), np.zeros((height, width, 1), np.float32)
    for row in range(-_RADIUS, _RADIUS + 1):
        for column in range(-_RADIUS, _RADIUS + 1):
            top, left = border + step * row, border + step * column
            window = (slice(top, top + height), slice(left, left + width))
            distance = (row**2 + column**2) / _SPREAD**2
            difference = padded[window] - features
            squares = np.einsum("hwf,hwf->hw", difference, difference)
            weight = np.exp(-0.5 * (squares + np.float32(distance)))[..., None]
            total += weight * padded_color[window]
            weights += weight
    return total / weights


# ---------------------------------------------------------------- where the camera stands


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
