"""Read and write garments: the project's own archive, and meshes of other programs."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from eslr_jax.errors import AssetError, MeshError
from eslr_jax.files.npz import check_layout, read_arrays, write_arrays
from eslr_jax.files.parsing import split_name
from eslr_jax.mesh.topology import unique_edges
from eslr_jax.pipeline.formats.mesh import Faces, MeshFile, read_mesh_file, shared_vertices
from eslr_jax.pipeline.formats.mesh_sequence import MeshSequence
from eslr_jax.pipeline.formats.registry import find_reader, suffixes_of

# Share of edges that tells the same mesh: quads cut along the other diagonal keep two thirds.
_SAME_EDGES = 0.5
_COPY = re.compile(r"\.\d{3}$")  # what Blender appends to a name that is taken
_LAYOUT = {
    "rest_positions": ("f", "vertices 3"),
    "faces": ("iu", "faces 3"),  # indices are checked when the garment is prepared
    "skin_weights": ("f", "vertices influences"),
    "skin_indices": ("iu", "vertices influences"),
    "pinned": ("biuf", "vertices"),
    "sewn_positions": ("f", "vertices 3"),
    "panel_corners": ("f", "faces 3 2"),
    "corner_uvs": ("f", "faces 3 2"),
    "part_names": ("U", "parts"),
    "face_parts": ("iu", "faces", "parts"),
    "vertex_map": ("iu", "source_vertices"),
    "joined_rows": ("iu", "joined_vertices", "source_vertices"),
}
_TYPES = {"skin_indices": np.int16, "pinned": bool}  # stored, where it is not float32 or int32


@dataclasses.dataclass(frozen=True)
class GarmentFile:
    """A garment that is fitted to a body, and what links it to the file that it came from."""

    rest_positions: Float[np.ndarray, "vertices 3"]  # [m], float64, in the body's rest pose
    faces: Int[np.ndarray, "faces 3"]
    skin_weights: Float[np.ndarray, "vertices influences"]
    skin_indices: Int[np.ndarray, "vertices influences"]
    is_pinned: Bool[np.ndarray, " vertices"]
    # [m], the shape with the garment's own lengths, areas and angles, where the rest pose distorts them
    sewn_positions: Float[np.ndarray, "vertices 3"] | None = None
    # [m], corners of each face on its flat panel, which then measure lengths, areas and angles
    panel_corners: Float[np.ndarray, "faces 3 2"] | None = None
    corner_uvs: Float[np.ndarray, "faces 3 2"] | None = None
    face_parts: Int[np.ndarray, " faces"] | None = None
    part_names: tuple[str, ...] = ()
    vertex_map: Int[np.ndarray, " source_vertices"] | None = None  # vertex of each source vertex, or -1
    # Source vertices that are left where those at one place are joined, as readers of GLB do
    joined_rows: Int[np.ndarray, " joined_vertices"] | None = None
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)  # fabrics, how it was fitted, ...

    @property
    def outfit(self) -> dict[str, int]:
        """Numbers of vertices of the garments that are worn together, by name; one entry for a single garment."""
        return self.metadata.get("outfit") or {"garment": len(self.rest_positions)}

    @property
    def fit_warnings(self) -> list[str]:
        """What was doubtful when the garment was fitted or sewn."""
        return [text for key in ("fit", "sewing") for text in self.metadata.get(key, {}).get("warnings", [])]


def split_outfit(faces: Faces, outfit: dict[str, int]) -> list[tuple[str, slice, Bool[np.ndarray, " faces"]]]:
    """Return of the garments of a `GarmentFile.outfit` the name, the vertices and which of all faces."""
    garments, start = [], 0
    for name, count in outfit.items():
        is_own = (faces[:, 0] >= start) & (faces[:, 0] < start + count)
        garments.append((name, slice(start, start + count), is_own))
        start += count
    return garments


def is_garment_file(path: str | Path) -> bool:
    """Tell whether a file is a fitted garment, and not a mesh that has to be fitted first."""
    return Path(path).suffix.lower() == ".npz" and "skin_weights" in read_arrays(path, content="garment")


def garment_path(text: str | Path) -> Path:
    """Return the file of a garment; only a file of several is followed by the name of one of them."""
    file, _ = split_name(text)
    return Path(file if Path(file).suffix.lower() in suffixes_of("garment") else text)


def read_garment_source(text: str | Path) -> MeshFile:
    """Read a garment of a user: a mesh file, or one garment of HOOD's `garments_dict.pkl`.

    Args:
        text: Path of a file of one of `registry.suffixes_of("mesh", "garment")`; `FILE.pkl#NAME`
            picks one of several.

    Returns:
        The mesh in the file's units and axes.

    Raises:
        AssetError: The file is missing, damaged or of an unknown kind.
        MeshError: It has faces that can't be triangulated.
    """
    path = garment_path(text)
    if path.suffix.lower() in suffixes_of("garment"):
        return find_reader("garment", path)(path, split_name(text)[1])
    return dataclasses.replace(read_mesh_file(path), name=path.stem)


def read_garment_npz(path: str | Path) -> GarmentFile:
    """Read a garment file; all but rest_positions, faces, skin_weights and skin_indices is optional.

    Raises:
        AssetError: The file is missing or damaged, or its arrays don't fit each other.
    """
    return garment_from_arrays(read_arrays(path, content="garment"), path)


def garment_from_arrays(arrays: dict[str, np.ndarray], path: str | Path) -> GarmentFile:
    """Return the garment of a file's arrays; see `read_garment_npz`."""
    what = f"garment file {path}"
    missing = [key for key in list(_LAYOUT)[:4] if key not in arrays]
    if missing:
        raise AssetError(f"{what} lacks {', '.join(missing)}; it has {', '.join(sorted(arrays))}")
    check_layout(arrays, _LAYOUT, what=what, remedy="write it again")
    try:
        metadata = json.loads(str(arrays["metadata"])) if "metadata" in arrays else {}
    except (ValueError, RecursionError) as error:
        raise AssetError(f"{what} has damaged metadata; fit the garment again") from error
    wide = {"f": np.float64, "iu": np.int64}  # for the host
    found = {name: arrays[name] for name in _LAYOUT if name in arrays}
    values = {name: array.astype(wide.get(_LAYOUT[name][0], array.dtype)) for name, array in found.items()}
    values["part_names"] = tuple(map(str, found.get("part_names", ())))
    is_pinned = values.pop("pinned", np.zeros(len(values["rest_positions"]))).astype(bool)
    return GarmentFile(**values, is_pinned=is_pinned, metadata=metadata if isinstance(metadata, dict) else {})


def write_garment_npz(path: str | Path, garment: GarmentFile) -> None:
    """Write a garment file, atomically."""
    write_arrays(path, garment_arrays(garment), is_compressed=True)


def garment_arrays(garment: GarmentFile) -> dict[str, np.ndarray]:
    """Return the arrays of a garment file."""
    values = vars(garment) | {"pinned": garment.is_pinned, "part_names": garment.part_names or None}
    arrays = {}
    for name, (kinds, *_) in _LAYOUT.items():
        if values[name] is not None:
            usual = {"f": np.float32, "iu": np.int32}.get(kinds)
            arrays[name] = np.asarray(values[name], _TYPES.get(name, usual))
    if garment.metadata:
        arrays["metadata"] = np.array(json.dumps(garment.metadata))
    return arrays


def first_rows(order: Int[np.ndarray, " rows"], count: int) -> Int[np.ndarray, " vertices"]:
    """Return the first row of each of `count` vertices in a list of vertices; -1 of those that it lacks."""
    rows = np.full(count, -1, np.int64)
    is_known = order >= 0
    rows[order[is_known][::-1]] = np.flatnonzero(is_known)[::-1]
    return rows


def in_vertex_order(sequence: MeshSequence, garment: GarmentFile) -> Float[np.ndarray, "frames vertices 3"]:
    """Return the positions of a moving garment in the vertex order of its garment file.

    The sequence may have that order, or the order of the mesh that the garment was fitted from, also where a
    format has joined or split the vertices of a seam. It need not have the same faces, as long as most edges are
    the same.

    Raises:
        MeshError: The sequence has other vertices, or another order.
    """
    count, num_rows = len(garment.rest_positions), sequence.positions.shape[1]
    orders = [np.arange(count)]
    if garment.vertex_map is not None and garment.vertex_map.max(initial=-1) < count:
        order = np.asarray(garment.vertex_map, np.int64)
        orders += [order, np.array(list(dict.fromkeys(order[order >= 0])))]
        if garment.joined_rows is not None:
            orders.append(order[garment.joined_rows])
    fitting = [order for order in orders if len(order) == num_rows]
    if not fitting and num_rows > min(map(len, orders)):
        # PLY splits vertices at seams of textures: those at one place in all frames are one.
        kept, place = shared_vertices(sequence.positions.swapaxes(0, 1))
        faces = place[np.asarray(sequence.faces)]
        sequence = dataclasses.replace(sequence, positions=sequence.positions[:, kept], faces=faces)
        fitting = [order for order in orders if len(order) == sequence.positions.shape[1]]
    if not fitting:
        known = " or ".join(dict.fromkeys(str(len(order)) for order in orders))
        raise MeshError(
            f"{sequence.name} has {num_rows} vertices, the garment {known}; give those of the garment"
        )
    wanted = _edges(garment.faces, count)
    for order in fitting:
        rows = first_rows(order, count)
        is_joined = np.isin(wanted, _edges(order[sequence.faces], count))
        if is_joined.mean() > _SAME_EDGES and (rows >= 0).all():
            return sequence.positions[:, rows]
    raise MeshError(
        f"{sequence.name} has edges between other vertices than the garment: its vertices have another order, or "
        "it is another garment; keep the order of the garment's file"
    )


def in_outfit_order(
    sequences: Sequence[MeshSequence], outfit: GarmentFile, garments: Mapping[str, GarmentFile] | None = None
) -> Float[np.ndarray, "frames vertices 3"]:
    """Return the positions of moving garments in the vertex order of what is worn together.

    Args:
        sequences: One mesh of all that is worn; or several, of which every garment's has its name.
        outfit: What is worn, an outfit or a single garment.
        garments: The garments of the outfit as they were before, by name: an order of their own files counts too.
            By default they are cut out of the outfit.

    Raises:
        MeshError: A garment has no mesh or several, or see `in_vertex_order`.
    """
    if len(sequences) == 1:
        return in_vertex_order(sequences[0], outfit)
    garments = garments or {
        name: GarmentFile(
            outfit.rest_positions[rows],
            outfit.faces[is_own] - rows.start,
            outfit.skin_weights[rows],
            outfit.skin_indices[rows],
            outfit.is_pinned[rows],
        )
        for name, rows, is_own in split_outfit(outfit.faces, outfit.outfit)
    }
    meshes = {}
    for name in garments:
        exact = [sequence for sequence in sequences if sequence.mesh == name]
        meshes[name] = exact or [mesh for mesh in sequences if _COPY.sub("", mesh.mesh) == name]
    if missing := [name for name, found in meshes.items() if not found]:
        known = ", ".join(sequence.mesh for sequence in sequences)
        raise MeshError(
            f"{sequences[0].name} is one of the meshes {known}, and none is called "
            f"{' or '.join(missing)}; give every mesh the name of its garment, or score a single one as FILE#NAME"
        )
    if doubled := [name for name, found in meshes.items() if len(found) > 1]:
        known = ", ".join(sequence.mesh for sequence in meshes[doubled[0]])
        raise MeshError(
            f"{sequences[0].name}: the meshes {known} may all be {doubled[0]}; give one of them its name"
        )
    return np.concatenate([in_vertex_order(meshes[name][0], worn) for name, worn in garments.items()], axis=1)


def _edges(faces: Int[np.ndarray, "faces 3"], count: int) -> Int[np.ndarray, " edges"]:
    """Return one number for every edge between known vertices."""
    ends = unique_edges(faces + 1) - 1  # none is negative on the way
    return (ends @ [count, 1])[ends[:, 0] >= 0]
