"""An animated GLB, played back by an evaluator of our own, shows the positions that were written."""

import dataclasses
import os

import numpy as np
import pygltflib as gltf
import pytest
import trimesh
from cloth import grid_faces
from scipy.spatial.transform import Rotation

from eslr_jax import MeshError, MotionError
from eslr_jax.pipeline.formats.animated import AnimatedMesh, Skin, vertex_normals
from eslr_jax.pipeline.formats.gltf import TOLERANCE as TARGET_TOLERANCE
from eslr_jax.pipeline.formats.gltf import write_animated_glb

TIMESTEP = 1 / 30
TOLERANCE = 1e-6  # [m]: float32 positions within two metres of the origin, skinned through a few joints
_TYPES = {
    gltf.SHORT: np.int16,
    gltf.FLOAT: np.float32,
    gltf.UNSIGNED_BYTE: np.uint8,
    gltf.UNSIGNED_SHORT: np.uint16,
    gltf.UNSIGNED_INT: np.uint32,
}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Player:
    """Evaluates a GLB at a time, as the glTF 2.0 specification says."""

    def __init__(self, path):
        self.document = gltf.GLTF2().load(str(path))
        self.blob = self.document.binary_blob()

    def read(self, index):
        accessor = self.document.accessors[index]
        dtype, width = np.dtype(_TYPES[accessor.componentType]), _WIDTHS[accessor.type]
        if accessor.bufferView is None:
            return np.zeros((accessor.count, width))
        view = self.document.bufferViews[accessor.bufferView]
        columns = (view.byteStride or width * dtype.itemsize) // dtype.itemsize
        values = np.frombuffer(self.blob, dtype, accessor.count * columns, view.byteOffset)
        values = values.reshape(-1, columns)[:, :width]
        if accessor.normalized:
            values = values / np.iinfo(dtype).max
        return values if width > 1 else values[:, 0]

    def sample(self, time, node, path):
        """The animated value of a node's property, or None."""
        for animation in self.document.animations:
            for channel in animation.channels:
                if (channel.target.node, channel.target.path) == (node, path):
                    sampler = animation.samplers[channel.sampler]
                    times = self.read(sampler.input)
                    values = self.read(sampler.output).reshape(len(times), -1).astype(float)
                    return np.array([np.interp(time, times, column) for column in values.T])
        return None

    def globals(self, time):
        """Node index -> 4 x 4 matrix."""
        matrices = {}

        def visit(index, parent):
            node = self.document.nodes[index]
            local = np.eye(4)
            rotation, translation = (
                getattr(node, path) if (value := self.sample(time, index, path)) is None else value
                for path in ("rotation", "translation")
            )
            local[:3, :3] = Rotation.from_quat(rotation).as_matrix() if rotation is not None else np.eye(3)
            local[:3, 3] = translation if translation is not None else 0
            matrices[index] = parent @ local
            for child in node.children or []:
                visit(child, matrices[index])

        for root in self.document.scenes[0].nodes:
            visit(root, np.eye(4))
        return matrices

    def positions(self, name, time):
        index = next(
            i for i, node in enumerate(self.document.nodes) if node.name == name and node.mesh is not None
        )
        node = self.document.nodes[index]
        mesh = self.document.meshes[node.mesh]
        primitive = mesh.primitives[0]
        points = self.read(primitive.attributes.POSITION).astype(float)
        weights = self.sample(time, index, "weights")
        if weights is not None:
            deltas = [self.read(target["POSITION"]) for target in primitive.targets]
            points = points + np.einsum("t,tvc->vc", weights, deltas)
        return points if node.skin is None else self.skinned(node.skin, primitive, points, time)

    def skinned(self, skin_index, primitive, points, time):
        skin = self.document.skins[skin_index]
        matrices = self.globals(time)
        bind = self.read(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        joints = np.stack([matrices[joint] for joint in skin.joints]) @ bind
        result = np.zeros_like(points)
        for number in range(2):
            index = getattr(primitive.attributes, f"JOINTS_{number}", None)
            if index is not None:
                weights = self.read(getattr(primitive.attributes, f"WEIGHTS_{number}"))
                moved = np.einsum("vkab,vb->vka", joints[self.read(index)][..., :3, :3], points)
                result += np.einsum("vk,vka->va", weights, moved + joints[self.read(index)][..., :3, 3])
        return result


def make_cloth(num_frames=5, seed=0):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    rng = np.random.default_rng(seed)
    positions = sphere.vertices + 0.1 * rng.normal(size=(num_frames, len(sphere.vertices), 3))
    return AnimatedMesh("cloth", positions.astype(np.float32), np.asarray(sphere.faces))


def make_body(num_frames=5, num_influences=6, turn=0.2):
    """A sphere on three joints in a chain, with random poses."""
    sphere = trimesh.creation.icosphere(subdivisions=2)
    rng = np.random.default_rng(1)
    weights = rng.dirichlet(np.ones(num_influences), size=len(sphere.vertices))
    indices = rng.permuted(np.tile(np.arange(8), (len(sphere.vertices), 1)), axis=1)[:, :num_influences]
    # Small turns between frames: a quaternion's linear blend and slerp agree at key frames only.
    turns = np.cumsum(turn * rng.normal(size=(num_frames, 8, 3)), axis=0)
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(num_frames, 8, 3, 3)
    transforms = np.concatenate([rotations, 0.2 * rng.normal(size=(num_frames, 8, 3, 1))], axis=-1)
    joints = [f"joint {joint}" for joint in range(8)]
    skin = Skin(weights, indices, transforms, np.zeros((8, 3)), [-1] * 8, joints)
    return with_skin(skin, sphere.vertices, np.asarray(sphere.faces))


def with_skin(skin, rest, faces):
    """A mesh that moves as its joints say."""
    matrices = skin.joint_transforms[:, skin.skin_indices]
    moved = np.einsum("tvkab,vb->tvka", matrices[..., :3], rest) + matrices[..., 3]
    positions = np.einsum("vk,tvka->tva", skin.skin_weights, moved)
    return AnimatedMesh("body", positions, faces, rest_positions=rest, skin=skin)


def change_skin(mesh, **change):
    return dataclasses.replace(mesh, skin=dataclasses.replace(mesh.skin, **change))


def test_glb_plays_a_free_mesh_exactly_and_blends_linearly(tmp_path):
    cloth = make_cloth()
    write_animated_glb(tmp_path / "a.glb", [cloth], TIMESTEP)
    player = Player(tmp_path / "a.glb")
    for frame in range(5):
        shown = player.positions("cloth", frame * TIMESTEP)
        np.testing.assert_allclose(shown, cloth.positions[frame], atol=TOLERANCE)
    between = player.positions("cloth", 2.25 * TIMESTEP)
    expected = 0.75 * cloth.positions[2] + 0.25 * cloth.positions[3]
    np.testing.assert_allclose(between, expected, atol=TOLERANCE)


@pytest.mark.parametrize("num_influences", [1, 3, 4, 6])
@pytest.mark.parametrize("has_hierarchy", [False, True])
def test_glb_plays_a_skinned_body(tmp_path, num_influences, has_hierarchy):
    body = make_body(num_influences=num_influences)
    if has_hierarchy:
        joints = np.random.default_rng(2).normal(size=(8, 3))
        body = change_skin(body, joint_rest_positions=joints, parents=[-1, 0, 1, 2, 0, 4, 5, -1])
    write_animated_glb(tmp_path / "a.glb", [make_cloth(), body], TIMESTEP)
    player = Player(tmp_path / "a.glb")
    for frame in range(5):
        shown = player.positions("body", frame * TIMESTEP)
        np.testing.assert_allclose(shown, body.positions[frame], atol=2 * TOLERANCE)
    assert not player.document.meshes[1].primitives[0].targets


def test_glb_adds_what_the_joints_can_t_do_as_few_morph_targets(tmp_path):
    """Pose blend shapes bend 30 frames of a body; two shapes hold them."""
    body = make_body(num_frames=30, turn=0.05)
    rng = np.random.default_rng(4)
    shapes = 0.05 * rng.normal(size=(2, *body.rest_positions.shape))
    offsets = np.einsum("ts,sva->tva", rng.normal(size=(30, 2)), shapes)
    matrices = body.skin.joint_transforms[:, body.skin.skin_indices, :, :3]
    moved = np.einsum("vk,tvkab,tvb->tva", body.skin.skin_weights, matrices, offsets)
    body = dataclasses.replace(body, positions=body.positions + moved)
    write_animated_glb(tmp_path / "a.glb", [body], TIMESTEP)
    player = Player(tmp_path / "a.glb")
    assert len(player.document.meshes[0].primitives[0].targets) == 2
    for frame in range(30):
        shown = player.positions("body", frame * TIMESTEP)
        assert np.linalg.norm(shown - body.positions[frame], axis=1).max() < TARGET_TOLERANCE


def smooth_motion(num_frames, num_vertices):
    """Vertices on slow paths, as cloth's are: sums of few waves, with a trembling that nobody sees."""
    rng = np.random.default_rng(5)
    times = np.linspace(0, 4 * np.pi, num_frames)[:, None]
    waves = np.cos(times * rng.uniform(0, 3, 12) + rng.uniform(0, 6, 12))
    positions = np.einsum("tw,wva->tva", waves, 0.1 * rng.normal(size=(12, num_vertices, 3)))
    return positions + 1e-6 * rng.normal(size=positions.shape)


def test_small_shapes_take_16_bits_and_keep_the_tolerance(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    positions = sphere.vertices + 0.03 * smooth_motion(40, len(sphere.vertices))
    cloth = AnimatedMesh("cloth", positions.astype(np.float32), np.asarray(sphere.faces))
    write_animated_glb(tmp_path / "a.glb", [cloth], TIMESTEP)
    player = Player(tmp_path / "a.glb")
    assert player.document.extensionsRequired == ["KHR_mesh_quantization"]
    targets = player.document.meshes[0].primitives[0].targets
    accessors = [player.document.accessors[target["POSITION"]] for target in targets]
    assert {accessor.componentType for accessor in accessors} == {gltf.SHORT}
    assert len(targets) <= 12  # as few as there are waves
    assert all(low >= -32767 for accessor in accessors for low in accessor.min)
    for frame in range(40):
        away = player.positions("cloth", frame * TIMESTEP) - cloth.positions[frame]
        assert np.linalg.norm(away, axis=1).max() < TARGET_TOLERANCE


@pytest.mark.slow
def test_glb_of_a_long_clip_stays_small(tmp_path):
    positions = smooth_motion(1127, 32 * 32).astype(np.float32)
    write_animated_glb(tmp_path / "a.glb", [AnimatedMesh("cloth", positions, grid_faces(32, 32))], TIMESTEP)
    assert (tmp_path / "a.glb").stat().st_size < 5e6


def test_glb_quaternions_never_take_the_long_way_round(tmp_path):
    body = make_body(num_frames=60)
    turns = np.linspace(0, 4 * np.pi, 60)[:, None] * np.array([0.0, 1.0, 0.0])
    transforms = np.zeros((60, 8, 3, 4))
    transforms[..., :3] = Rotation.from_rotvec(turns).as_matrix()[:, None]
    skin = dataclasses.replace(body.skin, joint_transforms=transforms)
    write_animated_glb(tmp_path / "a.glb", [with_skin(skin, body.rest_positions, body.faces)], TIMESTEP)
    player = Player(tmp_path / "a.glb")
    channel = next(c for c in player.document.animations[0].channels if c.target.path == "rotation")
    values = player.read(player.document.animations[0].samplers[channel.sampler].output)
    assert (np.einsum("ti,ti->t", values[1:], values[:-1]) > 0).all()


def test_glb_opens_in_trimesh_with_frame_zero(tmp_path):
    cloth = make_cloth()
    write_animated_glb(tmp_path / "a.glb", [cloth], TIMESTEP)
    geometry = next(iter(trimesh.load(tmp_path / "a.glb", process=False).geometry.values()))
    np.testing.assert_allclose(geometry.vertices, cloth.positions[0], atol=TOLERANCE)
    np.testing.assert_array_equal(geometry.faces, cloth.faces)


def test_glb_of_a_single_frame_has_no_animation(tmp_path):
    body = make_body(num_frames=1)
    write_animated_glb(tmp_path / "a.glb", [make_cloth(num_frames=1), body], TIMESTEP)
    player = Player(tmp_path / "a.glb")
    assert not player.document.animations
    np.testing.assert_allclose(player.positions("body", 0.0), body.positions[0], atol=TOLERANCE)


def test_glb_accessors_carry_the_bounds_and_alignment_that_gltf_demands(tmp_path):
    write_animated_glb(tmp_path / "a.glb", [make_cloth(), make_body()], TIMESTEP)
    player = Player(tmp_path / "a.glb")
    document = player.document
    assert all(view.byteOffset % 4 == 0 for view in document.bufferViews)
    for mesh in document.meshes:
        accessor = document.accessors[mesh.primitives[0].attributes.POSITION]
        points = player.read(mesh.primitives[0].attributes.POSITION)
        np.testing.assert_array_equal(points.min(0), np.float32(accessor.min))
        np.testing.assert_array_equal(points.max(0), np.float32(accessor.max))


def test_vertex_normals_of_a_sphere_are_its_directions():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    normals = vertex_normals(sphere.vertices, np.asarray(sphere.faces))
    np.testing.assert_allclose(normals, sphere.vertices, atol=0.02)  # facets of 0.15 rad
    lonely = vertex_normals(np.zeros((4, 3)), np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(lonely, np.tile([0.0, 1.0, 0.0], (4, 1)))


SPOILED = {
    "fewer frames": ([make_cloth(num_frames=4), make_body()], TIMESTEP),
    "no frames": ([make_cloth(num_frames=0)], TIMESTEP),
    "no time": ([make_cloth()], 0.0),
    "a vertex beyond": ([dataclasses.replace(make_cloth(), faces=np.array([[0, 1, 9999]]))], TIMESTEP),
    "no faces": ([dataclasses.replace(make_cloth(), faces=np.zeros((0, 3), int))], TIMESTEP),
    "not finite": ([dataclasses.replace(make_cloth(), positions=np.full((5, 162, 3), np.nan))], TIMESTEP),
    "velocities of others": ([dataclasses.replace(make_cloth(), velocities=np.ones((5, 3, 3)))], TIMESTEP),
    "no rest": ([dataclasses.replace(make_body(), rest_positions=None)], TIMESTEP),
    "not rigid": ([change_skin(make_body(), joint_transforms=np.ones((5, 8, 3, 4)))], TIMESTEP),
    "fewer poses": ([change_skin(make_body(), joint_transforms=np.ones((4, 8, 3, 4)))], TIMESTEP),
    "fewer parents": ([change_skin(make_body(), parents=[-1])], TIMESTEP),
    "heavy weights": ([change_skin(make_body(), skin_weights=np.ones((162, 6)))], TIMESTEP),
    "a joint beyond": ([change_skin(make_body(), skin_indices=np.full((162, 6), 8))], TIMESTEP),
}


@pytest.mark.parametrize("kind", SPOILED)
def test_glb_names_what_is_wrong_and_writes_nothing(tmp_path, kind):
    with pytest.raises((MeshError, MotionError)) as caught:
        write_animated_glb(tmp_path / "a.glb", *SPOILED[kind])
    assert "\n" not in str(caught.value)
    assert not os.listdir(tmp_path)
