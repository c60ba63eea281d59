"""Pictures and video without a display or a GPU (extra `render`)."""

from eslr_jax.pipeline.pictures.annotate import (
    add_color_bar,
    color_scale,
    side_by_side,
    write_label,
    write_png,
    write_video,
)
from eslr_jax.pipeline.pictures.pictures import contact_sheet, moment_text, render_frame, render_frames

__all__ = [
    "add_color_bar",
    "color_scale",
    "contact_sheet",
    "moment_text",
    "render_frame",
    "render_frames",
    "side_by_side",
    "write_label",
    "write_png",
    "write_video",
]
