"""Runs in the browser, side by side, with a timeline (extra `view`)."""

from eslr_jax.pipeline.page.page import View, go_to_worst, open_view, play, show

__all__ = ["View", "go_to_worst", "open_view", "play", "show"]
