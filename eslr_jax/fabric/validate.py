"""Checks of materials and timesteps on the host, before anything is compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from eslr_jax.errors import ConfigError
from eslr_jax.ranges import Range, check_range

if TYPE_CHECKING:
    from eslr_jax.types import Garment, Material


# Wide on purpose: from the thinnest silk to leather, and an order of magnitude beyond HOOD's training ranges.
MATERIAL_RANGES = {
    "density": Range(1e-3, 10.0, "kg/m^2"),
    "lame_mu": Range(1.0, 1e9, "Pa"),
    "lame_lambda": Range(0.0, 1e9, "Pa"),
    "bending_stiffness": Range(0.0, 1.0, "J"),
    "thickness": Range(1e-6, 2e-2, "m"),
}
TIMESTEP_RANGE = Range(1e-4, 1.0, "s")  # HOOD's first step takes a third of a second


def validate_material(material: Material, garment: Garment | None = None) -> None:
    """Check that every value of a fabric is finite and physical, and that arrays fit the garment.

    Values are scalars, or one per face (stretch, thickness), hinge (bending) or vertex (density) of the garment,
    padded if it will be; None skips the check of sizes.

    Raises:
        ConfigError: Names the field, its value and what is accepted.
    """
    for name, accepted in MATERIAL_RANGES.items():
        values = check_range(f"material {name}", getattr(material, name), accepted)
        if garment is None or not values.ndim:
            continue
        element, count = {
            "density": ("vertex", garment.vertex_areas.shape[0]),
            "bending_stiffness": ("hinge", garment.hinge_rest_areas.shape[0]),
        }.get(name, ("face", garment.rest_areas.shape[0]))
        if values.shape != (count,):
            raise ConfigError(
                f"material {name} has shape {values.shape}; give one number, or one per {element} ({count})"
            )
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


def validate_timestep(timestep: Any) -> None:
    """Raise a ConfigError where the duration of a frame [s] is not a finite number in its range."""
    check_range("timestep", timestep, TIMESTEP_RANGE)
