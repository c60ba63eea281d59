"""Broken files of every format: one line that says what is wrong, and no file appears.

`test_fuzz.py` shows that nothing else ever comes of a damaged file; here is what must not be read.
"""

import pickle
import re

import numpy as np
import pytest
from broken import pack, reader_of, refuses, tables_of
from whole_files import ACCLAIM, ARRAYS, BYTES, FACES, POSITIONS, character

NAN, INF = np.nan, np.inf
# Format, what is replaced in a whole file (a pattern), by what, and a word of the message.
REPLACED = [
    ("bvh", rb"(?s).*", b"", "ends"),
    ("bvh", rb"HIERARCHY", b"solid cube", "HIERARCHY"),
    ("bvh", rb"MOTION", b"}\nMOTION", "brace"),
    ("bvh", rb"Yrotation", b"Wrotation", "Wrotation"),
    ("bvh", rb"OFFSET \S+", b"OFFSET one", "line 4"),
    ("bvh", rb"Frames: 3", b"Frames: 1000000000", "frames"),
    ("bvh", rb"Frame Time: \S+", b"Frame Time: 0", "frame time"),
    ("bvh", rb"\S+\n\Z", b"", "numbers follow"),
    ("bvh", rb"\S+\n\Z", b"nan\n", "finite"),
    (".asf", rb"name spine", b"name root", "stands twice"),
    (".asf", rb"root spine", b"spine root", "parent"),
    (".asf", rb"length 2\n", b"", "length"),
    (".asf", rb"dof rx rz", b"dof l", "only rotations"),
    (".amc", rb"spine 10 20", b"wing 10 20", "wing"),
    (".amc", rb"spine 10 20", b"spine 10", "1 values"),
    (".amc", rb"spine 10 20", b"spine nan 1", "finite"),
    (".amc", rb"(?s).*", b"", "no frames"),
    ("garment obj", rb"(?s).*", b"", "empty mesh"),
    ("garment obj", rb"f 1/1 2/2 3/3", b"f 1/1 2/2", "line 13: a face of 2 vertices"),
    ("garment obj", rb"5/5/5", b"55/5/5", "outside 0..4"),
    ("garment obj", rb"0\.125", b"nan", "not finite"),
    ("garment obj", rb"v 0\.5 0\.0 0\.0", b"v 0.5 0.0", "can't be read"),
    ("garment ply", rb"element vertex 5", b"element vertex 9999999999", "impossible header"),
    ("garment ply", rb"(?s).{40}\Z", b"", "can't be read"),
    ("garment stl", rb"(?s)(?<=\A.{80}).{4}", b"\xff\xff\xff\x7f", "can't be read"),
    ("garment text.stl", rb"vertex 0\.25", b"vertex two", "can't be read"),
    ("garment glb", rb"(?s).{40}\Z", b"", "truncated"),
    ("garment npz", rb"(?s).{40}\Z", b"", "truncated"),
    ("garment pkl", rb"(?s).{40}\Z", b"", "can't be read as a pickle"),
    ("glb", rb"(?s).{40}\Z", b"", "truncated"),
    ("smpl pkl", rb"(?s).{400}\Z", b"", "can't be read as a pickle"),
]
# Format, the arrays that are changed or (None) missing, and a word of the message.
CHANGED = [
    ("smpl npz", {"f": None}, "lacks f"),
    ("smpl npz", {"f": np.array([[0, 1, 99999]])}, "99999"),
    ("smpl npz", {"weights": np.zeros((30, 24))}, "weights"),
    ("smpl npz", {"v_template": np.array(["a"] * 3)}, "v_template"),
    ("smpl npz", {"v_template": np.full((30, 3), NAN)}, "finite"),
    ("smpl npz", {"J_regressor": np.zeros((24, 6890))}, "J_regressor"),
    ("smpl npz", {"kintree_table": np.array([[-1] + [5] * 23, np.arange(24)])}, "cycle"),
    ("smpl npz", {"posedirs": np.zeros((30, 3, 486))}, "posedirs"),
    ("amass", {"poses": None}, "poses"),
    ("amass", {"mocap_framerate": None}, "lacks mocap_framerate or mocap_frame_rate or fps"),
    ("amass", {"poses": None}, "in place of poses: root_orient and pose_body"),
    ("amass", {"mocap_framerate": np.array("fast")}, "frame rate"),
    ("amass", {"mocap_framerate": np.array(1e9)}, "frames per second"),
    ("amass", {"poses": np.zeros((3, 153))}, "joints"),
    ("amass", {"trans": np.zeros((2, 3))}, "translations"),
    ("amass", {"trans": np.full((3, 3), INF)}, "frame 0"),
    ("amass", {"trans": np.zeros((0, 3)), "poses": np.zeros((0, 156))}, "frames"),
    ("mesh sequence", {"faces": None}, "lacks faces"),
    ("mesh sequence", {"positions": np.zeros((12, 3))}, "frames, vertices, 3"),
    ("mesh sequence", {"positions": np.full((3, 12, 3), NAN)}, "frame 0"),
    ("mesh sequence", {"faces": np.full((4, 3), 99)}, "99 of 12 vertices"),
    ("mesh sequence", {"fps": np.array(0.0)}, "frames per second"),
    ("motion archive", {"joint_names": None}, "no motion"),
    ("motion archive", {"c/fps": None}, "lacks c/fps"),
    ("motion archive", {"c/rotations": np.zeros((4, 5, 3))}, "[frames, 2, 3]"),
    ("motion archive", {"c/translations": np.zeros((3, 3))}, "translations"),
    ("body", {"faces": None}, "lacks faces"),
    ("body", {"faces": np.full((4, 3), 99)}, "99 of 12 vertices"),
    ("body", {"skin_indices": np.full((12, 2), 9)}, "9 of 2 joints"),
    ("body", {"skin_weights": np.zeros((12, 2))}, "skin weight"),
    ("body", {"parents": np.array([-1, 1])}, "parents"),
    ("body", {"joint_rest_positions": np.full((2, 3), NAN)}, "finite"),
    ("body", {"rest_positions": np.linspace(0, 1, 12)[:, None] * [0.5, 0.3, 1.8]}, "turn it so that Y is up"),
    ("garment", {"positions": None}, "it needs faces and"),
    ("garment", {"faces": FACES.astype(float)}, "integer vertex indices"),
    ("garment", {"positions": POSITIONS[:, :2]}, "vertices, 3"),
    ("garment", {"positions": np.array([{}, 1], object)}, "impossible header"),
    ("fitted garment", {"skin_weights": None}, "lacks skin_weights; it has faces"),
    ("fitted garment", {"skin_weights": np.ones((4, 1))}, "skin_weights is"),
    ("fitted garment", {"sewn_positions": POSITIONS[:3]}, "sewn_positions is"),
    ("fitted garment", {"face_parts": np.array([0, 1, 2])}, "names 2 of 0 parts"),
    ("fitted garment", {"metadata": np.array("{")}, "damaged metadata"),
    ("trajectory", {"positions": None}, "is no trajectory"),
    ("trajectory", {"format": np.array("eslr-trajectory-2")}, "has format"),
    ("trajectory", {"velocities": np.zeros((3, 4, 3), np.float32)}, "velocities"),
    ("trajectory", {"body_rest_positions": None}, "lacks body_rest_positions"),
    ("trajectory", {"body_faces": np.array([[0, 1, 99]])}, "body_faces names 99"),
    ("trajectory", {"timestep": np.array(0.0)}, "timestep"),
    ("trajectory", {"metadata": np.array([object()], object)}, "can't be read as an npz archive"),
]
# Format, the content of a pickle, and a word of the message.
PICKLED = [
    ("smpl pkl", [1, 2, 3], "no table"),
    ("hood pkl", {"a": 1}, "body_pose"),
    ("hood pkl", {"pose": np.zeros((2, 72))}, "translation"),
    ("hood pkl", {"pose": np.zeros((2, 72)), "translation": np.zeros((3, 3))}, "translations"),
    ("hood pkl", {"pose": np.full((2, 72), NAN), "translation": np.zeros((2, 3))}, "finite"),
    ("garment pkl", [1, 2], "no garments by name"),
    ("garment pkl", {"a": {}, "b": {}}, "name one, as in"),
    ("garment pkl", {"a": {"faces": FACES}}, "no array rest_pos"),
    (
        "garment pkl",
        {"a": {"rest_pos": POSITIONS, "faces": FACES, "node_type": [0] * 4}},
        "4 node_types for 5",
    ),
]
# What is changed in the tables of a character, and a word of the message.
TABLES = [
    (lambda t: t.pop("skins"), "skin"),
    (lambda t: [node.pop("skin", None) for node in t["nodes"]], "no triangles"),
    (lambda t: t["skins"][0]["joints"].append(99), "99"),
    (lambda t: t["nodes"][2].update(children=[0]), "node"),
    (lambda t: t["nodes"][0].update(rotation=[0, 0, 0, 0]), "rotation"),
    (lambda t: t["accessors"][1].update(count=10**9), "1000000000 values in a view"),
    (lambda t: t.update(extensionsRequired=["KHR_draco_mesh_compression"]), "draco"),
    (lambda t: t["meshes"][0]["primitives"][0].update(mode=5), "strips"),
    (lambda t: t["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "accessors None"),
    (lambda t: t.pop("meshes"), "meshes 0, which it doesn't have"),
    (lambda t: t["buffers"][0].update(uri="../../secret.bin"), "not beside it"),
    (lambda t: t["buffers"][0].update(uri="other.bin"), "not there"),
]


@pytest.mark.parametrize(("kind", "old", "new", "word"), REPLACED)
def test_replaced_bytes_are_named(tmp_path, kind, old, new, word):
    if kind in ACCLAIM:
        suffix, read = kind, lambda _: reader_of("motion")(tmp_path / "file.amc")
        for beside, good in ACCLAIM.items():
            (tmp_path / f"file{beside}").write_bytes(good)
    else:
        make, suffix, read = BYTES[kind]
        (tmp_path / f"file{suffix}").write_bytes(make())
    path = tmp_path / f"file{suffix}"
    whole = path.read_bytes()
    path.write_bytes(re.sub(old, new, whole, count=1))
    assert path.read_bytes() != whole
    refuses(read, path, word)


@pytest.mark.parametrize(("kind", "changes", "word"), CHANGED)
def test_changed_arrays_are_named(tmp_path, kind, changes, word):
    make, read = ARRAYS[kind]
    values = make() | changes
    np.savez(tmp_path / "file.npz", **{key: value for key, value in values.items() if value is not None})
    refuses(read, tmp_path / "file.npz", word)


@pytest.mark.parametrize(("kind", "values", "word"), PICKLED)
def test_other_pickles_are_named(tmp_path, kind, values, word):
    (tmp_path / "file.pkl").write_bytes(pickle.dumps(values))
    refuses(BYTES[kind][2], tmp_path / "file.pkl", word)


@pytest.mark.parametrize(("change", "word"), TABLES)
def test_changed_tables_of_gltf_are_named(tmp_path, change, word):
    tables, blob = tables_of(character())
    change(tables)
    (tmp_path / "file.glb").write_bytes(pack(tables, blob))
    refuses(reader_of("body"), tmp_path / "file.glb", word)


@pytest.mark.parametrize("kind", ["body", "motion"])
@pytest.mark.parametrize("content", [b"", b"glTF", b"{}", b"[1, 2]", b"{" * 5000])
def test_what_is_no_gltf_is_refused(tmp_path, content, kind):
    (tmp_path / "file.glb").write_bytes(content)
    refuses(reader_of(kind), tmp_path / "file.glb")


@pytest.mark.parametrize("kind", BYTES)
def test_files_that_are_missing_or_a_folder_are_named(tmp_path, kind):
    _, suffix, read = BYTES[kind]
    refuses(read, tmp_path / f"none{suffix}", "doesn't exist")
    (tmp_path / f"folder{suffix}").mkdir()
    refuses(read, tmp_path / f"folder{suffix}", "is a folder")
