"""The material of a garment: one fabric, or one for each of its parts."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Sequence

import numpy as np

from eslr_jax.errors import ConfigError
from eslr_jax.geometry.topology import find_hinges, vertex_areas
from eslr_jax.graph.features import BENDING_RANGE, LAME_LAMBDA_RANGE, LAME_MU_RANGE
from eslr_jax.io.garment import GarmentFile
from eslr_jax.physics.materials import COTTON, fabric_material, fabric_names
from eslr_jax.types import Garment, Material

_NUMBERS = tuple(field.name for field in dataclasses.fields(Material))
FABRIC_FORMS = "NAME or density=0.2,lame_mu=23600,..., for one part as PART:NAME"


def garment_material(texts: Sequence[str], garment: Garment, stored: GarmentFile) -> Material:
    """Return the material that descriptions give to a garment.

    Args:
        texts: Descriptions, each for the whole garment or, as `PART:DESCRIPTION`, for one part. A description is
            a fabric's name, or numbers such as `density=0.2,lame_mu=23600`: `density` [kg/m^2], `lame_mu` and
            `lame_lambda` [Pa], `bending_stiffness` [J], `thickness` [m]; cotton's value where one is missing.
            Without descriptions, those in the file, or else cotton.
        garment: Prepared garment.
        stored: Garment file with the parts.

    Returns:
        Scalars for one fabric. For several, a value per face (stretch), hinge (bending) and vertex (density).

    Raises:
        ConfigError: A fabric or a part is unknown, or a number is impossible.
    """
    texts = tuple(texts) or tuple(str(text) for text in stored.metadata.get("fabrics", ()))
    whole, parts = COTTON, {}
    for text in texts:
        part, separator, rest = text.rpartition(":")
        if not separator:
            whole = parse_fabric(text)
        elif stored.face_parts is None or part not in stored.part_names:
            known = ", ".join(stored.part_names) or "none"
            raise ConfigError(f"fabric {text!r}: the garment has no part {part!r}; parts: {known}")
        else:
            parts[stored.part_names.index(part)] = parse_fabric(rest)
    if not parts or stored.face_parts is None:
        return whole
    return _mixed(whole, parts, np.asarray(stored.face_parts), garment)


def beyond_training(material: Material) -> tuple[str, ...]:
    """Return the names of the constants outside the ranges that networks are trained on (HOOD's)."""
    ranges = {
        "lame_mu": LAME_MU_RANGE,
        "lame_lambda": LAME_LAMBDA_RANGE,
        "bending_stiffness": BENDING_RANGE,
    }
    values = {name: np.asarray(getattr(material, name)) for name in ranges}
    return tuple(
        name
        for name, (low, high) in ranges.items()
        if values[name].min() < 0.99 * low or values[name].max() > 1.01 * high
    )


def parse_fabric(text: str) -> Material:
    """Return the fabric of a name or of numbers; see `garment_material`.

    Raises:
        ConfigError: The name is unknown, or a number is impossible.
    """
    if "=" not in text:
        if text not in fabric_names():
            close = difflib.get_close_matches(text, fabric_names(), n=1)
            hint = f"did you mean {close[0]}? " if close else ""
            known = ", ".join(fabric_names())
            raise ConfigError(f"no fabric {text!r}: {hint}there are {known}; or write {FABRIC_FORMS}")
        return fabric_material(text)
    values = {}
    for word in text.split(","):
        key, _, number = word.partition("=")
        if key.strip() not in _NUMBERS:
            raise ConfigError(f"fabric {text!r}: {key.strip()!r} is unknown; use {', '.join(_NUMBERS)}")
        try:
            values[key.strip()] = np.float32(number)
        except ValueError as error:
            raise ConfigError(f"fabric {text!r}: {number!r} is not a number") from error
        if not (np.isfinite(values[key.strip()]) and values[key.strip()] > 0):
            raise ConfigError(f"fabric {text!r}: {key.strip()} must be positive")
    return COTTON.replace(**values)


def _mixed(whole: Material, parts: dict[int, Material], face_parts: np.ndarray, garment: Garment) -> Material:
    """Spread fabrics over faces, hinges (mean of both faces) and vertices (mean weighted by area)."""
    faces, areas = np.asarray(garment.faces), np.asarray(garment.rest_areas, np.float64)
    owner = np.full(len(faces), -1)  # padded faces keep the fabric of the whole
    owner[: len(face_parts)] = face_parts

    def by_face(name: str) -> np.ndarray:
        values = np.full(len(faces), float(getattr(whole, name)))
        for part, material in parts.items():
            values[owner == part] = float(getattr(material, name))
        return values

    num_vertices = len(garment.vertex_areas)
    mass = vertex_areas(areas * by_face("density"), faces, num_vertices)
    area = vertex_areas(areas, faces, num_vertices)
    bending = np.full(len(garment.hinges), float(whole.bending_stiffness))
    hinge_faces = find_hinges(faces[: len(face_parts)])[1]  # in the order of the garment's hinges
    bending[: len(hinge_faces)] = by_face("bending_stiffness")[hinge_faces].mean(axis=1)
    return Material(
        density=np.float32(np.where(area > 0, mass / np.where(area > 0, area, 1.0), float(whole.density))),
        lame_mu=np.float32(by_face("lame_mu")),
        lame_lambda=np.float32(by_face("lame_lambda")),
        bending_stiffness=np.float32(bending),
        thickness=np.float32(by_face("thickness")),
    )
