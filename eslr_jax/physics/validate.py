"""Checks of materials, constants and timesteps on the host, before anything is compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from eslr_jax.errors import ConfigError

if TYPE_CHECKING:
    from eslr_jax.terms.air import Air
    from eslr_jax.types import Garment, Material, PhysicsConstants


class Range(NamedTuple):
    """Smallest and largest value that is accepted, both included."""

    low: float
    high: float
    unit: str


# Wide on purpose: from the thinnest silk to leather, and an order of magnitude beyond HOOD's training ranges.
MATERIAL_RANGES = {
    "density": Range(1e-3, 10.0, "kg/m^2"),
    "lame_mu": Range(1.0, 1e9, "Pa"),
    "lame_lambda": Range(0.0, 1e9, "Pa"),
    "bending_stiffness": Range(0.0, 1.0, "J"),
    "thickness": Range(1e-6, 2e-2, "m"),
}
CONSTANT_RANGES = {
    "gravity": Range(1e-2, 100.0, "m/s^2"),  # not zero: residuals are measured in weights
    "collision_stiffness": Range(0.0, 1e12, "J/m^5"),
    "collision_thickness": Range(0.0, 5e-2, "m"),
    "friction_coefficient": Range(0.0, 10.0, ""),
    "friction_speed": Range(1e-6, 1.0, "m/s"),  # not zero: it divides
    "repulsion_stiffness": Range(0.0, 1e12, "J/m^5"),
    "repulsion_thickness": Range(0.0, 5e-2, "m"),
}
AIR_RANGES = {
    "density": Range(0.0, 1e3, "kg/m^3"),  # up to water
    "normal_drag": Range(0.0, 10.0, ""),
    "tangential_drag": Range(0.0, 10.0, ""),
}
WIND_RANGE = Range(-100.0, 100.0, "m/s")
DAMPING_RANGE = Range(0.0, 1.0, "s")
TIMESTEP_RANGE = Range(1e-4, 1.0, "s")  # HOOD's first step takes a third of a second


def validate_material(material: Material, garment: Garment | None = None) -> None:
    """Check that every value of a fabric is finite and physical, and that arrays fit the garment.

    Args:
        material: Scalars, or one value per face (stretch, thickness), hinge (bending) or vertex (density).
        garment: The garment it is for, padded if it will be; None skips the check of sizes.

    Raises:
        ConfigError: Names the field, its value and what is accepted.
    """
    for name, accepted in MATERIAL_RANGES.items():
        values = _check_range(f"material {name}", getattr(material, name), accepted)
        if garment is not None and values.ndim:
            _check_shape(name, values, garment)
    if garment is None:
        return
    faces = len(np.asarray(garment.rest_areas))
    for name, part in (("plate", material.plate), ("threads", material.threads)):
        count = None if part is None else len(part.hinges if name == "plate" else part.warp)
        if count not in (None, faces):
            raise ConfigError(
                f"material {name} is of {count} faces, the garment has {faces}; make it with garment_material "
                "for this garment, padded if that is"
            )


def validate_constants(constants: PhysicsConstants) -> None:
    """Check that the constants of a scene are finite scalars in their ranges.

    Raises:
        ConfigError: Names the parameter, its value and what is accepted.
    """
    for name, value in vars(constants).items():
        accepted = CONSTANT_RANGES.get(name, Range(-np.inf, np.inf, ""))
        values = _check_range(name, value, accepted)
        if values.ndim:
            raise ConfigError(f"{name} has shape {values.shape}; give one number for the whole scene")


def validate_timestep(timestep: Any) -> None:
    """Check the duration of a frame [s].

    Raises:
        ConfigError: It is not a finite number in its range.
    """
    _check_range("timestep", timestep, TIMESTEP_RANGE)


def validate_air(air: Air) -> Air:
    """Check the air of a scene, and return it with arrays in the place of sequences.

    Raises:
        ConfigError: The wind is no velocity, or a number is not finite or out of range.
    """
    for name, accepted in AIR_RANGES.items():
        _check_range(f"air {name}", getattr(air, name), accepted)
    if callable(air.wind):
        from eslr_jax.numerics import as_partial

        return air.replace(wind=as_partial(air.wind))
    if _check_range("wind", air.wind, WIND_RANGE).shape != (3,):
        raise ConfigError(f"wind = {air.wind!r} is no velocity; give three numbers in m/s, such as 3, 0, 0")
    return air.replace(wind=np.asarray(air.wind, np.float32))


def validate_damping(damping: Any) -> Any:
    """Check the damping of a fabric [s], and return it.

    Raises:
        ConfigError: It is not a finite number in its range.
    """
    if _check_range("damping", damping, DAMPING_RANGE).ndim:
        raise ConfigError("damping is one number for the whole scene [s]")
    return damping


def validate_substeps(substeps: Any) -> int:
    """Check the number of substeps of a frame, and return it.

    Raises:
        ConfigError: It is no whole number from one on.
    """
    if isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1:
        raise ConfigError(f"substeps = {substeps!r}; give a whole number, 1 or more")
    return substeps


def _check_range(label: str, value: Any, accepted: Range) -> np.ndarray:
    """Return `value` as an array; raise where it is not finite or out of range."""
    try:
        values = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{label} = {value!r} is not a number; give {_describe(accepted)}") from error
    # In float32 a bound itself may lie a rounding error outside.
    is_finite = np.isfinite(values)
    known = np.where(is_finite, values, 0.0)
    slack = np.finfo(np.float32).eps * np.abs(known)
    is_good = is_finite & (known + slack >= accepted.low) & (known - slack <= accepted.high)
    if not is_good.all():
        index = tuple(int(k) for k in np.argwhere(~is_good)[0])
        place = f"[{', '.join(map(str, index))}]" if index else ""
        raise ConfigError(f"{label}{place} = {values[index]:.6g}; give {_describe(accepted)}")
    return values


def _describe(accepted: Range) -> str:
    if not np.isfinite(accepted.high):
        return "a finite number"
    return f"a value from {accepted.low:g} to {accepted.high:g} {accepted.unit}".rstrip()


def _check_shape(name: str, values: np.ndarray, garment: Garment) -> None:
    """Raise where an array of a fabric doesn't have one value per element of the garment."""
    element, count = {
        "density": ("vertex", garment.vertex_areas.shape[0]),
        "bending_stiffness": ("hinge", garment.hinge_rest_areas.shape[0]),
    }.get(name, ("face", garment.rest_areas.shape[0]))
    if values.shape != (count,):
        raise ConfigError(
            f"material {name} has shape {values.shape}; give one number, or one per {element} ({count})"
        )
