"""Mesh files of every kind come back as written; broken ones are named."""

import pickle

import numpy as np
import pytest
import trimesh
from whole_files import FACES, POSITIONS, whole_garment

from eslr_jax import AssetError, MeshError, load_body, load_motion
from eslr_jax.pipeline.formats.garment import (
    GarmentFile,
    is_garment_file,
    read_garment_npz,
    read_garment_source,
    write_garment_npz,
)
from eslr_jax.pipeline.formats.mesh import read_mesh, read_mesh_file


def assert_same(found, positions=POSITIONS, faces=FACES):
    np.testing.assert_allclose(found[0], positions, atol=1e-7)
    np.testing.assert_array_equal(found[1], faces)
    assert found[0].dtype == np.float64


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb", ".OBJ"])
def test_indexed_formats_keep_vertices_and_order(tmp_path, suffix):
    path = tmp_path / f"scarf{suffix}"
    path.write_bytes(_export(suffix.lower()[1:]))
    assert_same(read_mesh(path))


def _export(kind):
    data = trimesh.Trimesh(POSITIONS, FACES, process=False).export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_corners_are_shared(tmp_path, kind):
    path = tmp_path / "scarf.stl"
    path.write_bytes(_export(kind))
    positions, faces = read_mesh(path)
    assert len(positions) == len(POSITIONS)
    np.testing.assert_allclose(positions[faces], POSITIONS[FACES], atol=1e-7)


def test_all_solids_of_a_text_stl_are_read(tmp_path):
    apart = trimesh.Trimesh(POSITIONS + np.array([0.0, 5.0, 0.0]), FACES, process=False).export(
        file_type="stl_ascii"
    )
    path = tmp_path / "scarf.stl"
    path.write_text(_export("stl_ascii").decode() + "\n" + apart)
    positions, faces = read_mesh(path)
    assert len(positions) == 2 * len(POSITIONS)
    both = np.concatenate([POSITIONS[FACES], POSITIONS[FACES] + np.array([0.0, 5.0, 0.0])])
    np.testing.assert_allclose(positions[faces], both, atol=1e-6)


@pytest.mark.parametrize("key", ["rest_positions", "positions", "vertices"])
def test_npz_keys(tmp_path, key):
    np.savez(tmp_path / "scarf.npz", **{key: POSITIONS.astype(np.float32), "faces": FACES})
    assert_same(read_mesh(tmp_path / "scarf.npz"))


TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
OBJS = {  # text, positions, faces
    "loose and duplicate vertices, attributes": (
        "# made by hand\nmtllib a.mtl\no scarf\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 0 0\nv 9 9 9\nv 0 1 0\n"
        "vt 0 0\nvt 1 0\nvn 0 0 1\nusemtl b\ns off\nf 1/1/1 2/2/1 5/1/1 # corner\nf -5//1 3//1 -1//1\nl 1 2\n",
        [[0, 0, 0], [1, 0, 0], [1, 0, 0], [9, 9, 9], [0, 1, 0]],
        [[0, 1, 4], [0, 2, 4]],
    ),
    "tabs": ("v\t0 0 0\nv\t1\t0\t0\n\t\nv 0 1 0\nf\t1\t2\t3\n", TRIANGLE, [[0, 1, 2]]),
    "lines that go on in the next, a mark of Windows": (
        "\ufeffv 0 0 0\nv 1 0 0 # C:\\\nv 0 \\\n1 0\nf 1 \\\n2 \\\n3\n# C:\\\nf 1 3 2\n",
        TRIANGLE,
        [[0, 1, 2], [0, 2, 1]],
    ),
    "no faces": ("v 0 0 0\n", [[0, 0, 0]], np.zeros((0, 3))),
}


@pytest.mark.parametrize("kind", OBJS)
def test_obj_as_programs_and_hands_write_it(tmp_path, kind):
    text, positions, faces = OBJS[kind]
    (tmp_path / "a.obj").write_text(text)
    assert_same(read_mesh(tmp_path / "a.obj"), positions, faces)


def test_obj_texture_coordinates_and_parts_whose_names_may_hold_the_sign_of_comments(tmp_path):
    path = tmp_path / "scarf.obj"
    path.write_text(
        "o scarf\nv 0 0 0 # first\nv 1 0 0\nv 0 1 0#third\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvt .5 .5\n"
        "usemtl Fabric#1\nf 1/1 2/2 3/3\nusemtl Fabric#2 # the hem\nf 2/2 4/4 3/-2#last\n"
    )
    mesh = read_mesh_file(path)
    assert mesh.part_names == ("Fabric#1", "Fabric#2")
    assert mesh.faces.tolist() == [[0, 1, 2], [1, 3, 2]]
    assert mesh.face_parts.tolist() == [0, 1]
    assert mesh.corner_uvs.tolist() == [[[0, 0], [1, 0], [0, 1]], [[1, 0], [0.5, 0.5], [0, 1]]]


def test_glb_scene_transforms_are_applied(tmp_path):
    scene = trimesh.Scene()
    offset = np.eye(4)
    offset[:3, 3] = [0, 1, 0]
    scene.add_geometry(trimesh.Trimesh(POSITIONS, FACES, process=False), transform=offset)
    scene.export(tmp_path / "scarf.glb")
    assert_same(read_mesh(tmp_path / "scarf.glb"), POSITIONS + np.array([0, 1, 0]))


def test_polygons_of_obj_are_cut_and_those_of_ply_named(tmp_path):
    path = tmp_path / "quad.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 3 1 0\nv 0 1 0\nf 1 2 3 4\nf 1 2 3 4 4\n")
    faces = read_mesh(path)[1]
    assert faces.tolist() == [[1, 2, 3], [1, 3, 0], [0, 1, 2], [0, 2, 3], [0, 3, 3]]  # the shorter diagonal
    path = tmp_path / "dart.obj"
    corners = ["0 0 0", "0.4 2 0", "0 1 0", "-0.4 2 0", "-0.2 0.9 0", "0.2 0.9 0"]  # the third bends inwards
    path.write_text("".join(f"v {corner}\n" for corner in corners) + "f 1 2 3 4\nf 2 3 4 1\nf 6 2 3 4 5\n")
    faces = read_mesh(path)[1]
    assert faces.tolist()[:4] == [[0, 1, 2], [0, 2, 3], [2, 3, 0], [2, 0, 1]]
    assert faces.tolist()[4:] == [[2, 3, 4], [2, 4, 5], [2, 5, 1]]
    path.write_text("v 0 0 0\nv 1 1 0\nv 3 0 0\nv 0 1.2 0\nf 1 3 2 4\n# a bow tie\nf 1 2 3 4\n")
    with pytest.raises(
        MeshError, match=r"line 7: a face that crosses itself, or is too concave .*; triangulate the mesh"
    ):
        read_mesh(path)
    path.write_text("v 0 0 0\nv 1 1e-4 0\nv 3 0 0\nv 2 1e-4 0\nf 1 2 3 4\n")  # rounding made it cross itself
    assert read_mesh(path)[1].tolist() == [[1, 2, 3], [1, 3, 0]]
    path = tmp_path / "quad.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"
    )
    with pytest.raises(MeshError, match="not all of its 1 faces are triangles"):
        read_mesh(path)


def test_glb_parts_and_texture_coordinates(tmp_path):
    uv = np.arange(10.0).reshape(5, 2) / 10
    scene = trimesh.Scene()
    for name, shift in (("left", 0.0), ("right", 3.0)):
        visual = trimesh.visual.TextureVisuals(uv=uv)
        scene.add_geometry(
            trimesh.Trimesh(POSITIONS + shift, FACES, visual=visual, process=False), geom_name=name
        )
    scene.export(tmp_path / "scarf.glb")
    mesh = read_mesh_file(tmp_path / "scarf.glb")
    assert mesh.part_names == ("left", "right")
    np.testing.assert_allclose(mesh.corner_uvs[: len(FACES)], uv[FACES], atol=1e-6)
    np.testing.assert_allclose(mesh.positions[mesh.faces[len(FACES) :]], POSITIONS[FACES] + 3.0, atol=1e-6)


def test_garment_file_round_trip(tmp_path):
    garment = GarmentFile(
        rest_positions=POSITIONS,
        faces=FACES,
        skin_weights=np.full((5, 2), 0.5),
        skin_indices=np.tile([1, 3], (5, 1)),
        is_pinned=np.array([True, False, False, False, True]),
        sewn_positions=POSITIONS * 0.5,
        corner_uvs=np.full((3, 3, 2), 0.25),
        face_parts=np.array([0, 1, 1]),
        part_names=("body", "hem"),
        vertex_map=np.array([0, 1, 2, 3, 4, 0, -1]),
        metadata={"name": "scarf", "fabrics": ["silk"]},
    )
    write_garment_npz(tmp_path / "scarf.npz", garment)
    again = read_garment_npz(tmp_path / "scarf.npz")
    for name in garment.__dataclass_fields__:
        found, written = getattr(again, name), getattr(garment, name)
        np.testing.assert_array_equal(found, written)
        assert getattr(found, "dtype", None) == getattr(written, "dtype", None)


@pytest.mark.parametrize("suffix", [".usd", ".fbx"])
def test_scenes_of_other_programs_are_told_what_to_become(tmp_path, suffix):
    (tmp_path / f"a{suffix}").touch()
    with pytest.raises(AssetError, match=f"suffix '{suffix}'; export it as glTF .*give one of .*.obj"):
        read_mesh(tmp_path / f"a{suffix}")


def test_a_gltf_beside_its_buffers_is_read_as_its_glb(tmp_path):
    scene = trimesh.Scene(trimesh.Trimesh(POSITIONS, FACES, process=False))
    for name, content in trimesh.exchange.gltf.export_gltf(scene).items():
        (tmp_path / name).write_bytes(content)
    assert_same(read_mesh(tmp_path / "model.gltf"))


# --- what a user's file says about a garment beyond its mesh ------------------------------------------------


@pytest.fixture(scope="module")
def hood(tmp_path_factory):
    """HOOD's dictionary of garments, in its layout."""

    def entry(scale):
        return {
            "rest_pos": (POSITIONS * scale).astype(np.float32),
            "faces": FACES,
            "node_type": np.array([[0], [3], [0], [0], [3]]),
            "center": np.array([2]),
            "coarse_edges": {0: np.array([[0, 1]])},
            "lbs": {"v": POSITIONS, "f": FACES, "lbs_weights": np.ones((5, 24)) / 24},
        }

    path = tmp_path_factory.mktemp("hood") / "garments_dict.pkl"
    path.write_bytes(pickle.dumps({"tshirt": entry(1.0), "dress": entry(2.0)}))
    return path


def test_hood_garments_by_name_with_their_pins(hood):
    source = read_garment_source(f"{hood}#dress")
    np.testing.assert_allclose(source.positions, POSITIONS * 2)
    np.testing.assert_array_equal(source.faces, FACES)
    assert np.flatnonzero(source.is_pinned).tolist() == [1, 4]
    assert source.name == "dress"
    assert source.is_metric
    with pytest.raises(AssetError, match=r"the garments tshirt, dress; name one, as in .*pkl#NAME"):
        read_garment_source(hood)
    with pytest.raises(AssetError, match="has no garment 'coat'; it has tshirt, dress"):
        read_garment_source(f"{hood}#coat")


def test_a_folder_may_have_the_sign_of_names_in_its_own(hood, tmp_path):
    folder = tmp_path / "proj#2"
    folder.mkdir()
    (folder / "garments_dict.pkl").write_bytes(hood.read_bytes())
    assert read_garment_source(f"{folder}/garments_dict.pkl#dress").name == "dress"
    whole_garment("glb", folder / "a.glb")
    for name in ("a.glb", "a.glb#walk", "a.glb#/World/shirt"):
        with pytest.raises(AssetError, match="skin"):  # found, and read
            load_body(folder / name)
    (folder / "a.bvh").write_text("HIERARCHY")
    with pytest.raises(AssetError, match="the file ends here"):
        load_motion(folder / "a.bvh")


def test_formats_that_prescribe_metres_are_known(tmp_path):
    for kind, is_metric in (("glb", True), ("obj", False), ("ply", False)):
        path = tmp_path / f"scarf.{kind}"
        whole_garment(kind, path)
        assert read_garment_source(path).is_metric is is_metric
        assert not is_garment_file(path)
    path = tmp_path / "fitted.npz"
    whole_garment("fitted.npz", path)
    assert is_garment_file(path)
