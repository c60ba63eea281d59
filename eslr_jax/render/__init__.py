"""Pictures and video without a display or a GPU (extra `render`)."""

from eslr_jax.render.files import write_png, write_video
from eslr_jax.render.pictures import contact_sheet, render_frame, render_frames

__all__ = ["contact_sheet", "render_frame", "render_frames", "write_png", "write_video"]
