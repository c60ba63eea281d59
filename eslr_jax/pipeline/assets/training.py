"""The bundled garments and clips of a training run."""

from __future__ import annotations

from eslr_jax.config import TrainConfig
from eslr_jax.mesh.prepare import pad_alike
from eslr_jax.pipeline.assets import load_body, load_garment, load_motion, split_clips
from eslr_jax.training.data import TrainingData, build_training_data


def load_training_data(config: TrainConfig, vertices: str) -> TrainingData:
    """Load the garments at one resolution and the clips of a training run.

    Raises:
        ConfigError: The split is unknown or empty.
        AssetError: A garment does not exist.
    """
    options = getattr(config.model, "garment_options", {})
    unpadded = [load_garment(name, vertices=vertices, **options) for name in config.garments]  # type: ignore[arg-type]
    motions = [load_motion(clip) for clip in split_clips(config.split)]
    return build_training_data(pad_alike(unpadded), load_body(), motions, has_shapes=config.shape_range > 0)
