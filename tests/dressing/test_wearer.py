"""A fitted garment is worn by the body that it was fitted to, and by no other."""

import dataclasses

import pytest
from garment_files import bundled

from eslr_jax import AssetError, MeshError
from eslr_jax.pipeline.assets import load_garment_file
from eslr_jax.pipeline.dressing.outfit import combine_garments
from eslr_jax.pipeline.dressing.transfer import transfer_garment
from eslr_jax.pipeline.formats.garment import write_garment_npz

NUDGE = 5e-4  # [m], less than two files of one body may differ by


@pytest.fixture(scope="module")
def tank(body):
    """A garment as its run keeps it."""
    return load_garment_file("tank", body=body)


@pytest.fixture(scope="module")
def file(tank, tmp_path_factory):
    path = tmp_path_factory.mktemp("wearer") / "tank.npz"
    write_garment_npz(path, tank)
    return path


def larger(body, by):
    """Return a body of another shape, its joints moved by so much [m]."""
    return body.replace(joint_rest_positions=body.joint_rest_positions + by)


def renamed(body):
    return body.replace(joint_names=("pelvis", *body.joint_names[1:]))


def test_its_own_body_wears_it(file, tank, body):
    assert load_garment_file(file, body=body).metadata == tank.metadata
    assert load_garment_file(file, body=larger(body, NUDGE)).metadata == tank.metadata


def test_a_body_with_other_joints_does_not(file, body):
    with pytest.raises(
        MeshError, match=r"tank\.npz was fitted to another body, with other joints \(Hips, pelvis\)"
    ):
        load_garment_file(file, body=renamed(body))
    swapped = body.replace(joint_names=(*body.joint_names[1::-1], *body.joint_names[2:]))
    with pytest.raises(MeshError, match=r"was fitted to another body, .* \(in another order\)"):
        load_garment_file(file, body=swapped)


def test_a_body_of_another_shape_does_not(file, body):
    with pytest.raises(MeshError, match=r"was fitted to another body, of another shape .* 35 mm away"):
        load_garment_file(file, body=larger(body, 0.02))


def test_a_garment_that_is_carried_tells_its_new_body(body):
    taller = body.replace(
        rest_positions=1.1 * body.rest_positions, joint_rest_positions=1.1 * body.joint_rest_positions
    )
    carried = transfer_garment(bundled("tank_1k"), body, taller)
    joint = carried.metadata["body"]["joint_rest_positions"][3]
    assert joint == pytest.approx(taller.joint_rest_positions[3].tolist(), abs=1e-5)


def test_an_outfit_tells_the_body_of_its_garments(tank):
    below = dataclasses.replace(tank, rest_positions=tank.rest_positions - [0.0, 2.0, 0.0], metadata={})
    outfit = combine_garments([below, tank], ["low", "high"])
    assert outfit.metadata["body"] == tank.metadata["body"]
    joints = tank.metadata["body"]["joint_rest_positions"]
    other = tank.metadata["body"] | {"joint_rest_positions": [[x, y + 0.01, z] for x, y, z in joints]}
    with pytest.raises(MeshError, match="high was fitted to another body than low"):
        combine_garments([dataclasses.replace(below, metadata={"body": other}), tank], ["low", "high"])


@pytest.mark.parametrize("entry", [None, "anny", {"joint_names": ["Hips"]}, {"joint_names": ["Hips"],
    "joint_rest_positions": [0.0]}, {"joint_names": 3, "joint_rest_positions": []}])  # fmt: skip
def test_a_damaged_entry_is_named(tank, tmp_path, body, entry):
    write_garment_npz(tmp_path / "a.npz", dataclasses.replace(tank, metadata={"body": entry}))
    with pytest.raises(AssetError, match=r"a\.npz has damaged metadata; fit the garment again"):
        load_garment_file(tmp_path / "a.npz", body=body)
