"""A moment on the command line: a frame, such as 375, or a time, such as 12.5s."""

from __future__ import annotations

import math

from eslr_jax.errors import ConfigError


def parse_seconds(text: str, fps: float, *, option: str) -> float:
    """Return a moment's time [s].

    Args:
        text: A frame, such as 375, or a time with its unit, such as 12.5s.
        fps: Frames per second that frames are counted at.
        option: What messages call the option.

    Raises:
        ConfigError: The text is neither.
    """
    try:
        seconds = float(text[:-1]) if text.endswith("s") else int(text) / fps
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds >= 0):
        raise ConfigError(f"{option} {text}: give a frame, such as 375, or a time, such as 12.5s")
    return seconds
