"""What is drawn of a garment and a body: a mesh for every garment, for the skin, and for what is worn on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int

from eslr_jax.body.clothing import Skinned, body_layers
from eslr_jax.io.garment import split_outfit
from eslr_jax.io.palette import BODY_COLORS, Color, garment_color

_BODY = ("skin", "top", "shorts")


class Piece(NamedTuple):
    """A mesh of one colour."""

    name: str
    faces: Int[np.ndarray, "faces 3"]  # of its own vertices
    weights: sparse.csr_array | slice  # its vertices from those of the whole
    color: Color

    def place(self, positions: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "own_vertices 3"]:
        """Return where its vertices are [m], given those of the whole [m]."""
        positions = np.asarray(positions, np.float32)
        return positions[self.weights] if isinstance(self.weights, slice) else self.weights @ positions


def garment_pieces(faces: Int[np.ndarray, "faces 3"], outfit: dict[str, int]) -> list[Piece]:
    """Return the garments of an outfit.

    Args:
        faces: Triangles of all of them.
        outfit: Their numbers of vertices, by name and in order.
    """
    faces = np.asarray(faces)
    return [
        Piece(name, faces[is_own] - rows.start, rows, garment_color(number))
        for number, (name, rows, is_own) in enumerate(split_outfit(faces, outfit))
    ]


def body_pieces(
    rest_positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], rig: Skinned | None
) -> list[Piece]:
    """Return skin, top and shorts of a body; see `body_layers`."""
    return [
        Piece(_BODY[layer.kind], layer.faces, layer.weights, BODY_COLORS[layer.kind])
        for layer in body_layers(rest_positions, faces, rig)
    ]
