"""Write animated meshes as USD with time samples; needs the extra `usd`.

A free mesh has points, normals and, where known, velocities per frame. A mesh that joints move exactly is bound
to a UsdSkel skeleton. Where joints alone don't reproduce a mesh, it is written as points, and its prim says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.formats import animated
from eslr_jax.pipeline.formats.palette import Color, srgb_to_linear
from eslr_jax.pipeline.formats.registry import writer
from eslr_jax.pose.skeleton import whole_rate

SUFFIXES = (".usd", ".usda", ".usdc")
TOLERANCE = 1e-4  # [m] by which joints may miss a vertex


@writer("scene", SUFFIXES)
def write_usd(path: str | Path, meshes: Sequence[animated.AnimatedMesh], timestep: float) -> None:
    """Write meshes as a USD stage, one whole time code per frame, atomically; `.usda` is text.

    Vertices keep their order; texture coordinates are the face-varying primvar `st`. Metres, Y up. A rate that
    rounding keeps from a whole number is that number: 1/30 s in float32 is exactly 30 frames per second.

    Raises:
        MissingExtraError: The extra is not installed.
    """
    require("pxr.Usd", extra="usd", purpose="USD")
    from pxr import Usd, UsdGeom  # pyright: ignore[reportMissingImports]

    if Path(path).suffix.lower() not in SUFFIXES:
        raise AssetError(f"can't write {path} as USD; name it one of {', '.join(SUFFIXES)}")
    rate = whole_rate(1.0 / timestep)
    with atomic_write(path) as temporary:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(meshes[0].positions) - 1)
        world = UsdGeom.Xform.Define(stage, "/World")
        stage.SetDefaultPrim(world.GetPrim())
        names = animated.identifiers([mesh.name for mesh in meshes])
        for name, mesh in zip(names, meshes, strict=True):
            _add_mesh(stage, f"/World/{name}", mesh)
        stage.GetRootLayer().Save()
        del stage, world  # the layer keeps the file open


def _add_mesh(stage: Any, path: str, mesh: animated.AnimatedMesh) -> None:
    """Add a mesh: bound to a skeleton where that moves it exactly, as points otherwise."""
    from pxr import Sdf, Usd, UsdGeom, UsdSkel, Vt  # pyright: ignore[reportMissingImports]

    skin = mesh.skin
    if skin is not None and animated.corrections(mesh, skin, TOLERANCE) is not None:
        skin = None  # joints alone don't do
    if skin is not None:
        UsdSkel.Root.Define(stage, path)
        prim = UsdGeom.Mesh.Define(stage, f"{path}/mesh")
    else:
        prim = UsdGeom.Mesh.Define(stage, path)
        if mesh.skin is not None:
            prim.GetPrim().SetDocumentation("Points, since joints alone don't reproduce this motion.")
    stage.GetPrimAtPath(path).SetDisplayName(mesh.name)
    faces = np.asarray(mesh.faces, np.int32)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateDoubleSidedAttr(True)
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.reshape(-1))))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    if mesh.corner_uvs is not None:
        uvs = np.ascontiguousarray(np.asarray(mesh.corner_uvs, np.float32).reshape(-1, 2))
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        primvar = UsdGeom.PrimvarsAPI(prim.GetPrim()).CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
        primvar.Set(Vt.Vec2fArray.FromNumpy(uvs))
    _add_material(stage, f"{path}_material", mesh.color, prim)

    def vectors(values: np.ndarray) -> Any:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))

    def set_points(points: np.ndarray, time: Any) -> None:
        prim.CreatePointsAttr().Set(vectors(points), time)
        prim.CreateNormalsAttr().Set(vectors(animated.vertex_normals(points, faces)), time)
        prim.CreateExtentAttr().Set(vectors(np.stack([points.min(axis=0), points.max(axis=0)])), time)

    if skin is not None:
        set_points(np.asarray(mesh.rest_positions, np.float32), Usd.TimeCode.Default())
        _bind(stage, path, prim, skin)
        return
    for frame, points in enumerate(np.asarray(mesh.positions, np.float32)):
        set_points(points, Usd.TimeCode(frame))
        if mesh.velocities is not None:
            prim.CreateVelocitiesAttr().Set(vectors(mesh.velocities[frame]), frame)


def _add_material(stage: Any, path: str, color: Color, prim: Any) -> None:
    """Bind a rough UsdPreviewSurface of a colour, and show it where materials are not drawn."""
    from pxr import Gf, Sdf, UsdShade  # pyright: ignore[reportMissingImports]

    linear = Gf.Vec3f(*(float(value) for value in srgb_to_linear(color)))
    prim.CreateDisplayColorAttr([linear])
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    for name, kind, value in (
        ("diffuseColor", Sdf.ValueTypeNames.Color3f, linear),
        ("roughness", Sdf.ValueTypeNames.Float, 0.9),
    ):
        shader.CreateInput(name, kind).Set(value)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)


def _bind(stage: Any, path: str, prim: Any, skin: animated.Skin) -> None:
    """Add a skeleton with its animation below a SkelRoot, and bind a mesh to it."""
    from pxr import Gf, UsdSkel, Vt  # pyright: ignore[reportMissingImports]

    joints: list[str] = []  # paths: parent/child
    for name, parent in zip(animated.identifiers(skin.joint_names), skin.parents, strict=True):
        joints.append(name if parent < 0 else f"{joints[parent]}/{name}")
    rest = np.asarray(skin.joint_rest_positions, np.float64)
    above = np.array([rest[parent] if parent >= 0 else np.zeros(3) for parent in skin.parents])
    skeleton = UsdSkel.Skeleton.Define(stage, f"{path}/skeleton")
    animation = UsdSkel.Animation.Define(stage, f"{path}/skeleton/animation")

    def matrices(shifts: np.ndarray) -> Any:
        return Vt.Matrix4dArray([Gf.Matrix4d(1.0).SetTranslate(Gf.Vec3d(*map(float, s))) for s in shifts])

    skeleton.CreateJointsAttr(joints)
    skeleton.CreateBindTransformsAttr(matrices(rest))
    skeleton.CreateRestTransformsAttr(matrices(rest - above))
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1.0)] * len(joints)))
    turned, moved = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
    rotations, translations = animated.local_motion(skin)
    for frame, (quaternions, shifts) in enumerate(zip(rotations, translations, strict=True)):
        values = [Gf.Quatf(float(w), float(x), float(y), float(z)) for x, y, z, w in quaternions]
        turned.Set(Vt.QuatfArray(values), frame)
        moved.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(shifts)), frame)
    weights, indices = animated.influences(skin)
    binding = UsdSkel.BindingAPI.Apply(prim.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, weights.shape[1]).Set(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(indices.reshape(-1), np.int32))
    )
    binding.CreateJointWeightsPrimvar(False, weights.shape[1]).Set(
        Vt.FloatArray.FromNumpy(np.ascontiguousarray(weights.reshape(-1), np.float32))
    )
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
