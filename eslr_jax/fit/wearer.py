"""The body that a garment was fitted to, as its file tells it (host)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from eslr_jax.errors import AssetError, MeshError
from eslr_jax.io.garment import GarmentFile
from eslr_jax.types import Body

_SAME_JOINT = 1e-3  # [m] by which a joint of one body may differ, read from two files
_REMEDY = "give the mesh or the bundled garment that it was made from, which is put on this body"


def wearer_entry(body: Body) -> dict[str, Any]:
    """Return the entry of a garment's metadata that tells its body: the joints, and where they rest [m]."""
    joints = np.asarray(body.joint_rest_positions, np.float64).round(5).tolist()
    return {"body": {"joint_names": list(body.joint_names), "joint_rest_positions": joints}}


def check_wearer(garment: GarmentFile, body: Body, name: str) -> None:
    """Check that a garment was fitted to this body; a file that tells no body passes.

    Args:
        garment: A fitted garment.
        body: The body that is to wear it.
        name: Name of the garment in messages.

    Raises:
        MeshError: It was fitted to another body: one with other joints, or of another shape.
        AssetError: What the file tells of its body is damaged.
    """
    if "body" not in garment.metadata:
        return
    names, joints = _joints(garment, name)
    own = list(body.joint_names)
    if names != own:
        strangers = [joint for joint in (*names, *own) if (joint in names) != (joint in own)]
        which = ", ".join(strangers[:3]) or "in another order"
        raise MeshError(f"{name} was fitted to another body, with other joints ({which}); {_REMEDY}")
    away = _distances(joints, np.asarray(body.joint_rest_positions))
    if away.max(initial=0.0) > _SAME_JOINT:
        joint = int(away.argmax())
        raise MeshError(
            f"{name} was fitted to another body, of another shape (its joint {own[joint]} is "
            f"{1e3 * away[joint]:.0f} mm away); give the shape that it was fitted to, or {_REMEDY}"
        )


def common_wearer(garments: Sequence[GarmentFile], names: Sequence[str]) -> dict[str, Any]:
    """Return the entry of an outfit's metadata that tells its body; empty if no garment has one.

    Raises:
        MeshError: Two garments were fitted to different bodies.
        AssetError: What a garment tells of its body is damaged.
    """
    known = [
        (name, _joints(garment, name), garment.metadata["body"])
        for garment, name in zip(garments, names, strict=True)
        if "body" in garment.metadata
    ]
    for name, (own, places), _ in known[1:]:
        first, (theirs, others), _ = known[0]
        if own != theirs or _distances(places, others).max(initial=0.0) > _SAME_JOINT:
            raise MeshError(f"{name} was fitted to another body than {first}; fit both to the same one")
    return {"body": known[0][2]} if known else {}


def _distances(joints: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return how far the same joints of two bodies are apart at rest [m], shape [joints]."""
    return np.linalg.norm(joints - others, axis=1)


def _joints(garment: GarmentFile, name: str) -> tuple[list[str], np.ndarray]:
    """Return the names of a garment's joints, and where they rest [m], shape [joints, 3]."""
    try:
        entry = garment.metadata["body"]
        names = [str(joint) for joint in entry["joint_names"]]
        joints = np.array(entry["joint_rest_positions"], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise AssetError(f"garment file {name} has damaged metadata; fit the garment again") from error
    if joints.shape != (len(names), 3) or not np.isfinite(joints).all():
        raise AssetError(f"garment file {name} has damaged metadata; fit the garment again")
    return names, joints
