"""The material of a garment: one fabric, or one for each of its parts."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from eslr_jax.errors import ConfigError
from eslr_jax.fabric.materials import COTTON, WOVEN, Weave, fabric_material, fabric_names, isotropic_nearest
from eslr_jax.fabric.validate import MATERIAL_RANGES
from eslr_jax.mesh.plate import prepare_plate, warp_directions
from eslr_jax.mesh.topology import find_hinges, vertex_areas
from eslr_jax.networks.features import (
    BENDING_RANGE,
    DENSITY_RANGE,
    LAME_LAMBDA_RANGE,
    LAME_MU_RANGE,
    sheet_constants,
)
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.terms.bending import RIGIDITY_PER_STIFFNESS
from eslr_jax.types import Garment, Material, Threads

_SHEET = tuple(MATERIAL_RANGES)  # numbers of an isotropic sheet
_STIFFNESS = ("warp_stretch", "weft_stretch", "coupling", "shear")
_RIGIDITY = ("flexural_rigidity", "warp_rigidity", "weft_rigidity")
_LIMITS = ("stretch_limit", "warp_limit", "weft_limit")
_SEAMS = "seams"  # the part of a sewn garment that is the lines along its seams
_NUMBERS = (*_SHEET, *_STIFFNESS, *_RIGIDITY, *_LIMITS)
FABRIC_FORMS = "NAME or density=0.2,lame_mu=23600,..., for one part as PART:NAME"


class Described(NamedTuple):
    """A fabric that is not on a garment yet."""

    sheet: Material  # the isotropic sheet, or the one nearest to the weave
    weave: Weave | None  # None: the sheet is all


def worn_fabrics(texts: Sequence[str], stored: GarmentFile) -> tuple[str, ...]:
    """Return the descriptions that hold for a garment; see `garment_material`.

    Those for parts change what the file has, and one for the whole garment replaces it.
    """
    own = tuple(str(text) for text in stored.metadata.get("fabrics", ()))
    return (*own, *texts) if all(":" in text for text in texts) else tuple(texts)


def garment_material(texts: Sequence[str], garment: Garment, stored: GarmentFile) -> Material:
    """Return the material that descriptions give to a garment.

    A fabric may have warp and weft of its own, and bending by flexural rigidity: `denim-woven` and others of
    `fabric.materials.WOVEN`, or the numbers `flexural_rigidity` or `warp_rigidity` and `weft_rigidity` [N
    m]; `warp_stretch`, `weft_stretch`, `coupling` and `shear` [N/m]; `stretch_limit`, or `warp_limit` and
    `weft_limit`, the strain beyond which threads stiffen. The warp runs along the second texture coordinate
    of the file, or up.

    Args:
        texts: Descriptions, each for the whole garment or, as `PART:DESCRIPTION`, for one part. A description is
            a fabric's name, or numbers such as `density=0.2,lame_mu=23600`: `density` [kg/m^2], `lame_mu` and
            `lame_lambda` [Pa], `bending_stiffness` [J], `thickness` [m]; cotton's value where one is missing.
            In an outfit the name of a garment stands for all its parts. If none is for the whole garment, the
            rest keeps those in the file, or else is cotton. The part `seams` of a garment that was sewn from a
            pattern is the lines along its seams: they bend as that fabric does.
        garment: Prepared garment.
        stored: Garment file with the parts.

    Returns:
        Scalars for one fabric. For several, a value per face (stretch), hinge (bending) and vertex (density).

    Raises:
        ConfigError: A fabric or a part is unknown, or a number is impossible; or seams have a fabric, and others
            bend by flexural rigidity.
    """
    whole, parts, seams = Described(COTTON, None), {}, None
    for text in worn_fabrics(texts, stored):
        part, separator, rest = text.rpartition(":")
        if not separator:
            whole = describe_fabric(text)
        elif part == _SEAMS and "sewing" in stored.metadata:
            seams = describe_fabric(rest).sheet
        elif stored.face_parts is None or not (owned := _parts_of(part, stored)):
            known = ", ".join(stored.part_names) or "none"
            raise ConfigError(f"fabric {text!r}: the garment has no part {part!r}; parts: {known}")
        else:
            parts |= dict.fromkeys(owned, describe_fabric(rest))
    if not parts or stored.face_parts is None:
        sheet = whole.sheet
    else:
        sheets = {part: one.sheet for part, one in parts.items()}
        sheet = _mixed(whole.sheet, sheets, np.asarray(stored.face_parts), garment)
    if seams is not None:
        sheet = _along_seams(sheet, seams, garment, stored)
    if all(one.weave is None for one in (whole, *parts.values())):
        return sheet
    owners = np.full(int(np.sum(np.asarray(garment.rest_areas) > 0)), -1)
    if parts and stored.face_parts is not None:
        owners[:] = stored.face_parts
    warp = warp_directions(garment, stored.corner_uvs)
    fabrics = [(np.ones_like(owners, bool), whole), *((owners == part, one) for part, one in parts.items())]
    woven = on_threads(sheet, garment, warp, fabrics)
    if seams is not None and woven.plate is not None:
        raise ConfigError(
            f"fabric {_SEAMS}: seams bend by bending_stiffness, the garment by flexural rigidity; drop one"
        )
    return woven


def _along_seams(sheet: Material, seams: Material, garment: Garment, stored: GarmentFile) -> Material:
    """Return a fabric that along the seams of a garment bends as another one."""
    bending = np.array(np.broadcast_to(sheet.bending_stiffness, len(garment.hinges)), np.float32)
    ends = np.asarray(garment.hinges)[:, :2]
    for vertices in stored.metadata["sewing"]["seams"].values():
        bending[np.isin(ends, vertices).all(axis=1)] = seams.bending_stiffness
    return sheet.replace(bending_stiffness=bending)


def _parts_of(name: str, stored: GarmentFile) -> list[int]:
    """Return the numbers of the parts with a name: one, or all of a garment in an outfit."""
    inner = f"{name}/" if name in stored.outfit else None
    return [
        number
        for number, part in enumerate(stored.part_names)
        if part == name or (inner is not None and part.startswith(inner))
    ]


def on_threads(
    sheet: Material,
    garment: Garment,
    warp: Float[np.ndarray, "faces 2"],
    fabrics: Sequence[tuple[Bool[np.ndarray, " faces"], Described]],
) -> Material:
    """Return a material with the weave of fabrics on a garment.

    Args:
        sheet: What networks read, and vertices weigh.
        garment: Prepared garment.
        warp: Direction of the warp on its real faces, of `warp_directions`.
        fabrics: The real faces of each fabric; later ones replace earlier ones.
    """
    count, num_faces = len(warp), len(np.asarray(garment.rest_areas))
    stiffness, rigidity = np.zeros((num_faces, 4)), np.zeros((count, 2))
    limits = np.full((num_faces, 2), np.inf)
    weaves = [one.weave or Weave() for _, one in fabrics]
    has_limits = any(weave.limits is not None for weave in weaves)
    for (is_own, one), weave in zip(fabrics, weaves, strict=True):
        stiffness[:count][is_own] = weave.stiffness or _sheet_stiffness(one.sheet)
        rigidity[is_own] = weave.rigidity or [RIGIDITY_PER_STIFFNESS * float(one.sheet.bending_stiffness)] * 2
        if weave.limits is not None:  # a length 1 + e has the Green strain e + e^2 / 2
            limits[:count][is_own] = [limit + 0.5 * limit**2 for limit in weave.limits]
    threads = plate = None
    if has_limits or any(weave.stiffness is not None for weave in weaves):
        directions = np.zeros((num_faces, 2), np.float32)
        directions[:count] = warp
        threads = Threads(
            warp=jnp.asarray(directions),
            stiffness=jnp.asarray(stiffness.T, jnp.float32),
            # Finite, so that gradients are: no fabric reaches this strain.
            limits=jnp.asarray(np.minimum(limits.T, 1e3), jnp.float32) if has_limits else None,
        )
    if any(weave.rigidity is not None for weave in weaves):
        plate = jax.tree.map(jnp.asarray, prepare_plate(garment, warp, rigidity))
    return sheet.replace(threads=threads, plate=plate)


def _sheet_stiffness(sheet: Material) -> tuple[float, float, float, float]:
    """Return the stiffness along any two threads of an isotropic sheet [N/m]."""
    mu, lame = (float(value) * float(sheet.thickness) for value in (sheet.lame_mu, sheet.lame_lambda))
    return 2.0 * mu + lame, 2.0 * mu + lame, lame, mu


def beyond_training(material: Material) -> tuple[str, ...]:
    """Return the names of the constants outside the ranges that networks are trained on (HOOD's).

    Mu and lambda are compared for HOOD's thickness, as networks read them.
    """
    lame_mu, lame_lambda = sheet_constants(material)
    values = {
        "density": (material.density, DENSITY_RANGE),
        "lame_mu": (lame_mu, LAME_MU_RANGE),
        "lame_lambda": (lame_lambda, LAME_LAMBDA_RANGE),
        "bending_stiffness": (material.bending_stiffness, BENDING_RANGE),
    }
    return tuple(
        name
        for name, (value, (low, high)) in values.items()
        if np.min(value) < 0.99 * low or np.max(value) > 1.01 * high
    )


def parse_fabric(text: str) -> Material:
    """Return the isotropic fabric of a name or of numbers; see `garment_material`.

    Raises:
        ConfigError: The name is unknown, a number is impossible, or the fabric has threads.
    """
    described = describe_fabric(text)
    if described.weave is not None:
        raise ConfigError(f"fabric {text!r} has threads, which lie on a mesh; give it to garment_material")
    return described.sheet


def describe_fabric(text: str) -> Described:
    """Return the fabric of a name or of numbers, off any garment; see `garment_material`.

    Raises:
        ConfigError: The name is unknown, or a number is impossible.
    """
    if text in WOVEN:
        woven = WOVEN[text]
        sheet = COTTON.replace(density=np.float32(woven.density))
        return Described(isotropic_nearest(woven.weave, sheet), woven.weave)
    if "=" not in text:
        if text not in fabric_names():
            names = (*fabric_names(), *WOVEN)
            close = difflib.get_close_matches(text, names, n=1)
            hint = f"did you mean {close[0]}? " if close else ""
            raise ConfigError(
                f"no fabric {text!r}: {hint}there are {', '.join(names)}; or write {FABRIC_FORMS}"
            )
        return Described(fabric_material(text), None)
    values: dict[str, np.float32] = {}
    for word in text.split(","):
        key, _, number = (part.strip() for part in word.partition("="))
        if key not in _NUMBERS:
            raise ConfigError(f"fabric {text!r}: {key!r} is unknown; use {', '.join(_NUMBERS)}")
        try:
            values[key] = np.float32(number)
        except ValueError as error:
            raise ConfigError(f"fabric {text!r}: {number!r} is not a number") from error
        if not (np.isfinite(values[key]) and values[key] > 0):
            raise ConfigError(f"fabric {text!r}: {key} must be positive")
    sheet = COTTON.replace(**{key: values.pop(key) for key in _SHEET if key in values})
    weave = _weave({key: float(value) for key, value in values.items()}, sheet, text)
    return Described(sheet if weave is None else isotropic_nearest(weave, sheet), weave)


def _weave(values: dict[str, float], sheet: Material, text: str) -> Weave | None:
    """Return the weave of numbers; what lacks along one thread is taken from the other, or from the sheet."""
    if not values:
        return None

    def pair(both: str, warp: str, weft: str) -> tuple[float, float] | None:
        along = values.get(warp, values.get(both, values.get(weft)))
        across = values.get(weft, values.get(both, values.get(warp)))
        return None if along is None or across is None else (along, across)

    stiffness = None
    if any(key in values for key in _STIFFNESS):
        usual = _sheet_stiffness(sheet)
        warp, weft = pair("", "warp_stretch", "weft_stretch") or usual[:2]
        coupling, shear = values.get("coupling", 0.0), values.get("shear", usual[3])
        if coupling**2 >= warp * weft:
            raise ConfigError(
                f"fabric {text!r}: coupling must be less than the mean of warp and weft stretch"
            )
        stiffness = warp, weft, coupling, shear
    return Weave(stiffness, pair(*_RIGIDITY), pair(*_LIMITS))


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
    density = np.where(area > 0, mass / np.where(area > 0, area, 1.0), float(whole.density))
    bending = np.full(len(garment.hinges), float(whole.bending_stiffness))
    hinge_faces = find_hinges(faces[: len(face_parts)])[1]  # in the order of the garment's hinges
    bending[: len(hinge_faces)] = by_face("bending_stiffness")[hinge_faces].mean(axis=1)
    return Material(
        density=np.float32(density),
        lame_mu=np.float32(by_face("lame_mu")),
        lame_lambda=np.float32(by_face("lame_lambda")),
        bending_stiffness=np.float32(bending),
        thickness=np.float32(by_face("thickness")),
    )
