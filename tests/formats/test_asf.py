"""ASF and AMC files move as their definition says, and as a BVH file of the same joints."""

import numpy as np
import pytest
from broken import read, reader_of, refuses
from foreign_files import write_bvh
from scipy.spatial.transform import Rotation

from eslr_jax import load_motion

# Name, parent, direction, length, axis, degrees of freedom: CMU's names, with axes that are turned.
BONES = (
    ("lhipjoint", "root", (0.6, -0.8, 0.0), 2.0, (0, 0, 0), ""),
    ("lfemur", "lhipjoint", (0.34, -0.94, 0.0), 7.0, (0, 0, 20), "rx ry rz"),
    ("ltibia", "lfemur", (0.34, -0.94, 0.0), 7.5, (10, 0, 20), "rx"),
    ("lfoot", "ltibia", (0.0, -0.3, 0.95), 2.0, (-90, 0, 20), "rx rz"),
    ("rhipjoint", "root", (-0.6, -0.8, 0.0), 2.0, (0, 0, 0), ""),
    ("rfemur", "rhipjoint", (-0.34, -0.94, 0.0), 7.0, (0, 0, -20), "rx ry rz"),
    ("rtibia", "rfemur", (-0.34, -0.94, 0.0), 7.5, (0, 0, -20), "rx"),
    ("rfoot", "rtibia", (0.0, -0.3, 0.95), 2.0, (-90, 0, -20), "rx rz"),
    ("lowerback", "root", (0.0, 1.0, 0.0), 2.0, (0, 0, 0), "rx ry rz"),
    ("head", "lowerback", (0.0, 1.0, 0.1), 5.0, (0, 30, 0), "rz ry rx"),
    ("lhumerus", "lowerback", (1.0, 0.0, 0.0), 5.0, (180, 30, 90), "rx ry rz"),
    ("lradius", "lhumerus", (1.0, 0.0, 0.0), 3.0, (180, 30, 90), "rx"),
    ("rhumerus", "lowerback", (-1.0, 0.0, 0.0), 5.0, (180, -30, -90), "rx ry rz"),
    ("rradius", "rhumerus", (-1.0, 0.0, 0.0), 3.0, (180, -30, -90), "rx"),
)
FRAMES = 5


def asf_text():
    lines = [
        "# made by hand",
        ":version 1.10",
        ":units",
        "  mass 1.0",
        "  length 0.45",
        "  angle deg",
        ":root",
    ]
    lines += [
        "  order TX TY TZ RX RY RZ",
        "  axis XYZ",
        "  position 0 0 0",
        "  orientation 0 0 0",
        ":bonedata",
    ]
    for number, (name, _, direction, length, axis, dof) in enumerate(BONES, 1):
        words = " ".join(map(str, direction)), " ".join(map(str, axis))
        lines += ["  begin", f"    id {number}", f"    name {name}", f"    direction {words[0]}"]
        lines += [f"    length {length}", f"    axis {words[1]}  XYZ"]
        lines += [f"    dof {dof}", "    limits (-180.0 180.0)"] if dof else []
        lines += ["  end"]
    lines += [":hierarchy", "  begin"]
    for parent in dict.fromkeys(bone[1] for bone in BONES):
        lines.append(f"    {parent} " + " ".join(bone[0] for bone in BONES if bone[1] == parent))
    return "\n".join([*lines, "  end"]) + "\n"


def amc_text(values):
    lines = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for frame in range(FRAMES):
        lines.append(str(frame + 1))
        lines += [f"{name} {' '.join(f'{x:.6f}' for x in rows[frame])}" for name, rows in values.items()]
    return "\n".join(lines) + "\n"


def make_values(seed=0):
    rng = np.random.default_rng(seed)
    values = {"root": rng.normal(0, 20, (FRAMES, 6))}
    return values | {b[0]: rng.normal(0, 25, (FRAMES, len(b[5].split()))) for b in BONES if b[5]}


def expected(values):
    """Global rotation and start of every bone by homogeneous matrices, as the format's definition says."""

    def turn(axis, degrees):
        return Rotation.from_rotvec(np.radians(degrees) * np.eye(3)["xyz".index(axis)]).as_matrix()

    found = {}
    for frame in range(FRAMES):
        row = values["root"][frame]
        matrix = np.eye(4)
        matrix[:3, :3] = turn("z", row[5]) @ turn("y", row[4]) @ turn("x", row[3])
        matrix[:3, 3] = row[:3]
        start, end = {"root": matrix}, {"root": matrix}
        for name, parent, direction, length, axis, dof in BONES:
            resting = turn("z", axis[2]) @ turn("y", axis[1]) @ turn("x", axis[0])
            turned = np.eye(3)
            for word, angle in zip(dof.split(), values.get(name, [()] * FRAMES)[frame], strict=True):
                turned = turn(word[1], angle) @ turned
            local = np.eye(4)
            local[:3, :3] = resting @ turned @ np.linalg.inv(resting)
            start[name] = end[parent] @ local
            along = np.eye(4)
            along[:3, 3] = length * np.array(direction)
            end[name] = start[name] @ along
        for name, matrix in start.items():
            found.setdefault(name, []).append(matrix)
    return {name: np.array(matrices) for name, matrices in found.items()}


@pytest.fixture
def clip(tmp_path):
    (tmp_path / "01.asf").write_text(asf_text())
    (tmp_path / "01_02.amc").write_text(amc_text(make_values()))
    return tmp_path / "01_02.amc"


def test_amc_moves_as_its_definition_says(clip):
    motion = read("motion", clip)
    assert motion.name == "01_02"
    assert motion.fps == 120.0
    found = expected({name: rows.round(6) for name, rows in make_values().items()})
    assert set(motion.skeleton.joint_names) == set(found)
    for joint, name in enumerate(motion.skeleton.joint_names):
        np.testing.assert_allclose(motion.rotations[:, joint], found[name][:, :3, :3], atol=1e-9)
        np.testing.assert_allclose(motion.positions[:, joint], found[name][:, :3, 3], atol=1e-9)
    place = motion.skeleton.joint_names.index("ltibia")
    rest = 2 * np.array([0.6, -0.8, 0]) + 7 * np.array([0.34, -0.94, 0])
    np.testing.assert_allclose(motion.skeleton.rest_positions[place], rest)


def test_amc_equals_its_bvh_twin_and_moves_the_bundled_body_alike(clip, tmp_path, body):
    motion = read("motion", clip)
    write_bvh(tmp_path / "twin.bvh", motion)
    twin = read("motion", tmp_path / "twin.bvh")
    order = [twin.skeleton.joint_names.index(name) for name in motion.skeleton.joint_names]
    np.testing.assert_allclose(twin.rotations[:, order], motion.rotations, atol=1e-6)
    np.testing.assert_allclose(twin.positions[:, order], motion.positions, atol=1e-5)
    np.testing.assert_allclose(twin.skeleton.rest_positions[order], motion.skeleton.rest_positions, atol=1e-6)
    ours, theirs = load_motion(clip, body=body), load_motion(tmp_path / "twin.bvh", body=body)
    np.testing.assert_allclose(ours.rotations, theirs.rotations, atol=1e-5)
    np.testing.assert_allclose(ours.translations, theirs.translations, atol=1e-6)


def test_radians_are_read(clip):
    before = read("motion", clip)
    skeleton = clip.with_name("01.asf")
    text = skeleton.read_text().replace("angle deg", "angle rad")
    for bone in BONES:
        axis = " ".join(map(str, bone[4]))
        text = text.replace(f"axis {axis} ", f"axis {' '.join(str(x) for x in np.radians(bone[4]))} ")
    skeleton.write_text(text)
    values = make_values()
    for name, rows in values.items():
        rows[:, 3 if name == "root" else 0 :] = np.radians(rows[:, 3 if name == "root" else 0 :])
    clip.write_text(amc_text(values).replace(":DEGREES", ":RADIANS"))
    np.testing.assert_allclose(read("motion", clip).rotations, before.rotations, atol=1e-5)


def test_the_skeleton_has_to_lie_beside(clip):
    clip.with_name("01.asf").unlink()
    refuses(reader_of("motion"), clip, "put 01_02.asf beside it")


def test_frame_numbers_alone_don_t_take_memory(clip):
    clip.write_text("\n".join(["1"] * 10) + f"\n{10**9}\n")
    assert len(read("motion", clip).positions) == 11
