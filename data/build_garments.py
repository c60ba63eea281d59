"""Build the nine bundled garments from the bundled body.

A garment is the surface of a solid around the body: the body's distance field, thickened, joined with the
tubes of cloth that hang from it (torso, sleeves, trouser legs, skirt), with narrow creases closed. Smooth
scalar fields (neck, armholes, cuffs, hem, waist) cut the surface, and it is remeshed to about 1k, 4k and 10k
vertices, so all three resolutions share one shape. Hems are put back on the cut curve, and skin weights are
diffused over the surface.

Run `python data/build_garments.py data/body/anny_cmu.npz` (optionally `--names tshirt dress --levels 1k 4k`).
It needs numpy, scipy, scikit-image, libigl, pyvista and pyacvd, some of which the package does not need.

Lengths are in metres, Y is up, the body faces +Z and its left is +X. Heights are measured from the hips.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import igl
import numpy as np
from garment_mesh import (
    Surface,
    boundary_loops,
    cut_surface,
    diffuse,
    face_normals,
    fair_surface,
    fit_to_cut,
    mesh_edges,
    remesh,
    reorder,
    smooth_surface,
)
from garment_solid import (
    LEG,
    Body,
    cut_field,
    garment_solid,
    limb_names,
    load_body,
    make_grid,
    nearest_body_weights,
    signed_distance,
    smoothstep,
)
from garment_specs import LEVELS, SPECS, GarmentSpec

CLEARANCE = 0.005  # smallest distance between garment and body at rest [m]
FIXED_TO_HIPS = ("LHipJoint", "RHipJoint")  # joints of the CMU skeleton that have no rotation of their own
BODICE_SMOOTHING = 0.03  # diffusion length of skin weights above the waist [m]
WAIST_HEIGHT = (
    0.25  # from here down to the hips, the diffusion of skin weights grows to that of the skirt [m]
)
FAIRING = 0.025  # bumps of the solid narrower than a few times this are smoothed away [m]
POSITION_STEP = 2.0**-17  # stored positions are multiples of this [m]: 8 micrometres, and they compress well
WEIGHT_LEVELS = 1024  # stored weights are multiples of 1 / WEIGHT_LEVELS and sum to one exactly


def push_out(vertices: np.ndarray, faces: np.ndarray, body: Body, clearance: float) -> np.ndarray:
    """Move cloth, triangles included, that is closer than `clearance` [m] to the body away from it."""
    edges, _ = mesh_edges(faces)
    normals = face_normals(body.vertices, body.faces)
    corners = np.concatenate(
        [np.repeat(np.arange(len(vertices))[:, None], 3, axis=1), edges[:, [0, 1, 1]], faces]
    )
    for _ in range(10):
        samples = np.concatenate([vertices, vertices[edges].mean(axis=1), vertices[faces].mean(axis=1)])
        distance, face, closest, _ = igl.signed_distance(samples, body.vertices, body.faces)
        near = np.flatnonzero(distance < clearance)
        if not near.size:
            break
        outward = np.sign(distance[near])[:, None] * (samples[near] - closest[near])
        length = np.linalg.norm(outward, axis=1, keepdims=True)
        outward = np.where(length > 1e-4, outward / np.maximum(length, 1e-9), normals[face[near]])
        push = (clearance - distance[near])[:, None] * outward
        total, count = np.zeros_like(vertices), np.zeros((len(vertices), 1))
        np.add.at(total, corners[near], push[:, None])
        np.add.at(count, corners[near], 1.0)
        vertices = vertices + total / np.maximum(count, 1.0)
    return vertices


def garment_weights(vertices: np.ndarray, body: Body, leg_follow: float) -> np.ndarray:
    """Return dense skin weights [V, J] of the closest body points, with `leg_follow` of the legs' weights."""
    dense = nearest_body_weights(vertices, body)
    for name in FIXED_TO_HIPS:
        dense[:, body.columns["Hips"]] += dense[:, body.columns[name]]
        dense[:, body.columns[name]] = 0.0
    legs = [body.columns[name] for name in limb_names(LEG)]
    dense[:, body.columns["Hips"]] += (1.0 - leg_follow) * dense[:, legs].sum(axis=1)
    dense[:, legs] *= leg_follow
    return dense


def smooth_weights(dense: np.ndarray, surface: Surface, skirt_smoothing: float) -> np.ndarray:
    """Diffuse skin weights [V, J] over `BODICE_SMOOTHING`, and over `skirt_smoothing` [m] below the hips."""
    bodice = diffuse(dense, surface, BODICE_SMOOTHING)
    if skirt_smoothing <= BODICE_SMOOTHING:
        return bodice
    share = smoothstep(1.0 - surface[0][:, 1:2] / WAIST_HEIGHT)
    return (1.0 - share) * bodice + share * diffuse(dense, surface, skirt_smoothing)


def quantise_weights(dense: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep the four largest weights, normalised to multiples of 1 / WEIGHT_LEVELS that sum to one.

    The fifth is subtracted first: where the fourth and the fifth change places, neither jumps, so cloth that
    is skinned with the result has no creases.

    Returns:
        Weights [V, 4] float32 and joint indices [V, 4] int16, largest first.
    """
    indices = np.argsort(-dense, axis=1, kind="stable")[:, :5]
    top = np.clip(np.take_along_axis(dense, indices, axis=1), 0.0, None)
    indices, top = indices[:, :4], top[:, :4] - top[:, 4:]
    counts = np.round(top / top.sum(axis=1, keepdims=True) * WEIGHT_LEVELS)
    counts[:, 0] += WEIGHT_LEVELS - counts.sum(axis=1)
    indices = np.where(counts > 0, indices, 0)
    return (counts / WEIGHT_LEVELS).astype(np.float32), indices.astype(np.int16)


def pinned_vertices(vertices: np.ndarray, spec: GarmentSpec) -> np.ndarray:
    """Return which vertices move with the body: the waistband, or the top of the straps; shape [V]."""
    return vertices[:, 1] > vertices[:, 1].max() - (spec.pin_depth or -1.0)


def build_pattern(body: Body, grid: np.ndarray, body_distance: np.ndarray, spec: GarmentSpec) -> Surface:
    """Return the cut surface that all resolutions of a garment are remeshed from."""
    solid = smooth_surface(garment_solid(body, grid, body_distance, spec), 10)
    solid = fair_surface(solid, FAIRING)
    return cut_surface(solid, cut_field(solid[0], body, spec))


def build_level(body: Body, pattern: Surface, spec: GarmentSpec, num_vertices: int) -> dict[str, np.ndarray]:
    """Return the arrays of one garment file."""
    vertices, faces = remesh(pattern, num_vertices, len(boundary_loops(pattern[1])))
    vertices, faces = fit_to_cut(vertices, faces, pattern)
    vertices, faces = reorder(push_out(vertices, faces, body, CLEARANCE), faces)
    dense = garment_weights(vertices, body, spec.leg_follow)
    weights, indices = quantise_weights(smooth_weights(dense, (vertices, faces), spec.skirt_smoothing))
    stored = np.round((vertices + body.origin) / POSITION_STEP) * POSITION_STEP
    return {
        "rest_positions": stored.astype(np.float32),
        "faces": faces.astype(np.int32),
        "skin_weights": weights,
        "skin_indices": indices,
        "pinned": pinned_vertices(vertices, spec),
    }


def describe(garment: dict[str, np.ndarray], body: Body) -> dict[str, float]:
    """Measure a garment: sizes, triangle quality and distance to the body."""
    vertices, faces = garment["rest_positions"].astype(float), garment["faces"].astype(np.int64)
    edges, _ = mesh_edges(faces)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    distance = igl.signed_distance(vertices - body.origin, body.vertices, body.faces)[0]
    return {
        "V": len(vertices),
        "F": len(faces),
        "area": round(float(igl.doublearea(vertices, faces).sum()) / 2, 3),
        "edge_mm": round(1e3 * float(length.mean()), 1),
        "edge_cv": round(float(length.std() / length.mean()), 3),
        "min_angle": round(float(np.degrees(igl.internal_angles(vertices, faces).min())), 1),
        "clearance_mm": round(1e3 * float(distance.min()), 1),
        "ease_mm": round(1e3 * float(np.median(distance)), 1),
        "loops": len(boundary_loops(faces)),
        "pinned": int(garment["pinned"].sum()),
    }


def build_all(
    body: Body, names: list[str], levels: list[str], out: Path, report: Callable[[str], None]
) -> None:
    """Build and write the named garments at the named levels."""
    grid = make_grid()
    body_distance = signed_distance(grid, (body.vertices, body.faces))
    out.mkdir(parents=True, exist_ok=True)
    for name in names:
        pattern = build_pattern(body, grid, body_distance, SPECS[name])
        for level in levels:
            garment = build_level(body, pattern, SPECS[name], LEVELS[level])
            np.savez_compressed(out / f"{name}_{level}.npz", **garment)
            report(json.dumps({"garment": f"{name}_{level}", **describe(garment, body)}))


def main() -> None:
    """Parse the command line and build."""
    parser = argparse.ArgumentParser(description="Build the bundled garments from the bundled body.")
    parser.add_argument("body", type=Path, help="the bundled body, e.g. data/body/anny_cmu.npz")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "garments")
    parser.add_argument("--names", nargs="+", default=list(SPECS), choices=list(SPECS))
    parser.add_argument("--levels", nargs="+", default=list(LEVELS), choices=list(LEVELS))
    arguments = parser.parse_args()
    body = load_body(arguments.body)
    build_all(body, arguments.names, arguments.levels, arguments.out, lambda line: print(line, flush=True))


if __name__ == "__main__":
    main()
