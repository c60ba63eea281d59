"""What a user's file says about a garment beyond its mesh."""

import pickle

import numpy as np
import pytest
from whole_files import FACES, POSITIONS, whole_garment

from eslr_jax import AssetError, load_motion
from eslr_jax.files.parsing import split_name
from eslr_jax.pipeline.dressing.outfit import garment_names
from eslr_jax.pipeline.formats.garment import is_garment_file, read_garment_source
from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequence


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
    assert split_name("proj#2/dir/a.glb#walk") == ("proj#2/dir/a.glb", "walk")
    assert split_name("proj#2/a.bvh") == ("proj#2/a.bvh", "")
    (tmp_path / "a.glb").touch()
    assert split_name(f"{tmp_path}/a.glb#/World/shirt") == (f"{tmp_path}/a.glb", "/World/shirt")
    folder = tmp_path / "proj#2"
    folder.mkdir()
    (folder / "garments_dict.pkl").write_bytes(hood.read_bytes())
    assert read_garment_source(f"{folder}/garments_dict.pkl#dress").name == "dress"
    np.savez(folder / "a.npz", positions=np.tile(POSITIONS, (3, 1, 1)), faces=FACES)
    assert len(read_mesh_sequence(folder / "a.npz").positions) == 3
    whole_garment("glb", folder / "a.glb")
    with pytest.raises(AssetError, match="no mesh is moved by shapes"):  # found, and read
        read_mesh_sequence(folder / "a.glb")
    (folder / "a.bvh").write_text("HIERARCHY")
    with pytest.raises(AssetError, match="the file ends here"):
        load_motion(folder / "a.bvh")
    assert garment_names([f"{folder}/a.obj", f"{folder}/garments_dict.pkl#dress"]) == ["a", "dress"]


def test_formats_that_prescribe_metres_are_known(tmp_path):
    for kind, is_metric in (("glb", True), ("obj", False), ("ply", False)):
        path = tmp_path / f"scarf.{kind}"
        whole_garment(kind, path)
        assert read_garment_source(path).is_metric is is_metric
        assert not is_garment_file(path)
    path = tmp_path / "fitted.npz"
    whole_garment("fitted.npz", path)
    assert is_garment_file(path)
