"""Retarget motion capture to the bundled body: `data/motions/cmu.npz` and `data/motions/deepmimic.npz`.

    pip download --no-deps "envpool-assets==0.4.1" "pybullet==3.2.7"     # and unzip both wheels
    python data/build_motions.py --cmu DIR --deepmimic DIR

The CMU folder holds EnvPool's `mocap_2019.bin`, `mocap_2020.bin` and `humanoid_CMU_V2020.xml`; the other one
holds DeepMimic's `humanoid3d_*.txt`. Needs `data/body/anny_cmu.npz`. Clips keep their own frame rate; every
clip starts above the origin, facing +Z, with the floor at y = 0.
"""

from __future__ import annotations

import argparse
import json
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from eslr_jax.pose import lbs, retarget
from eslr_jax.pose.joints import find_named_parts

DATA = Path(__file__).resolve().parent
MAGIC = b"EPMOCAP1"
CMU_FILES = ("mocap_2019.bin", "mocap_2020.bin")
CMU_MODEL = "humanoid_CMU_V2020.xml"
ROTATION_STEP = 2.0**-14  # [rad] rounding of stored rotations; float16 would round the root by up to 1e-3 rad
TRANSLATION_STEP = 2.0**-16  # [m]
DRIFT_SECONDS = 0.3  # standard deviation of the filter that tells the floor's drift from steps
GROUND_QUANTILE = 0.05  # of the lowest point of each frame: robust to a toe that dips for a moment

# Rig joint -> body of the CMU humanoid whose rotation it follows; the right side is derived.
CMU_CENTRE = {
    "Hips": "root", "LowerBack": "lowerback", "Spine": "upperback", "Spine1": "thorax",
    "Neck": "lowerneck", "Neck1": "upperneck", "Head": "head",
}  # fmt: skip
CMU_SIDE = {
    "{i}HipJoint": "hipjoint", "{s}UpLeg": "femur", "{s}Leg": "tibia", "{s}Foot": "foot",
    "{s}ToeBase": "toes", "{s}Shoulder": "clavicle", "{s}Arm": "humerus", "{s}ForeArm": "radius",
    "{s}Hand": "hand", "{i}Thumb": "thumb", "{s}FingerBase": "hand", "{s}HandFinger1": "fingers",
}  # fmt: skip
CMU_BONE_ENDS = {"femur": "tibia", "tibia": "foot", "humerus": "radius", "radius": "wrist"}
# Thigh and shank that make the standing foot slide least, equal in all walks [m]. The XML humanoid has 0.821 and
# the bodies in the 2020 file are 1.2 times as large; neither fits the root's steps.
CMU_ACTOR_LEG = 0.864
CMU_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # Z up -> Y up

# DeepMimic joints in file order with the number of columns: quaternion (w x y z) or angle about +z.
DEEPMIMIC_JOINTS = (
    ("chest", 4), ("neck", 4), ("rhip", 4), ("rknee", 1), ("rankle", 4), ("rshoulder", 4), ("relbow", 1),
    ("lhip", 4), ("lknee", 1), ("lankle", 4), ("lshoulder", 4), ("lelbow", 1),
)  # fmt: skip
DEEPMIMIC_PARENTS = {
    "chest": "root", "neck": "chest", "hip": "root", "knee": "hip", "ankle": "knee", "shoulder": "chest",
    "elbow": "shoulder",
}  # fmt: skip
DEEPMIMIC_CENTRE = {
    "Hips": "root", "LowerBack": "waist", "Spine": "chest", "Spine1": "chest", "Neck": "neck",
    "Neck1": "neck", "Head": "neck",
}  # fmt: skip
DEEPMIMIC_SIDE = {
    "{s}UpLeg": "hip", "{s}Leg": "knee", "{s}Foot": "ankle", "{s}ToeBase": "ankle", "{s}Arm": "shoulder",
    "{s}ForeArm": "elbow", "{s}Hand": "elbow", "{i}Thumb": "elbow", "{s}FingerBase": "elbow",
    "{s}HandFinger1": "elbow",
}  # fmt: skip
DEEPMIMIC_UNSIDED = {"{i}HipJoint": "root", "{s}Shoulder": "chest"}
DEEPMIMIC_AXES = np.array(
    [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
)  # x front, y up, z right -> ours
DEEPMIMIC_LEG = 0.421546 + 0.40987  # [m] thigh and shank of DeepMimic's humanoid3d.txt


@dataclass(frozen=True)
class Rig:
    """The bundled body, as the scripts need it."""

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    joint_rest_positions: NDArray  # [joints, 3] [m]
    rest_positions: NDArray  # [vertices, 3] [m]
    skin_weights: NDArray
    skin_indices: NDArray

    @classmethod
    def load(cls, path: Path) -> Rig:
        """Read `data/body/anny_cmu.npz`."""
        with np.load(path) as file:
            return cls(
                tuple(str(name) for name in file["joint_names"]),
                tuple(int(parent) for parent in file["parents"]),
                *(
                    file[key]
                    for key in ("joint_rest_positions", "rest_positions", "skin_weights", "skin_indices")
                ),
            )

    @property
    def leg_length(self) -> float:
        """Thigh and shank [m]."""
        return retarget.leg_length(self.joint_rest_positions, find_named_parts(self.joint_names))


@dataclass(frozen=True)
class Clip:
    """A retargeted motion."""

    rotations: NDArray  # [frames, joints, 3] [rad]
    translations: NDArray  # [frames, 3] [m]
    fps: float


@dataclass(frozen=True)
class SourceBody:
    """A body of the CMU humanoid."""

    name: str
    parent: int
    position: NDArray  # in the parent's frame [m]
    rotation: Rotation  # in the parent's frame
    hinges: tuple[tuple[int, NDArray], ...]  # column of the joint angles, axis


def both_sides(names: dict[str, str], *, is_sided: bool = True) -> dict[str, str]:
    """Fill `{s}` with Left, Right and `{i}` with L, R; put l, r before source names that have sides."""
    return {
        rig_name.format(s=side, i=side[0]): (side[0].lower() if is_sided else "") + source_name
        for side in ("Left", "Right")
        for rig_name, source_name in names.items()
    }


def from_wxyz(quaternions: NDArray) -> Rotation:
    """Rotations from quaternions with the real part first, [..., 4]."""
    return Rotation.from_quat(np.asarray(quaternions, np.float64), scalar_first=True)


# ---------------------------------------------------------------- from rig to rig

_SIDES = ("Left", "Right")
_LIMB_BONES = {"UpLeg": "Leg", "Leg": "Foot", "Arm": "ForeArm", "ForeArm": "Hand"}
_HAND_JOINTS = ("{side}Hand", "{initial}Thumb", "{side}FingerBase", "{side}HandFinger1")


def limb_bones(joint_names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return the bones whose rest direction differs from rig to rig: limbs, and hands that continue them.

    Args:
        joint_names: Joints of a rig with CMU names (`LeftArm`, `RThumb`, ...).

    Returns:
        For each such joint the two joints that span its bone; absent joints are left out.
    """
    bones = {}
    for side in _SIDES:
        for start, end in _LIMB_BONES.items():
            bones[side + start] = (side + start, side + end)
        for name in _HAND_JOINTS:
            bones[name.format(side=side, initial=side[0])] = (side + "ForeArm", side + "Hand")
    present = set(joint_names)
    return {name: bone for name, bone in bones.items() if present.issuperset((name, *bone))}


def rest_alignments(
    joint_names: Sequence[str], joint_rest_positions: NDArray, source_directions: Mapping[str, NDArray]
) -> NDArray:
    """Return, for each joint, the rotation from the rig's rest bone to the source's rest bone.

    Args:
        joint_names: Joints of the rig.
        joint_rest_positions: Their rest positions [m], shape [joints, 3].
        source_directions: Direction of the source's bone at rest, in the rig's axes, for the joints of
            `limb_bones` that should be aligned; shape [3] each.

    Returns:
        Rotations, identity where nothing is aligned, shape [joints, 3, 3].
    """
    index = {name: i for i, name in enumerate(joint_names)}
    alignments = np.tile(np.eye(3), (len(joint_names), 1, 1))
    for name, (start, end) in limb_bones(joint_names).items():
        if name in source_directions:
            bone = joint_rest_positions[index[end]] - joint_rest_positions[index[start]]
            turn, _ = Rotation.align_vectors(source_directions[name][None], bone[None])
            alignments[index[name]] = turn.as_matrix()
    return alignments


def follow_joints(
    source_rotations: NDArray, source_joints: Sequence[int], alignments: NDArray, parents: Sequence[int]
) -> NDArray:
    """Return the rig's local rotations that follow a source skeleton's global ones.

    Joint j of the rig turns by G_j = D_s A_j: first from its own rest bone onto the source's (A_j), then as
    the source joint s turned since its rest pose (D_s). So limbs point where the source's point, whatever the
    two rest poses.

    Args:
        source_rotations: Global rotation of each source joint since its rest pose, in the rig's axes, shape
            [frames, source_joints, 3, 3].
        source_joints: Source joint followed by each joint of the rig, shape [joints].
        alignments: See `rest_alignments`, shape [joints, 3, 3].
        parents: Parent of each joint, -1 for the root.

    Returns:
        Local axis-angle rotations [rad], shape [frames, joints, 3].
    """
    return retarget.local_rotations(source_rotations[:, list(source_joints)] @ alignments, parents)


def start_facing_front(rotations: NDArray, translations: NDArray) -> tuple[NDArray, NDArray]:
    """Return the motion moved so that the root starts above the origin and faces +Z.

    Args:
        rotations: Local axis-angle rotations [rad], the root first, shape [frames, joints, 3].
        translations: Root positions [m], shape [frames, 3].

    Returns:
        Rotations [rad] and translations [m]; heights are unchanged.
    """
    front = Rotation.from_rotvec(rotations[0, 0]).apply([0.0, 0.0, 1.0])
    turn = Rotation.from_euler("y", -np.arctan2(front[0], front[2]))
    result = np.array(rotations, dtype=np.float64)
    result[:, 0] = (turn * Rotation.from_rotvec(result[:, 0])).as_rotvec()
    return result, turn.apply(translations - translations[0] * [1.0, 0.0, 1.0])


# ---------------------------------------------------------------- CMU clips in EnvPool's format


class _Reader:
    """Little-endian reader of EPMOCAP1."""

    def __init__(self, data: bytes) -> None:
        self.data, self.offset = data, 0

    def take(self, code: str):
        """Read one number."""
        (value,) = struct.unpack_from("<" + code, self.data, self.offset)
        self.offset += struct.calcsize(code)
        return value

    def text(self) -> str:
        """Read a counted string."""
        length = self.take("I")
        self.offset += length
        return self.data[self.offset - length : self.offset].decode()

    def table(self, rows: int) -> NDArray:
        """Read a counted table of float32."""
        columns = self.take("I")
        table = np.frombuffer(self.data, "<f4", rows * columns, self.offset).reshape(rows, columns)
        self.offset += table.nbytes
        return table.astype(np.float64)


def read_epmocap(path: Path) -> dict[str, dict]:
    """Read clips: name -> {"dt": seconds, field: [frames, columns], ...}."""
    data = path.read_bytes()
    if data[: len(MAGIC)] != MAGIC:
        raise SystemExit(f"{path} is not an EPMOCAP1 file")
    reader = _Reader(data)
    reader.offset = len(MAGIC)
    clips = {}
    for _ in range(reader.take("I")):
        name, frames = reader.text(), reader.take("I")
        clips[name] = {"dt": reader.take("d")}
        for _ in range(reader.take("I")):
            field = reader.text()
            clips[name][field] = reader.table(frames)
    return clips


def read_humanoid(path: Path) -> list[SourceBody]:
    """Read the CMU humanoid's bodies from its MuJoCo XML, depth first as the joint angles are stored."""
    bodies: list[SourceBody] = []
    num_hinges = 0

    def numbers(element: ElementTree.Element, key: str, default: str) -> NDArray:
        return np.array([float(x) for x in element.get(key, default).split()])

    def visit(element: ElementTree.Element, parent: int) -> None:
        nonlocal num_hinges
        for child in element.findall("body"):
            hinges = []
            for joint in child.findall("joint"):
                hinges.append((num_hinges, numbers(joint, "axis", "0 0 1")))
                num_hinges += 1
            rotation = from_wxyz(numbers(child, "quat", "1 0 0 0"))
            position = numbers(child, "pos", "0 0 0")
            bodies.append(SourceBody(child.get("name", ""), parent, position, rotation, tuple(hinges)))
            visit(child, len(bodies) - 1)

    visit(ElementTree.parse(path).getroot().find("worldbody"), -1)
    return bodies


def pose_humanoid(bodies: list[SourceBody], root: Rotation, angles: NDArray) -> NDArray:
    """Global rotations [frames, bodies, 3, 3] for hinge angles [frames, hinges] [rad]."""
    turned: list[Rotation] = []
    for body in bodies:
        rotation = root if body.parent < 0 else turned[body.parent] * body.rotation
        for column, axis in body.hinges:
            rotation = rotation * Rotation.from_rotvec(angles[:, column, None] * axis)
        turned.append(rotation)
    return np.stack([rotation.as_matrix() for rotation in turned], axis=1)


def rest_joint_positions(bodies: list[SourceBody], rotations: NDArray) -> NDArray:
    """Rest positions of the bodies [m], shape [bodies, 3], from their global rest rotations."""
    positions: list[NDArray] = []
    for body in bodies:
        if body.parent < 0:
            positions.append(np.zeros(3))
        else:
            positions.append(positions[body.parent] + rotations[body.parent] @ body.position)
    return np.array(positions)


def retarget_cmu(source: Path, rig: Rig) -> dict[str, Clip]:
    """Retarget all CMU clips of EnvPool's pack."""
    bodies = read_humanoid(source / CMU_MODEL)
    index = {body.name: i for i, body in enumerate(bodies)}
    num_hinges = sum(len(body.hinges) for body in bodies)
    rest = pose_humanoid(bodies, Rotation.identity(1), np.zeros((1, num_hinges)))[0]
    positions = rest_joint_positions(bodies, rest)

    joint_map = CMU_CENTRE | both_sides(CMU_SIDE)
    followed = [index[joint_map[name]] for name in rig.joint_names]
    bones = limb_bones(rig.joint_names)
    directions = {}
    for name, (start, _) in bones.items():
        body = joint_map[start]
        directions[name] = positions[index[body[0] + CMU_BONE_ENDS[body[1:]]]] - positions[index[body]]
    alignments = rest_alignments(rig.joint_names, rig.joint_rest_positions, directions)
    clips = {}
    for file in CMU_FILES:
        for name, fields in read_epmocap(source / file).items():
            posed = pose_humanoid(bodies, from_wxyz(fields["quaternion"]), fields["joints"])
            since_rest = CMU_WORLD @ posed @ np.swapaxes(rest, 1, 2)
            rotations = follow_joints(since_rest, followed, alignments, rig.parents)
            translations = rig.leg_length / CMU_ACTOR_LEG * fields["position"] @ CMU_WORLD.T
            clips[name.lower()] = Clip(rotations, translations, 1 / fields["dt"])
    return clips


# ---------------------------------------------------------------- DeepMimic clips


def deepmimic_rotations(frames: NDArray) -> dict[str, NDArray]:
    """Global rotation matrices [frames, 3, 3] of DeepMimic's joints, and of a waist halfway to the chest."""
    turned = {"root": from_wxyz(frames[:, 4:8])}
    column = 8
    for name, width in DEEPMIMIC_JOINTS:
        values = frames[:, column : column + width]
        column += width
        local = from_wxyz(values) if width == 4 else Rotation.from_rotvec(values * [0.0, 0.0, 1.0])
        side, part = ("", name) if name in DEEPMIMIC_PARENTS else (name[0], name[1:])
        parent = DEEPMIMIC_PARENTS[part]
        turned[name] = turned[parent if parent in turned else side + parent] * local
        if name == "chest":
            turned["waist"] = turned["root"] * Rotation.from_rotvec(0.5 * local.as_rotvec())
    return {name: rotation.as_matrix() for name, rotation in turned.items()}


def retarget_deepmimic(source: Path, rig: Rig) -> dict[str, Clip]:
    """Retarget every `humanoid3d_*.txt`."""
    joint_map = DEEPMIMIC_CENTRE | both_sides(DEEPMIMIC_SIDE) | both_sides(DEEPMIMIC_UNSIDED, is_sided=False)
    down = dict.fromkeys(limb_bones(rig.joint_names), np.array([0.0, -1.0, 0.0]))
    alignments = rest_alignments(rig.joint_names, rig.joint_rest_positions, down)
    scale = rig.leg_length / DEEPMIMIC_LEG
    clips = {}
    for path in sorted(source.glob("humanoid3d_*.txt")):
        frames = np.array(json.loads(path.read_text())["Frames"])
        turned = deepmimic_rotations(frames)
        names = list(turned)
        stacked = DEEPMIMIC_AXES @ np.stack([turned[name] for name in names], axis=1) @ DEEPMIMIC_AXES.T
        followed = [names.index(joint_map[name]) for name in rig.joint_names]
        rotations = follow_joints(stacked, followed, alignments, rig.parents)
        translations = scale * frames[:, 1:4] @ DEEPMIMIC_AXES.T
        clips[path.stem.replace("humanoid3d", "deepmimic")] = _at_uniform_times(
            rotations, translations, frames[:, 0]
        )
    return clips


def _at_uniform_times(rotations: NDArray, translations: NDArray, durations: NDArray) -> Clip:
    """Put frames of varying duration [s] on a uniform clock; the last duration only closes the loop."""
    timestep = float(np.median(durations[:-1]))
    times = np.concatenate([[0.0], np.cumsum(durations[:-1])])
    if np.ptp(durations[:-1]) > 1e-4:
        uniform = np.arange(int(times[-1] / timestep + 1e-6) + 1) * timestep
        rotations, translations = retarget.interpolate(rotations, translations, times, uniform)
    return Clip(rotations, translations, 1.0 / timestep)


# ---------------------------------------------------------------- finishing and writing


def make_lowest_point(rig: Rig) -> Callable[[NDArray, NDArray], jax.Array]:
    """Return the function from one frame's rotations and root position to its lowest vertex's height [m]."""
    rest, weights, indices = (
        jnp.asarray(x) for x in (rig.rest_positions, rig.skin_weights, rig.skin_indices)
    )
    joints = jnp.asarray(rig.joint_rest_positions)

    @jax.jit
    def lowest_point(rotations, translation):
        transforms = lbs.joint_transforms(rotations, translation, joints, rig.parents)
        return lbs.skin(rest, weights, indices, transforms)[:, 1].min()

    return lowest_point


def finish(clip: Clip, lowest_point: Callable[[NDArray, NDArray], jax.Array], *, keeps_contact: bool) -> Clip:
    """Start above the origin facing +Z, and put the floor at y = 0.

    Args:
        clip: A retargeted clip.
        lowest_point: See `make_lowest_point`.
        keeps_contact: A foot is always on the floor, so a slow drift of the lowest point is an error of the
            source's root height; it is taken out.
    """
    rotations, translations = start_facing_front(clip.rotations, clip.translations)
    frames = zip(rotations.astype(np.float32), translations.astype(np.float32), strict=True)
    lowest = np.array([float(lowest_point(*frame)) for frame in frames])
    if keeps_contact:
        drift = gaussian_filter1d(lowest, DRIFT_SECONDS * clip.fps, mode="nearest")
        lowest, translations = lowest - drift, translations - drift[:, None] * [0.0, 1.0, 0.0]
    return Clip(rotations, translations - [0.0, np.quantile(lowest, GROUND_QUANTILE), 0.0], clip.fps)


def write_clips(path: Path, clips: dict[str, Clip], rig: Rig) -> None:
    """Write clips as npz; values are rounded so that they compress."""
    arrays = {"joint_names": np.array(rig.joint_names)}
    for name, clip in clips.items():
        rotations = np.round(clip.rotations / ROTATION_STEP) * ROTATION_STEP
        translations = np.round(clip.translations / TRANSLATION_STEP) * TRANSLATION_STEP
        arrays[f"{name}/rotations"] = rotations.astype(np.float32)
        arrays[f"{name}/translations"] = translations.astype(np.float32)
        arrays[f"{name}/fps"] = np.float64(clip.fps)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)
    frames = sum(len(clip.rotations) for clip in clips.values())
    print(f"{path}: {len(clips)} clips, {frames} frames, {path.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    """Retarget the clips of the folders given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--body", type=Path, default=DATA / "body" / "anny_cmu.npz")
    parser.add_argument("--cmu", type=Path, help="folder of EnvPool's CMU clips")
    parser.add_argument("--deepmimic", type=Path, help="folder of DeepMimic's clips")
    parser.add_argument("--output", type=Path, default=DATA / "motions")
    options = parser.parse_args()
    rig = Rig.load(options.body)
    lowest_point = make_lowest_point(rig)
    sources = (("cmu", retarget_cmu, True), ("deepmimic", retarget_deepmimic, False))
    for name, convert, keeps_contact in sources:
        source = getattr(options, name)
        if source is not None:
            clips = {
                key: finish(clip, lowest_point, keeps_contact=keeps_contact)
                for key, clip in sorted(convert(source, rig).items())
            }
            write_clips(options.output / f"{name}.npz", clips, rig)


if __name__ == "__main__":
    main()
