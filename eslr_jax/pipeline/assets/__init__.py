"""Bundled bodies, garments, motions and networks, loaded by name, and those of a user by path."""

from eslr_jax.pipeline.assets.catalog import asset_names, data_folder, load_splits, split_clips
from eslr_jax.pipeline.assets.garments import load_garment, load_garment_file, prepare_stored
from eslr_jax.pipeline.assets.models import load_model
from eslr_jax.pipeline.assets.motions import load_body, load_motion

__all__ = [
    "asset_names",
    "data_folder",
    "load_body",
    "load_garment",
    "load_garment_file",
    "load_model",
    "load_motion",
    "load_splits",
    "prepare_stored",
    "split_clips",
]
