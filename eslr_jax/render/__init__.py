"""Pictures and video without a display or a GPU (extra `render`)."""

from eslr_jax.render.colors import color_scale
from eslr_jax.render.files import write_png, write_video
from eslr_jax.render.pictures import contact_sheet, render_frame, render_frames, side_by_side

__all__ = [
    "color_scale",
    "contact_sheet",
    "render_frame",
    "render_frames",
    "side_by_side",
    "write_png",
    "write_video",
]
