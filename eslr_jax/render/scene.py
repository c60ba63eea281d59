"""One picture of meshes in a small photo studio, by the ray tracer of Mitsuba 3.

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

from eslr_jax.extras import require
from eslr_jax.io.palette import linear_to_srgb, srgb_to_linear
from eslr_jax.render.camera import Camera
from eslr_jax.render.denoise import smooth_grain

_VARIANT = "scalar_rgb"
# Direct light only: at equal time a third of the noise of a path tracer, and folds keep their contrast.
_LIGHT_SAMPLES = 4  # per camera ray
_GUIDE_SAMPLES = 4  # camera rays per pixel for the features that guide the denoiser
_GUIDE_RANGE = 3.0  # between the features of two surfaces, whose normals span two
_BACKGROUND = (0.86, 0.87, 0.88)  # sRGB; the lit floor has the same colour, so no horizon shows
_SKY_RADIANCE = np.array([0.20, 0.21, 0.23])  # the fill; radiances are scaled so that 1 is white
_SKY_SHARE = 0.25  # of the light samples
_KNEE = 0.75  # radiance from which highlights bend


@dataclasses.dataclass(frozen=True)
class _Lamp:
    """A square area light far away: nearly parallel rays, soft shadows."""

    name: str
    turn: float  # around +Y from the camera's direction, towards the camera's right [rad]
    height: float  # above the horizon [rad]
    spread: float  # angle that it fills, seen from the subject [rad]
    irradiance: np.ndarray  # [3], on a surface facing it
    sample_share: float  # of the light samples

    @property
    def floor_irradiance(self) -> np.ndarray:
        """Irradiance of level ground, shape [3]."""
        return self.irradiance * math.sin(self.height)


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
class Surface:
    """A mesh with its looks."""

    name: str
    positions: np.ndarray  # [vertices, 3], [m]
    faces: np.ndarray  # [faces, 3]
    color: np.ndarray | tuple[float, ...]  # sRGB in [0, 1], shape [3] or per vertex [vertices, 3]
    is_cloth: bool  # seen from both sides, darker inside


def trace_picture(
    surfaces: Sequence[Surface],
    camera: Camera,
    *,
    ground_height: float,
    size: tuple[int, int],
    samples: int,
) -> np.ndarray:
    """Trace one picture.

    Args:
        surfaces: What stands in the studio.
        camera: Where to look from; the lights turn with it.
        ground_height: Height of the floor [m].
        size: Width and height [pixels].
        samples: Camera rays per pixel, rounded up to a square number.

    Returns:
        sRGB picture, uint8, shape [height, width, 3].
    """
    mitsuba = require("mitsuba")
    with _variant(mitsuba):
        scene = _build_scene(mitsuba, surfaces, camera, ground_height, size, samples)
        pixels = np.array(mitsuba.render(scene, seed=0))
        guide = np.array(mitsuba.render(_build_guide(mitsuba, surfaces, camera, size), seed=0))[..., :3]
    color, opacity = pixels[..., :3], np.clip(pixels[..., 3:], 0.0, 1.0)
    color = smooth_grain(color + (1 - opacity) * srgb_to_linear(_BACKGROUND), guide)
    return np.round(255 * linear_to_srgb(_soft_clip(color))).astype(np.uint8)


def _build_scene(
    mitsuba: ModuleType,
    surfaces: Sequence[Surface],
    camera: Camera,
    ground_height: float,
    size: tuple[int, int],
    samples: int,
):
    """Return a Mitsuba scene; see `trace_picture` for the arguments."""
    description: dict[str, Any] = {
        "type": "scene",
        "integrator": {
            "type": "direct",
            "emitter_samples": _LIGHT_SAMPLES,
            "bsdf_samples": 0,
            "hide_emitters": True,
        },
        "sensor": _sensor(mitsuba, camera, size, samples),
        "sky": {"type": "constant", "radiance": _rgb(_SKY_RADIANCE), "sampling_weight": _SKY_SHARE},
        "floor": _floor(mitsuba, camera.target, ground_height),
    }
    # Mitsuba orders shapes that it makes from nested descriptions by chance, and samples lights in that order:
    # made one by one they keep our order, and the grain repeats from run to run.
    lamps = {lamp.name: _lamp(mitsuba, lamp, camera.target, camera.angle) for lamp in _LAMPS}
    description |= {name: mitsuba.load_dict(lamp) for name, lamp in lamps.items()}
    description |= {surface.name: _mesh(mitsuba, surface) for surface in surfaces}
    return mitsuba.load_dict(description, parallel=False)


def _build_guide(mitsuba: ModuleType, surfaces: Sequence[Surface], camera: Camera, size: tuple[int, int]):
    """Return a scene whose surfaces shine in the colour of their normals, each in a range of its own.

    Its picture is free of noise and tells surfaces apart for the denoiser. Mitsuba's own integrator for such
    features takes ten times as long.
    """
    description: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": _sensor(mitsuba, camera, size, _GUIDE_SAMPLES),
    }
    for number, surface in enumerate(surfaces):
        properties = mitsuba.Properties()
        light = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_feature"}}
        properties["light"] = mitsuba.load_dict(light)
        mesh = _empty_mesh(mitsuba, surface, properties)
        mesh.add_attribute("vertex_feature", 3, np.zeros(3 * len(surface.positions)))
        parameters = _place_vertices(mitsuba, mesh, surface)
        parameters["vertex_feature"] = np.array(parameters["vertex_normals"]) + _GUIDE_RANGE * (number + 1)
        parameters.update()
        description[surface.name] = mesh
    return mitsuba.load_dict(description, parallel=False)


@contextlib.contextmanager
def _variant(mitsuba: ModuleType) -> Iterator[None]:
    """Use our variant, and restore the one that the caller chose."""
    if mitsuba.variant() is None:
        mitsuba.set_variant(_VARIANT)  # variant_context can't return to "none chosen"
    with mitsuba.variant_context(_VARIANT):
        yield


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


def _lamp(mitsuba: ModuleType, lamp: _Lamp, target: np.ndarray, angle: float) -> dict[str, Any]:
    """Return a square light that looks at the target."""
    turn, level = angle + lamp.turn, math.cos(lamp.height)
    direction = np.array([level * math.sin(turn), math.sin(lamp.height), level * math.cos(turn)])
    half_size = _LAMP_DISTANCE * math.tan(lamp.spread / 2)
    radiance = lamp.irradiance * _LAMP_DISTANCE**2 / (2 * half_size) ** 2
    place = _look_at(mitsuba, target + _LAMP_DISTANCE * direction, target)
    return {
        "type": "rectangle",
        "to_world": place @ mitsuba.ScalarTransform4f().scale(half_size),
        "emitter": {"type": "area", "radiance": _rgb(radiance), "sampling_weight": lamp.sample_share},
    }


def _floor(mitsuba: ModuleType, target: np.ndarray, height: float) -> dict[str, Any]:
    """Return level ground that looks like the background where no shadow falls."""
    irradiance = np.pi * _SKY_RADIANCE + sum(lamp.floor_irradiance for lamp in _LAMPS)
    reflectance = np.pi * srgb_to_linear(_BACKGROUND) / irradiance
    place = mitsuba.ScalarTransform4f().translate([float(target[0]), height, float(target[2])])
    return {
        "type": "rectangle",
        "to_world": place.rotate([1, 0, 0], -90).scale(200.0),
        "bsdf": {"type": "diffuse", "reflectance": _rgb(reflectance)},
    }


def _mesh(mitsuba: ModuleType, surface: Surface):
    """Return a smooth-shaded Mitsuba mesh of a surface."""
    color = srgb_to_linear(surface.color)
    has_vertex_colors = color.ndim == 2
    properties = mitsuba.Properties()
    properties["material"] = mitsuba.load_dict(_material(surface, None if has_vertex_colors else color))
    mesh = _empty_mesh(mitsuba, surface, properties)
    if has_vertex_colors:
        mesh.add_attribute("vertex_color", 3, color.reshape(-1))
    _place_vertices(mitsuba, mesh, surface)
    return mesh


def _empty_mesh(mitsuba: ModuleType, surface: Surface, properties):
    """Return a Mitsuba mesh of a surface's size, without its vertices."""
    counts = len(surface.positions), len(surface.faces)
    return mitsuba.Mesh(surface.name, *counts, has_vertex_normals=True, props=properties)


def _place_vertices(mitsuba: ModuleType, mesh, surface: Surface):
    """Write a surface's vertices and faces into its mesh, which computes normals; return its parameters."""
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = np.asarray(surface.positions, np.float32).reshape(-1)
    parameters["faces"] = np.asarray(surface.faces, np.uint32).reshape(-1)
    parameters.update()
    return parameters


def _material(surface: Surface, color: np.ndarray | None) -> dict[str, Any]:
    """Return a matte material; the inside of cloth has three quarters of its colour.

    Args:
        surface: What is made of it.
        color: Linear colour, shape [3]; None reads it from the vertices.
    """

    def diffuse(scale: float) -> dict[str, Any]:
        if color is None:
            return {
                "type": "diffuse",
                "reflectance": {"type": "mesh_attribute", "name": "vertex_color", "scale": scale},
            }
        return {"type": "diffuse", "reflectance": _rgb(scale * color)}

    if not surface.is_cloth:
        return {"type": "twosided", "both": diffuse(1.0)}
    return {"type": "twosided", "outside": diffuse(1.0), "inside": diffuse(0.75)}


def _look_at(mitsuba: ModuleType, origin: np.ndarray, target: np.ndarray):
    """Return a transform at the origin that looks at the target, Y up."""
    return mitsuba.ScalarTransform4f().look_at(
        origin=[float(x) for x in origin], target=[float(x) for x in target], up=[0.0, 1.0, 0.0]
    )


def _rgb(values) -> dict[str, Any]:
    """Return a linear colour or radiance as Mitsuba describes it."""
    return {"type": "rgb", "value": [float(value) for value in values]}


def _soft_clip(radiance: np.ndarray) -> np.ndarray:
    """Bend radiance above the knee towards one, so that highlights keep their shape."""
    excess = np.maximum(radiance - _KNEE, 0.0)
    return np.minimum(radiance, _KNEE) + (1 - _KNEE) * (1 - np.exp(-excess / (1 - _KNEE)))
