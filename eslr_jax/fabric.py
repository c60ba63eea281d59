"""What a garment is made of: one fabric, or one for each of its parts."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Sequence

import numpy as np

from eslr_jax.errors import ConfigError
from eslr_jax.graph.features import BENDING_RANGE, LAME_LAMBDA_RANGE, LAME_MU_RANGE
from eslr_jax.io.garment import GarmentFile
from eslr_jax.physics.materials import COTTON, fabric_material, fabric_names
from eslr_jax.types import Garment, Material

_NUMBERS = tuple(field.name for field in dataclasses.fields(Material))
FABRIC_FORMS = "NAME, or density=0.2,lame_mu=23600,..., either of them behind PART:"


def garment_material(texts: Sequence[str], garment: Garment, stored: GarmentFile) -> Material:
    """Return the material of a garment from what was written about it.

    Args:
        texts: Each a fabric's name, or numbers (`density` [kg/m^2], `lame_mu`, `lame_lambda` [Pa],
            `bending_stiffness` [J], `thickness` [m]; what is not given is cotton's), for the whole garment or,
            behind `PART:`, for one part. None: what the file says, or else cotton.
        garment: The prepared garment.
        stored: Its file, with parts.

    Returns:
        Scalars for one fabric; with several, one value a face (stretch), hinge (bending) and vertex (density).

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
    """Return the constants that leave the ranges on which networks are trained (HOOD's)."""
    ranges = {
        "lame_mu": LAME_MU_RANGE,
        "lame_lambda": LAME_LAMBDA_RANGE,
        "bending_stiffness": BENDING_RANGE,
    }
    return tuple(
        name
        for name, (low, high) in ranges.items()
        if np.any(np.asarray(getattr(material, name)) < 0.99 * low)
        or np.any(np.asarray(getattr(material, name)) > 1.01 * high)
    )


def parse_fabric(text: str) -> Material:
    """Return a fabric by name or by numbers.

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
            raise ConfigError(f"fabric {text!r}: {key.strip()!r} is none of {', '.join(_NUMBERS)}")
        try:
            values[key.strip()] = np.float32(number)
        except ValueError as error:
            raise ConfigError(f"fabric {text!r}: {number!r} is no number") from error
        if not (np.isfinite(values[key.strip()]) and values[key.strip()] > 0):
            raise ConfigError(f"fabric {text!r}: {key.strip()} must be positive")
    return COTTON.replace(**values)


def _mixed(whole: Material, parts: dict[int, Material], face_parts: np.ndarray, garment: Garment) -> Material:
    """Spread fabrics over faces, hinges (the mean of both sides) and vertices (weighted by area)."""
    faces, hinges = np.asarray(garment.faces), np.asarray(garment.hinges)
    areas = np.asarray(garment.rest_areas, np.float64)
    owner = np.full(len(faces), -1)  # padded faces stay with the whole
    owner[: len(face_parts)] = face_parts

    def by_face(name: str) -> np.ndarray:
        values = np.full(len(faces), float(getattr(whole, name)))
        for part, material in parts.items():
            values[owner == part] = float(getattr(material, name))
        return values

    def by_vertex(name: str) -> np.ndarray:
        total, mass = np.zeros(len(garment.vertex_areas)), np.zeros(len(garment.vertex_areas))
        for corner in range(3):
            np.add.at(total, faces[:, corner], areas)
            np.add.at(mass, faces[:, corner], areas * by_face(name))
        return np.where(total > 0, mass / np.where(total > 0, total, 1.0), float(getattr(whole, name)))

    face_of = {}
    for face, corners in enumerate(faces[: len(face_parts)].tolist()):
        for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
            face_of[start, end] = face
    bending = by_face("bending_stiffness")
    by_hinge = np.full(len(hinges), float(whole.bending_stiffness))
    for hinge, (start, end) in enumerate(hinges[:, :2].tolist()):
        if (start, end) in face_of and (end, start) in face_of:
            by_hinge[hinge] = 0.5 * (bending[face_of[start, end]] + bending[face_of[end, start]])
    return Material(
        density=np.float32(by_vertex("density")),
        lame_mu=np.float32(by_face("lame_mu")),
        lame_lambda=np.float32(by_face("lame_lambda")),
        bending_stiffness=np.float32(by_hinge),
        thickness=np.float32(by_face("thickness")),
    )
