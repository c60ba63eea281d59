"""Runs in the browser, side by side, with a timeline (extra `view`)."""

from eslr_jax.viewer.page import View, go_to_worst, open_view, play, show

__all__ = ["View", "go_to_worst", "open_view", "play", "show"]
