"""Fit a garment as a program exported it to a body: units, axes, place, pose, skin, pins, penetrations."""

from eslr_jax.fit.fit import FitOptions, fit_garment

__all__ = ["FitOptions", "fit_garment"]
