"""Animated meshes as USD with time samples, with the extra `usd`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eslr_jax.errors import AssetError, MissingExtraError
from eslr_jax.io.atomic import atomic_write
from eslr_jax.io.color import srgb_to_linear

if TYPE_CHECKING:
    from eslr_jax.io.gltf import AnimatedMesh

SUFFIXES = (".usd", ".usda", ".usdc")


def write_usd(path: str | Path, meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Write meshes as a USD stage, one time code a frame, atomically.

    Vertices keep their order; texture coordinates are the face-varying primvar `st`. Metres, Y up.

    Args:
        path: The file; `.usda` is text, `.usd` and `.usdc` are binary.
        meshes: Meshes with the same number of frames.
        timestep: Time between frames [s].

    Raises:
        MissingExtraError: The extra is not installed.
        AssetError: The suffix is unknown, or the file can't be written.
    """
    try:
        from pxr import Sdf, Usd, UsdGeom  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingExtraError('USD needs the extra usd: pip install "eslr-jax[usd]"') from error
    if Path(path).suffix.lower() not in SUFFIXES:
        raise AssetError(f"can't write {path} as USD; name it one of {', '.join(SUFFIXES)}")
    with atomic_write(path) as temporary:
        stage = Usd.Stage.CreateNew(str(temporary))
        if stage is None:
            raise AssetError(f"can't write {path}: USD refuses the name; choose another")
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(1.0 / timestep)
        stage.SetFramesPerSecond(1.0 / timestep)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(max(len(mesh.positions) for mesh in meshes) - 1)
        world = UsdGeom.Xform.Define(stage, "/World")
        stage.SetDefaultPrim(world.GetPrim())
        taken: set[str] = set()
        for mesh in meshes:
            _add_mesh(stage, mesh, _identifier(mesh.name, taken), Sdf, UsdGeom)
        stage.GetRootLayer().Save()
        del stage, world  # the layer keeps the file open


def _identifier(name: str, taken: set[str]) -> str:
    """Return a prim name: letters, digits and underscores, unlike the others."""
    base = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in name) or "mesh"
    base = f"_{base}" if base[0].isdigit() else base
    result, number = base, 2
    while result in taken:
        result, number = f"{base}_{number}", number + 1
    taken.add(result)
    return result


def _add_mesh(stage: Any, mesh: AnimatedMesh, identifier: str, sdf: Any, geometry: Any) -> None:
    """Add a mesh whose points change over time."""
    from pxr import Vt  # pyright: ignore[reportMissingImports]

    prim = geometry.Mesh.Define(stage, f"/World/{identifier}")
    prim.GetPrim().SetDisplayName(mesh.name)
    faces = np.asarray(mesh.faces, np.int32)
    prim.CreateSubdivisionSchemeAttr(geometry.Tokens.none)
    prim.CreateDoubleSidedAttr(True)
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.reshape(-1))))
    color = srgb_to_linear(mesh.color[:3])
    prim.CreateDisplayColorAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(color[None])))
    points, extent = prim.CreatePointsAttr(), prim.CreateExtentAttr()
    for frame, positions in enumerate(np.asarray(mesh.positions, np.float32)):
        points.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(positions)), frame)
        bounds = np.stack([positions.min(axis=0), positions.max(axis=0)])
        extent.Set(Vt.Vec3fArray.FromNumpy(bounds), frame)
    if mesh.corner_uvs is not None:
        primvars = geometry.PrimvarsAPI(prim.GetPrim())
        kind = sdf.ValueTypeNames.TexCoord2fArray
        uvs = np.ascontiguousarray(np.asarray(mesh.corner_uvs, np.float32).reshape(-1, 2))
        primvars.CreatePrimvar("st", kind, geometry.Tokens.faceVarying).Set(Vt.Vec2fArray.FromNumpy(uvs))
