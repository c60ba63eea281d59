"""An animated GLB, played back by an evaluator of our own, shows the positions that were written."""

import os

import numpy as np
import pygltflib as gltf
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from eslr_jax.errors import MeshError, MotionError
from eslr_jax.io.gltf import AnimatedMesh, write_animated_glb
from eslr_jax.io.gltf_builder import vertex_normals
from eslr_jax.io.gltf_skin import SkinnedMesh

TIMESTEP = 1 / 30
TOLERANCE = 1e-6  # [m]: float32 positions within two metres of the origin, skinned through a few joints
_TYPES = {
    gltf.FLOAT: np.float32,
    gltf.UNSIGNED_BYTE: np.uint8,
    gltf.UNSIGNED_SHORT: np.uint16,
    gltf.UNSIGNED_INT: np.uint32,
}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Player:
    """Evaluates a GLB at a time, as the glTF 2.0 specification says."""

    def __init__(self, path):
        self.document = gltf.GLTF2().load(str(path))
        self.blob = self.document.binary_blob()

    def read(self, index):
        accessor = self.document.accessors[index]
        offset = self.document.bufferViews[accessor.bufferView].byteOffset
        width = _WIDTHS[accessor.type]
        values = np.frombuffer(self.blob, _TYPES[accessor.componentType], accessor.count * width, offset)
        return values.reshape(-1, width) if width > 1 else values

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
                self.sample(time, index, "rotation"),
                self.sample(time, index, "translation"),
            )
            rotation = node.rotation if rotation is None else rotation
            translation = node.translation if translation is None else translation
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


def make_body(num_frames=5, num_influences=6):
    """A sphere on three joints in a chain, with random poses."""
    sphere = trimesh.creation.icosphere(subdivisions=2)
    rng = np.random.default_rng(1)
    weights = rng.dirichlet(np.ones(num_influences), size=len(sphere.vertices))
    indices = rng.permuted(np.tile(np.arange(8), (len(sphere.vertices), 1)), axis=1)[:, :num_influences]
    # Small turns between frames: a quaternion's linear blend and slerp agree at key frames only.
    turns = np.cumsum(0.2 * rng.normal(size=(num_frames, 8, 3)), axis=0)
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(num_frames, 8, 3, 3)
    transforms = np.concatenate([rotations, 0.2 * rng.normal(size=(num_frames, 8, 3, 1))], axis=-1)
    return SkinnedMesh(sphere.vertices, np.asarray(sphere.faces), weights, indices, transforms)


def pose(body, frame):
    matrices = np.asarray(body.joint_transforms)[frame][body.skin_indices]
    moved = np.einsum("vkab,vb->vka", matrices[..., :3], body.rest_positions) + matrices[..., 3]
    return np.einsum("vk,vka->va", body.skin_weights, moved)


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
        body = SkinnedMesh(
            **{**vars(body), "joint_rest_positions": joints, "parents": [-1, 0, 1, 2, 0, 4, 5, -1]}
        )
    write_animated_glb(tmp_path / "a.glb", [make_cloth()], TIMESTEP, skinned_body=body)
    player = Player(tmp_path / "a.glb")
    for frame in range(5):
        shown = player.positions("body", frame * TIMESTEP)
        np.testing.assert_allclose(shown, pose(body, frame), atol=2 * TOLERANCE)


def test_glb_quaternions_never_take_the_long_way_round(tmp_path):
    body = make_body(num_frames=60)
    turns = np.linspace(0, 4 * np.pi, 60)[:, None] * np.array([0.0, 1.0, 0.0])
    transforms = np.zeros((60, 8, 3, 4))
    transforms[..., :3] = Rotation.from_rotvec(turns).as_matrix()[:, None]
    write_animated_glb(
        tmp_path / "a.glb",
        [],
        TIMESTEP,
        skinned_body=SkinnedMesh(**{**vars(body), "joint_transforms": transforms}),
    )
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
    write_animated_glb(
        tmp_path / "a.glb",
        [make_cloth(num_frames=1)],
        TIMESTEP,
        skinned_body=make_body(num_frames=1),
        has_normals=False,
    )
    player = Player(tmp_path / "a.glb")
    assert not player.document.animations
    np.testing.assert_allclose(
        player.positions("body", 0.0), pose(make_body(num_frames=1), 0), atol=TOLERANCE
    )


def test_glb_accessors_carry_the_bounds_and_alignment_that_gltf_demands(tmp_path):
    write_animated_glb(tmp_path / "a.glb", [make_cloth()], TIMESTEP, skinned_body=make_body())
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


def with_change(mesh, **change):
    return type(mesh)(**{**vars(mesh), **change})


@pytest.mark.parametrize(
    ("cloth", "body", "timestep", "error"),
    [
        (make_cloth(num_frames=4), make_body(), TIMESTEP, MotionError),
        (make_cloth(num_frames=0), None, TIMESTEP, MotionError),
        (make_cloth(), None, 0.0, MotionError),
        (with_change(make_cloth(), faces=np.array([[0, 1, 9999]])), None, TIMESTEP, MeshError),
        (with_change(make_cloth(), faces=np.zeros((0, 3), int)), None, TIMESTEP, MeshError),
        (with_change(make_cloth(), positions=np.full((5, 162, 3), np.nan)), None, TIMESTEP, MeshError),
        (with_change(make_cloth(), positions=np.zeros((5, 3))), None, TIMESTEP, MeshError),
        (
            make_cloth(),
            with_change(make_body(), joint_transforms=np.ones((5, 8, 3, 4))),
            TIMESTEP,
            MotionError,
        ),
        (make_cloth(), with_change(make_body(), parents=[-1]), TIMESTEP, MotionError),
        (make_cloth(), with_change(make_body(), joint_names=["root"]), TIMESTEP, MotionError),
        (make_cloth(), with_change(make_body(), skin_weights=np.ones((162, 6))), TIMESTEP, MeshError),
        (make_cloth(), with_change(make_body(), skin_indices=np.full((162, 6), 8)), TIMESTEP, MeshError),
        (make_cloth(), with_change(make_body(), skin_indices=np.zeros((162, 2), int)), TIMESTEP, MeshError),
    ],
)
def test_glb_names_what_is_wrong_and_writes_nothing(tmp_path, cloth, body, timestep, error):
    with pytest.raises(error) as caught:
        write_animated_glb(tmp_path / "a.glb", [cloth], timestep, skinned_body=body)
    assert "\n" not in str(caught.value)
    assert not os.listdir(tmp_path)
