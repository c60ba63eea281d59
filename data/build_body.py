"""Export the Anny body (rig `cmu_mb`, topology `notoes`) to `data/body/anny_cmu.npz`.

Anny is built once, here; the simulator only reads the npz. In a fresh virtual environment:

    pip install . "anny==0.6.2" "torch==2.13.0"
    python data/build_body.py

The first build of a rig takes a minute or two and fills `~/.cache/anny` (gigabytes; delete it afterwards).
Output: metres, Y up, the body faces +Z, its left is +X, arms at 45 degrees.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

DATA = Path(__file__).resolve().parent
RIG, TOPOLOGY = "cmu_mb", "notoes"
MEAN_ADULT_AGE = 0.667  # Anny's phenotype scale: a young adult; every other phenotype is 0.5
ADULT_AGES = (0.6, 0.8)  # phenotype range sampled for the shape space
ADULT_HEIGHTS = (0.37, 0.63)  # gives statures a standard deviation near 0.09 m, as in adults of both sexes
PHENOTYPES = (0.1, 0.9)  # range of the other phenotypes; the extremes are caricatures
NUM_SHAPES = 10  # as in SMPL
HAND_JOINTS = ("Hand", "Thumb", "Finger")
Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # (x, y, z) -> (x, z, -y)

# Arms as low as walking brings them once `retarget.abduct_arms` has lifted them by its default: turned about
# the front axis from the rest pose's 45 degrees, each with swings about the sideways axis.
ARM_LOWERING = (-10.0, -20.0, -30.0)  # [degrees]
ARM_SWINGS = (-30.0, -15.0, 0.0, 15.0, 30.0)  # [degrees]
ARMPIT_RADIUS = (
    0.20  # [m] around the shoulder joint; farther intersections are real contacts of arm and flank
)


def to_y_up(points: NDArray) -> NDArray:
    """Turn Anny's axes (Z up, facing -Y) into ours (Y up, facing +Z); points [..., 3]."""
    return points @ Z_UP_TO_Y_UP.T


def build_anny():
    """Build the Anny model; slow."""
    import anny
    import torch

    return anny.Anny(rig=RIG, topology=TOPOLOGY).to(dtype=torch.float32)


def evaluate(model, phenotypes: NDArray, rotations: NDArray | None = None) -> dict[str, NDArray]:
    """Run Anny.

    Args:
        model: The Anny model.
        phenotypes: Values in [0, 1], shape [batch, labels].
        rotations: Rotation of each bone in its rest frame, shape [batch, joints, 3, 3]; None: rest pose.

    Returns:
        Anny's output as NumPy arrays, Z up.
    """
    import torch

    batch, joints = len(phenotypes), model.bone_count
    pose = torch.eye(4)[None, None].repeat(batch, joints, 1, 1)
    if rotations is not None:
        pose[:, :, :3, :3] = torch.as_tensor(rotations, dtype=torch.float32)
    columns = torch.as_tensor(phenotypes, dtype=torch.float32).T
    with torch.no_grad():
        output = model(
            pose_parameters=pose, phenotype_kwargs=dict(zip(model.phenotype_labels, columns, strict=True))
        )
    return {key: value.numpy() for key, value in output.items() if hasattr(value, "numpy")}


def mean_adult(model, count: int = 1) -> NDArray:
    """Phenotypes of the mean adult, shape [count, labels]."""
    phenotypes = np.full((count, len(model.phenotype_labels)), 0.5)
    phenotypes[:, list(model.phenotype_labels).index("age")] = MEAN_ADULT_AGE
    return phenotypes


def random_adults(model, count: int, rng: np.random.Generator) -> NDArray:
    """Random adult phenotypes, shape [count, labels]."""
    labels = list(model.phenotype_labels)
    phenotypes = rng.uniform(*PHENOTYPES, (count, len(labels)))
    phenotypes[:, labels.index("age")] = rng.uniform(*ADULT_AGES, count)
    phenotypes[:, labels.index("height")] = rng.uniform(*ADULT_HEIGHTS, count)
    return phenotypes


def rest_shapes(model, phenotypes: NDArray, batch: int = 24) -> NDArray:
    """Rest vertices followed by joint positions, Y up [m], shape [batch, vertices + joints, 3]."""
    chunks = []
    for start in range(0, len(phenotypes), batch):
        output = evaluate(model, phenotypes[start : start + batch])
        chunks.append(np.concatenate([output["rest_vertices"], output["rest_bone_heads"]], axis=1))
    return to_y_up(np.concatenate(chunks).astype(np.float64))


def principal_directions(samples: NDArray, count: int) -> tuple[NDArray, NDArray]:
    """Principal directions of sampled shapes, scaled to one standard deviation.

    Args:
        samples: Shapes [m], shape [samples, points, 3].
        count: Number of directions.

    Returns:
        Directions [m], shape [points, 3, count], the largest entry of each positive so that no linear algebra
        library decides the sign; and the share of the variance explained by the first 1..count.
    """
    flat = samples.reshape(len(samples), -1)
    _, singular, rows = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    rows = rows[:count]
    rows *= np.sign(np.take_along_axis(rows, np.abs(rows).argmax(axis=1)[:, None], axis=1))
    scaled = rows * (singular[:count, None] / np.sqrt(len(samples) - 1))
    directions = scaled.reshape(count, *samples.shape[1:]).transpose(1, 2, 0)
    return directions, np.cumsum(singular**2)[:count] / np.sum(singular**2)


def export_body(model, num_phenotypes: int) -> dict[str, NDArray]:
    """Everything in the body file but the obstacle mask."""
    rest = rest_shapes(model, mean_adult(model))[0]
    samples = rest_shapes(model, random_adults(model, num_phenotypes, np.random.default_rng(0)))
    directions, explained = principal_directions(samples, NUM_SHAPES)
    stature_spread = np.ptp(samples[..., 1], axis=1).std()
    print(f"stature: standard deviation {stature_spread:.3f} m; variance explained:", explained.round(4))
    num_joints = model.bone_count
    weights = np.asarray(model.vertex_bone_weights, dtype=np.float64)
    return {
        "rest_positions": rest[:-num_joints].astype(np.float32),
        "shape_directions": directions[:-num_joints].astype(np.float16),
        "joint_rest_positions": rest[-num_joints:].astype(np.float32),
        "joint_shape_directions": directions[-num_joints:].astype(np.float32),
        "parents": np.asarray(model.bone_parents, dtype=np.int32),
        "joint_names": np.asarray(model.bone_labels),
        "skin_weights": (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        "skin_indices": np.asarray(model.vertex_bone_indices, dtype=np.int16),
        "faces": np.asarray(model.faces, dtype=np.int32),
    }


def export_golden_poses(model, vertex_step: int = 23) -> dict[str, NDArray]:
    """Three poses by Anny itself (the first is the rest pose), for the test of linear blend skinning."""
    angles = np.random.default_rng(3).normal(0.0, 0.25, (3, model.bone_count, 3))
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(3, model.bone_count, 3, 3)
    rotations[0] = np.eye(3)
    output = evaluate(model, mean_adult(model, 3), rotations)
    rest = output["rest_bone_poses"][0, :, :3, :3].astype(np.float64)
    posed = output["bone_poses"].astype(np.float64)
    relative = posed[..., :3, :3] @ np.swapaxes(rest, -1, -2)
    vertex_index = np.arange(0, output["vertices"].shape[1], vertex_step)
    return {
        "global_rotations": (Z_UP_TO_Y_UP @ relative @ Z_UP_TO_Y_UP.T).astype(np.float32),
        "joint_positions": to_y_up(posed[..., :3, 3]).astype(np.float32),
        "vertex_index": vertex_index,
        "vertices": to_y_up(output["vertices"][:, vertex_index].astype(np.float64)).astype(np.float32),
    }


def is_hand_face(body: dict[str, NDArray]) -> NDArray:
    """Faces skinned mostly to hands, fingers and thumbs; shape [faces]."""
    is_hand_joint = np.array([any(part in str(name) for part in HAND_JOINTS) for name in body["joint_names"]])
    hand_weight = (body["skin_weights"] * is_hand_joint[body["skin_indices"]]).sum(axis=1)
    return (hand_weight > 0.5)[body["faces"]].all(axis=1)


def arm_rotations(joint_names: list[str], lowering: float, swing: float) -> NDArray:
    """Local axis-angle rotations [rad], shape [joints, 3], with both arms lowered and swung [degrees]."""
    rotations = np.zeros((len(joint_names), 3))
    for name, side in (("LeftArm", 1.0), ("RightArm", -1.0)):
        turn = Rotation.from_euler("zx", [side * lowering, swing], degrees=True)
        rotations[joint_names.index(name)] = turn.as_rotvec()
    return rotations


def pose_vertices(body: dict[str, NDArray], rotations: NDArray) -> NDArray:
    """Posed vertices [m], shape [vertices, 3], with the root where it rests."""
    import jax.numpy as jnp

    from eslr_jax.pose import lbs

    joints = jnp.asarray(body["joint_rest_positions"])
    parents = tuple(int(p) for p in body["parents"])
    transforms = lbs.joint_transforms(jnp.asarray(rotations, jnp.float32), joints[0], joints, parents)
    return np.asarray(
        lbs.skin(
            jnp.asarray(body["rest_positions"]),
            jnp.asarray(body["skin_weights"]),
            jnp.asarray(body["skin_indices"]),
            transforms,
        )
    )


def is_armpit_face(body: dict[str, NDArray]) -> NDArray:
    """Faces near the shoulders that intersect others when the arms hang, and their ring; shape [faces]."""
    from eslr_jax.mesh.piercing import piercing_edges

    names = [str(name) for name in body["joint_names"]]
    shoulders = body["joint_rest_positions"][[names.index("LeftArm"), names.index("RightArm")]]
    centres = body["rest_positions"][body["faces"]].mean(axis=1)
    distance = np.linalg.norm(centres[:, None] - shoulders, axis=2).min(axis=1)
    near = np.flatnonzero(distance < ARMPIT_RADIUS)
    crossing = np.zeros(len(centres), bool)
    for lowering in ARM_LOWERING:
        for swing in ARM_SWINGS:
            posed = pose_vertices(body, arm_rotations(names, lowering, swing)).astype(np.float64)
            owners, _, pierced = piercing_edges(posed, body["faces"][near])
            crossing[near[np.concatenate([owners, pierced])]] = True
    is_touched = np.zeros(len(body["rest_positions"]), bool)
    is_touched[body["faces"][crossing]] = True
    return is_touched[body["faces"]].any(axis=1) if crossing.any() else crossing


def add_obstacle_faces(body: dict[str, NDArray]) -> None:
    """Mark the faces that cloth may touch: all but hands and armpits, where the posed body cuts itself."""
    hands, armpits = is_hand_face(body), is_armpit_face(body)
    body["obstacle_faces"] = ~(hands | armpits)
    print(f"faces {len(hands)}: hands {hands.sum()}, armpits {armpits.sum()} left out")


def main() -> None:
    """Write the body and the golden poses."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--output", type=Path, default=DATA / "body" / "anny_cmu.npz")
    parser.add_argument(
        "--golden", type=Path, default=DATA.parent / "tests" / "fixtures" / "anny_lbs_golden.npz"
    )
    parser.add_argument(
        "--num-phenotypes", type=int, default=240, help="random adults behind the shape space"
    )
    parser.add_argument(
        "--mask-only", action="store_true", help="recompute obstacle_faces of an existing file"
    )
    options = parser.parse_args()
    if options.mask_only:
        with np.load(options.output) as file:
            body = dict(file)
    else:
        model = build_anny()
        body = export_body(model, options.num_phenotypes)
        np.savez_compressed(options.golden, **export_golden_poses(model))
    add_obstacle_faces(body)
    np.savez_compressed(options.output, **body)
    print(options.output, f"{options.output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
