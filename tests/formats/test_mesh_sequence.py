"""Bodies that are meshes in motion: read from archives and folders, carried by patches that move rigidly."""

import dataclasses

import numpy as np
import pygltflib as gltf
import pytest
import trimesh
from broken import refuses
from cloth import make_sheet
from garment_files import stored
from scipy.spatial.transform import Rotation

from eslr_jax import AssetError, MeshError, MotionError
from eslr_jax.pipeline.formats.animated import AnimatedMesh, Skin
from eslr_jax.pipeline.formats.garment import in_outfit_order, in_vertex_order
from eslr_jax.pipeline.formats.gltf import TOLERANCE, write_animated_glb
from eslr_jax.pipeline.formats.mesh import read_mesh
from eslr_jax.pipeline.formats.mesh_sequence import (
    MeshSequence,
    is_mesh_sequence,
    read_mesh_sequence,
    read_mesh_sequences,
)
from eslr_jax.pipeline.formats.obj import obj_text
from eslr_jax.pipeline.rigs.rig import UnitsWarning
from eslr_jax.pipeline.rigs.sequence import STILL_FRAMES, pose_sequence

CAPSULE = trimesh.creation.capsule(height=1.2, radius=0.25, count=(12, 12))
CAPSULE.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))  # it stands
FACES = np.asarray(CAPSULE.faces)
TURNS = Rotation.from_euler("y", [[0], [20], [40], [60]], degrees=True)
MOVING = np.stack([turn.apply(CAPSULE.vertices) for turn in TURNS])
MOVING[..., 1] += 0.1 * np.arange(4)[:, None]


def write_folder(folder, positions=MOVING, suffix=".obj", faces=FACES):
    folder.mkdir()
    for frame, points in enumerate(positions):
        path = folder / f"body{frame}{suffix}"  # without leading zeros: 10 comes after 9
        if suffix == ".obj":
            path.write_text(obj_text("body", points, faces))
        else:
            trimesh.Trimesh(points, faces, process=False).export(path)


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_folders_are_read_in_the_order_of_their_numbers(tmp_path, suffix):
    positions = np.concatenate([MOVING, MOVING + 0.1, MOVING + 0.2])
    write_folder(tmp_path / "frames", positions, suffix)
    sequence = read_mesh_sequence(tmp_path / "frames", fps=24.0)
    np.testing.assert_allclose(sequence.positions, positions, atol=1e-6)
    np.testing.assert_array_equal(sequence.faces, FACES)
    assert sequence.fps == 24.0
    assert is_mesh_sequence(tmp_path / "frames")


@pytest.mark.parametrize("key", ["positions", "vertices", "verts"])
def test_archives_are_read(tmp_path, key):
    np.savez(tmp_path / "a.npz", **{key: MOVING, "faces": FACES, "fps": 60})
    sequence = read_mesh_sequence(tmp_path / "a.npz")
    np.testing.assert_array_equal(sequence.positions, MOVING)
    assert sequence.fps == 60.0
    assert read_mesh_sequence(tmp_path / "a.npz", fps=30.0).fps == 30.0
    assert is_mesh_sequence(tmp_path / "a.npz")


def test_patches_follow_a_rigid_motion_exactly():
    body, poses = pose_sequence(MeshSequence("body", MOVING, FACES, 30.0))
    np.testing.assert_allclose(poses.positions, MOVING, atol=1e-6)
    rest = np.asarray(body.rest_positions)
    for frame in range(4):
        transforms = np.asarray(poses.joint_transforms[frame])
        moved = np.einsum("pab,vb->vpa", transforms[..., :3], rest) + transforms[..., 3]
        np.testing.assert_allclose(moved, np.repeat(MOVING[frame][:, None], len(transforms), 1), atol=1e-5)
    np.testing.assert_allclose(np.asarray(body.skin_weights).sum(axis=1), 1.0, atol=1e-6)


def test_a_single_mesh_is_held(tmp_path):
    """A mannequin: a folder of one file, or the file itself."""
    write_folder(tmp_path / "mannequin", MOVING[:1])
    for path in (tmp_path / "mannequin", tmp_path / "mannequin" / "body0.obj"):
        assert is_mesh_sequence(path)
        _, poses = pose_sequence(read_mesh_sequence(path), num_frames=7)
        np.testing.assert_allclose(poses.positions, np.repeat(MOVING[:1], 7, axis=0), atol=1e-6)
        _, poses = pose_sequence(read_mesh_sequence(path))
        assert len(poses.positions) == STILL_FRAMES


def test_frames_between_frames_lie_on_straight_lines():
    _, poses = pose_sequence(MeshSequence("body", MOVING, FACES, 15.0), fps=30.0)
    assert len(poses.positions) == 7
    np.testing.assert_allclose(poses.positions[3], 0.5 * (MOVING[1] + MOVING[2]), atol=1e-6)
    _, short = pose_sequence(MeshSequence("body", MOVING, FACES, 15.0), num_frames=3)
    assert len(short.positions) == 3
    with pytest.raises(MotionError, match="fewer"):
        pose_sequence(MeshSequence("body", MOVING, FACES, 15.0), num_frames=30)


def test_other_units_are_recognised_or_named():
    sequence = MeshSequence("body", 100 * MOVING, FACES, 30.0)
    _, expected = pose_sequence(MeshSequence("body", MOVING, FACES, 30.0))
    with pytest.warns(UnitsWarning, match="in cm"):
        _, guessed = pose_sequence(sequence)
    _, named = pose_sequence(sequence, units="cm")
    for found in (guessed, named):
        np.testing.assert_allclose(found.positions, expected.positions, atol=1e-6)


def test_polygons_are_cut_alike_in_all_frames(tmp_path):
    """The shorter diagonal of the second frame is the other one."""
    for number, slant in enumerate((0.3, -0.3)):
        corners = [(0, 0, 0), (1, 0, 0), (1 + slant, 1, 0), (slant, 1, 0)]
        text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3 4\n"
        (tmp_path / f"{number}.obj").write_text(text)
    alone = [read_mesh(tmp_path / f"{number}.obj")[1].tolist() for number in range(2)]
    assert read_mesh_sequence(tmp_path).faces.tolist() == alone[0] != alone[1]


def test_broken_folders_are_named_in_one_line(tmp_path):
    (tmp_path / "empty").mkdir()
    refuses(read_mesh_sequence, tmp_path / "empty", "holds no")
    write_folder(tmp_path / "mixed")
    (tmp_path / "mixed" / "body9.ply").write_bytes(b"ply")
    refuses(read_mesh_sequence, tmp_path / "mixed", "both")
    write_folder(tmp_path / "changing")
    (tmp_path / "changing" / "body4.obj").write_text(obj_text("body", MOVING[0], FACES[:-1]))
    refuses(read_mesh_sequence, tmp_path / "changing", "topology")
    write_folder(tmp_path / "broken")
    (tmp_path / "broken" / "body4.obj").write_text("v 1 2 three\n")
    refuses(read_mesh_sequence, tmp_path / "broken")


def write_shapes(path, *names, turn=0.0):
    """Write the capsule in motion as GLB files have it: seams split, a body with joints beside it."""
    uvs = np.stack([np.repeat(np.arange(len(FACES)) % 2, 3).reshape(-1, 3), np.zeros(FACES.shape)], axis=-1)
    cloths = [AnimatedMesh(name, MOVING, FACES, corner_uvs=uvs) for name in names]
    one = np.ones((len(CAPSULE.vertices), 1))
    skin = Skin(
        one, 0 * one.astype(int), np.tile(np.eye(3, 4), (4, 1, 1, 1)), np.zeros((1, 3)), [-1], ["hip"]
    )
    body = AnimatedMesh("body", MOVING, FACES, rest_positions=MOVING[0], skin=skin)
    write_animated_glb(path, [*cloths, body], 1 / 30)
    document = gltf.GLTF2().load(str(path))
    for node in document.nodes:
        if node.mesh is not None and node.skin is None:
            node.rotation = Rotation.from_euler("y", turn, degrees=True).as_quat().tolist()
    document.save(str(path))


def test_a_mesh_that_shapes_move_is_read_from_glb_with_its_own_vertices(tmp_path):
    write_shapes(tmp_path / "a.glb", "shirt", turn=90.0)
    sequence = read_mesh_sequence(tmp_path / "a.glb")
    turned = Rotation.from_euler("y", 90, degrees=True).apply(MOVING.reshape(-1, 3)).reshape(MOVING.shape)
    np.testing.assert_allclose(sequence.positions, turned, atol=TOLERANCE)
    np.testing.assert_array_equal(sequence.faces, FACES)
    assert sequence.fps == pytest.approx(30.0, rel=1e-4)
    slow = read_mesh_sequence(tmp_path / "a.glb", fps=15.0)
    np.testing.assert_allclose(slow.positions, turned[::2], atol=TOLERANCE)


def test_one_of_several_moving_meshes_of_a_glb_is_named(tmp_path):
    write_shapes(tmp_path / "a.glb", "shirt", "skirt")
    with pytest.raises(AssetError, match=r"it has shirt, skirt; name one, as in a\.glb#NAME"):
        read_mesh_sequence(tmp_path / "a.glb")
    sequences = read_mesh_sequences(tmp_path / "a.glb")
    assert [sequence.mesh for sequence in sequences] == ["shirt", "skirt"]
    for sequence in sequences:
        alone = read_mesh_sequence(f"{tmp_path / 'a.glb'}#{sequence.mesh}")
        assert alone.positions.shape == MOVING.shape
        np.testing.assert_array_equal(sequence.positions, alone.positions)
    np.savez(tmp_path / "a.npz", positions=MOVING, faces=FACES)
    assert len(read_mesh_sequences(tmp_path / "a.npz")) == 1
    write_shapes(tmp_path / "body.glb")
    with pytest.raises(AssetError, match="no mesh is moved by shapes"):
        read_mesh_sequence(tmp_path / "body.glb")


def test_several_clips_of_a_mesh_that_shapes_move_are_refused(tmp_path):
    write_shapes(tmp_path / "a.glb", "shirt")
    document = gltf.GLTF2().load(str(tmp_path / "a.glb"))
    whole, nodes = document.animations[0], document.nodes
    of_body = [channel for channel in whole.channels if nodes[channel.target.node].name != "shirt"]
    assert 0 < len(of_body) < len(whole.channels)
    document.animations.append(gltf.Animation(channels=of_body, samplers=whole.samplers))
    document.save(str(tmp_path / "a.glb"))
    # The body has two, the shirt one.
    assert len(read_mesh_sequence(tmp_path / "a.glb").positions) == len(MOVING)
    document.animations[1] = whole
    document.save(str(tmp_path / "a.glb"))
    with pytest.raises(AssetError, match=r"a\.glb holds 2 clips; export one"):
        read_mesh_sequence(tmp_path / "a.glb")


def garment_of(order=None):
    return stored(MOVING[0], FACES, vertex_map=order)


def test_positions_come_in_the_order_of_the_garment_whichever_of_its_files_they_are_in():
    order = np.random.default_rng(0).permutation(len(CAPSULE.vertices))
    order = np.concatenate([order, order[:3], [-1]])  # a seam, and a loose vertex
    own = MeshSequence("own", MOVING, FACES, 30.0)
    np.testing.assert_array_equal(in_vertex_order(own, garment_of(order)), MOVING)
    in_file, back = MOVING[:, order], np.argsort(order[: len(CAPSULE.vertices)])
    source = MeshSequence("source", in_file, back[FACES], 30.0)
    np.testing.assert_array_equal(in_vertex_order(source, garment_of(order)), MOVING)
    joined = MeshSequence("joined", in_file[:, :-4], back[FACES], 30.0)
    np.testing.assert_array_equal(in_vertex_order(joined, garment_of(order)), MOVING)
    # A GLB's reader joins the three, and keeps the loose one.
    kept = np.delete(np.arange(len(order)), np.arange(len(order) - 4, len(order) - 1))
    glb = MeshSequence("glb", in_file[:, kept], back[FACES], 30.0)
    fitted = dataclasses.replace(garment_of(order), joined_rows=kept)
    np.testing.assert_array_equal(in_vertex_order(glb, fitted), MOVING)


def outfit_of(low, high):
    """The capsule twice, one above the other, each with its own order of vertices in its file."""
    count = len(CAPSULE.vertices)
    rest, faces = np.concatenate([MOVING[0], MOVING[0] + 2.0]), np.concatenate([FACES, FACES + count])
    return stored(rest, faces, metadata={"outfit": {low: count, high: count}})


def test_garments_worn_together_are_found_by_the_names_of_their_meshes():
    moved = np.concatenate([MOVING, MOVING + 2.0], axis=1)
    skirt = MeshSequence("a.glb#skirt", MOVING, FACES, 30.0, "skirt")
    order = np.random.default_rng(0).permutation(len(CAPSULE.vertices))
    top = MeshSequence("a.glb#top.001", MOVING[:, order] + 2.0, np.argsort(order)[FACES], 30.0, "top.001")
    files = {"skirt": garment_of(), "top": garment_of(order)}
    outfit = outfit_of("skirt", "top")
    np.testing.assert_array_equal(in_outfit_order([top, skirt], outfit, files), moved)
    straight = MeshSequence("a.glb#top", MOVING + 2.0, FACES, 30.0, "top")
    np.testing.assert_array_equal(in_outfit_order([straight, skirt], outfit), moved)
    whole = MeshSequence("a.npz", moved, outfit.faces, 30.0)
    np.testing.assert_array_equal(in_outfit_order([whole], outfit), moved)
    with pytest.raises(MeshError, match=r"meshes top\.001, skirt, and none is called trousers"):
        in_outfit_order([top, skirt], outfit_of("trousers", "top"))
    with pytest.raises(MeshError, match="its vertices have another order"):
        in_outfit_order([top, skirt], outfit)
    np.testing.assert_array_equal(in_outfit_order([top, skirt, straight], outfit), moved)  # the exact name
    copies = [MeshSequence("a.glb", MOVING, FACES, 30.0, f"top.00{number}") for number in (1, 2)]
    with pytest.raises(MeshError, match=r"the meshes top\.001, top\.002 may all be top"):
        in_outfit_order([skirt, *copies], outfit)


def test_quads_cut_along_the_other_diagonal_are_the_same_mesh():
    points, one = make_sheet(6, 6, 1.0, jitter=0)
    (a, c, b), (_, d, _) = np.split(one, 2)[0].T, np.split(one, 2)[1].T
    other = np.concatenate([np.stack([a, d, b], 1), np.stack([b, d, c], 1)])
    quads = MeshSequence("quads", points[None], other, 30.0)
    np.testing.assert_array_equal(in_vertex_order(quads, stored(points, one)), points[None])


def test_another_order_or_another_mesh_is_refused():
    shuffled = np.random.default_rng(0).permutation(len(CAPSULE.vertices))
    with pytest.raises(MeshError, match="its vertices have another order"):
        in_vertex_order(
            MeshSequence("mine", MOVING[:, shuffled], np.argsort(shuffled)[FACES], 30.0), garment_of()
        )
    with pytest.raises(MeshError, match=f"has 10 vertices, the garment {len(CAPSULE.vertices)}"):
        in_vertex_order(MeshSequence("mine", MOVING[:, :10], FACES[:1] % 10, 30.0), garment_of())


def test_a_moving_mesh_that_lies_or_is_inside_out_is_told():
    with pytest.raises(MeshError, match="body: its faces point inside; flip the normals"):
        pose_sequence(MeshSequence("body", MOVING, FACES[:, ::-1], 30.0))
    lying = MOVING @ Rotation.from_euler("x", 90, degrees=True).as_matrix().T
    with pytest.warns(UserWarning, match="if it stands, turn it so that Y is up"):
        pose_sequence(MeshSequence("body", lying, FACES, 30.0))
