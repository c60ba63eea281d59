"""Compact groups of neighbouring points, which searches handle together (host)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def compact_groups(points: Float[np.ndarray, "points 3"], size: int) -> Int[np.ndarray, "groups size"]:
    """Split points into compact groups, all full but the last; that one repeats its last point.

    The set is halved along its longest side again and again, at a multiple of `size`, so the number of groups
    depends on the number of points alone.
    """
    pending, groups = [np.arange(len(points))], []
    while pending:
        ids = pending.pop()
        if len(ids) <= size:
            groups.append(np.pad(ids, (0, size - len(ids)), mode="edge"))
            continue
        ordered = ids[np.argsort(points[ids, np.argmax(np.ptp(points[ids], axis=0))], kind="stable")]
        middle = -(-len(ids) // (2 * size)) * size
        pending += [ordered[middle:], ordered[:middle]]
    return np.stack(groups)
