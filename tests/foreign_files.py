"""Files of other programs, written in exactly their layout, for the readers' tests."""

import dataclasses
import pickle

import numpy as np
import pygltflib as gltf
from scipy.spatial.transform import Rotation

from eslr_jax import load_motion
from eslr_jax.pipeline.assets.catalog import find_asset
from eslr_jax.pipeline.formats.garment import read_garment_npz
from eslr_jax.pipeline.formats.obj import obj_text
from eslr_jax.pipeline.rigs.rig import body_skeleton, skeleton_motion
from eslr_jax.pose.skeleton import RiggedMesh, Skeleton, SkeletonMotion, chain_positions

SMPL_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand",
    "right_hand",
)  # fmt: skip
SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
SMPL_FROM_CMU = {
    "pelvis": "Hips", "spine1": "LowerBack", "spine2": "Spine", "spine3": "Spine1", "neck": "Neck",
    "head": "Head", "left_hip": "LeftUpLeg", "left_knee": "LeftLeg", "left_ankle": "LeftFoot",
    "left_foot": "LeftToeBase", "left_collar": "LeftShoulder", "left_shoulder": "LeftArm",
    "left_elbow": "LeftForeArm", "left_wrist": "LeftHand", "left_hand": "LeftHand",
}  # fmt: skip
SMPL_FROM_CMU |= {
    ours.replace("left", "right"): theirs.replace("Left", "Right")
    for ours, theirs in SMPL_FROM_CMU.items()
    if ours.startswith("left")
}
MIXAMO_FROM_CMU = {"LowerBack": "Spine", "Spine": "Spine1", "Spine1": "Spine2"}
Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
T_POSE_LEG = 0.835  # [m] of the person that stands in for a body of AMASS


def animate(names, parents, rest, turned, root, fps=30.0):
    """A moving skeleton with rigid bones, by its joints' turns since the rest pose and the root's path."""
    skeleton = Skeleton(tuple(names), tuple(parents), np.asarray(rest))
    return SkeletonMotion("a", skeleton, turned, chain_positions(turned, root, skeleton), fps)


def moving(body, clip="cmu_016_32"):
    """A bundled clip as the moving skeleton of a file."""
    return skeleton_motion(load_motion(clip, body=body), body)


def rigged(body, **changes):
    """A body as the reader of a file returns it."""
    mesh = RiggedMesh(
        name="hero",
        positions=np.asarray(body.rest_positions, np.float64),
        faces=np.asarray(body.faces),
        skin_weights=np.asarray(body.skin_weights, np.float64),
        skin_indices=np.asarray(body.skin_indices),
        skeleton=body_skeleton(body),
    )
    return dataclasses.replace(mesh, **changes)


def posed_joints(motion, body):
    """Where a motion puts the joints of a body [m], shape [frames, joints, 3]."""
    return skeleton_motion(motion, body).positions


def smpl_parameters(motion):
    """A motion on CMU joints as SMPL's: local rotations [frames, 24, 3] and the pelvis [frames, 3], Y up.

    SMPL's rest pose is a T-pose: arms along x, legs down.
    """
    place = {name: joint for joint, name in enumerate(motion.skeleton.joint_names)}
    rest = motion.skeleton.rest_positions
    along = {"shoulder": [1, 0, 0], "elbow": [1, 0, 0], "hip": [0, -1, 0], "knee": [0, -1, 0]}
    ends = {"shoulder": "ForeArm", "elbow": "Hand", "hip": "Leg", "knee": "Foot"}
    turned = []
    for name in SMPL_NAMES:
        side, _, word = name.rpartition("_")
        joint = place[SMPL_FROM_CMU[name]]
        align = np.eye(3)
        word = "elbow" if word in ("wrist", "hand") else word  # a hand continues its forearm
        if word in along:
            start = rest[place[SMPL_FROM_CMU[f"{side}_{word}"]]]
            bone = rest[place[side.capitalize() + ends[word]]] - start
            axis = np.array(along[word], float) * ([-1, 1, 1] if side == "right" else [1, 1, 1])
            align = Rotation.align_vectors(bone, axis)[0].as_matrix()  # the shortest turn
        turned.append(motion.rotations[:, joint] @ align)
    local = relative(np.stack(turned, axis=1), SMPL_PARENTS)
    leg = sum(
        np.linalg.norm(rest[place[b]] - rest[place[a]])
        for a, b in (("LeftUpLeg", "LeftLeg"), ("LeftLeg", "LeftFoot"))
    )
    vectors = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(*local.shape[:2], 3)
    return vectors, motion.positions[:, place["Hips"]] * T_POSE_LEG / leg


def relative(turned, parents):
    """Rotations [frames, joints, 3, 3] since the parents' from those in the world."""
    local = turned.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = np.swapaxes(turned[:, parent], 1, 2) @ turned[:, joint]
    return local


def write_amass(path, rotations, pelvis, fps, num_joints=52):
    """An AMASS file: Z up, 52 joints of SMPL-H of which 22 are SMPL's."""
    poses = np.zeros((len(rotations), num_joints, 3))
    poses[:, :22] = rotations[:, :22]
    root = Rotation.from_matrix(Z_UP_FROM_Y_UP) * Rotation.from_rotvec(rotations[:, 0])
    poses[:, 0] = root.as_rotvec()
    np.savez(
        path,
        poses=poses.reshape(len(poses), -1),
        trans=pelvis @ Z_UP_FROM_Y_UP.T,
        betas=np.zeros(16),
        gender=np.array("neutral"),
        mocap_framerate=np.array(fps),
        dmpls=np.zeros((len(poses), 8)),
    )


def write_hood(path, rotations, pelvis):
    """A motion pickle of HOOD: float32 arrays by name."""
    values = {
        "global_orient": rotations[:, 0],
        "body_pose": rotations[:, 1:24].reshape(len(rotations), 69),
        "transl": pelvis,
        "betas": np.zeros((1, 10)),
    }
    path.write_bytes(pickle.dumps({key: value.astype(np.float32) for key, value in values.items()}))


def write_vto(path, rotations, pelvis):
    """A motion pickle of the VTO dataset."""
    poses = rotations.reshape(len(rotations), 72)
    path.write_bytes(
        pickle.dumps({"pose": poses, "translation": pelvis, "shape": np.zeros((1, 10))}, protocol=2)
    )


def smpl_layout(positions, faces, weights, indices, joints, parents=SMPL_PARENTS):
    """A body at rest [m] as the arrays of a SMPL file; weights and indices are of each vertex's influences."""
    dense = np.zeros((len(positions), len(joints)))
    np.add.at(dense, (np.arange(len(positions))[:, None], indices), weights)
    tree = np.array([parents, np.arange(len(joints))], np.int64)
    tree[0, 0] = 2**32 - 1  # as the files have it
    return {
        "v_template": np.asarray(positions, np.float64),
        "f": np.asarray(faces).astype(np.uint32),
        "weights": dense / dense.sum(axis=1, keepdims=True),
        "J_regressor": joint_regressor(np.asarray(positions, np.float64), np.asarray(joints, np.float64)),
        "kintree_table": tree,
    }


def smpl_model(body, rng):
    """A part of the bundled body on SMPL's 24 joints, as the arrays of a SMPL file, with random blend shapes."""
    names = list(body.joint_names)
    faces = np.asarray(body.faces)[::40]  # all over the body
    kept, faces = np.unique(faces, return_inverse=True)
    merged = {ours: names.index(theirs) for ours, theirs in SMPL_FROM_CMU.items()}
    joints = np.asarray(body.joint_rest_positions, np.float64)[[merged[name] for name in SMPL_NAMES]]
    joints[22:] += joints[20:22] - joints[18:20]
    nearest = []
    for name in names:
        while name not in SMPL_FROM_CMU.values():
            name = names[body.parents[names.index(name)]]
        nearest.append(next(k for k, smpl in enumerate(SMPL_NAMES) if SMPL_FROM_CMU[smpl] == name))
    positions, weights, indices = (
        np.asarray(part)[kept] for part in (body.rest_positions, body.skin_weights, body.skin_indices)
    )
    return smpl_layout(positions, faces.reshape(-1, 3), weights, np.array(nearest)[indices], joints) | {
        "shapedirs": rng.normal(0.0, 0.01, (len(positions), 3, 10)),
        "posedirs": rng.normal(0.0, 0.002, (len(positions), 3, 207)),
    }


def joint_regressor(positions, joints):
    """Weights of 40 vertices around each joint that give the joint's position."""
    regressor = np.zeros((len(joints), len(positions)))
    for row, joint in enumerate(joints):
        near = np.argsort(np.linalg.norm(positions - joint, axis=1))[:40]
        system = np.vstack([(positions[near] - joint).T, np.ones(40)])
        regressor[row, near] = np.linalg.lstsq(system, np.array([0.0, 0.0, 0.0, 1.0]), rcond=None)[0]
    return regressor


class GlbWriter:
    """A skinned character as a GLB file, through pygltflib."""

    def __init__(self):
        self.document = gltf.GLTF2(asset=gltf.Asset(version="2.0"), scene=0, scenes=[gltf.Scene(nodes=[])])
        self.blob = b""

    def accessor(self, array, kind, **extra):
        array = np.ascontiguousarray(array)
        codes = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125}
        view = gltf.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=array.nbytes)
        self.blob += array.tobytes() + b"\0" * (-array.nbytes % 4)
        self.document.bufferViews.append(view)
        index = len(self.document.bufferViews) - 1
        self.document.accessors.append(
            gltf.Accessor(
                bufferView=index, componentType=codes[str(array.dtype)], count=len(array), type=kind, **extra
            )
        )
        return len(self.document.accessors) - 1

    def node(self, **values):
        self.document.nodes.append(gltf.Node(**values))
        return len(self.document.nodes) - 1

    def bytes(self):
        self.document.buffers = [gltf.Buffer(byteLength=len(self.blob))]
        self.document.set_binary_blob(self.blob)
        return b"".join(self.document.save_to_bytes())


def write_character(
    path, skeleton, positions, faces, weights, indices, *, names=None, motion=None, unit=0.01, frames=None,
    uvs=None, fps=30.0, clip="walk", mesh_name="Body",
):  # fmt: skip
    """A character as Mixamo's FBX files become in Blender: centimetres, Z up, turned and scaled by the armature.

    Args:
        path: The file.
        skeleton: Joints at rest [m], Y up.
        positions, faces, weights, indices: The mesh at rest [m], with four influences.
        names: Names of the joints.
        motion: (rotations since rest [frames, joints, 3, 3], positions [frames, joints, 3]) or None.
        unit: Metres of the file's unit.
        frames: Orientation of every joint at rest, [joints, 3, 3]; bones of real files are turned.
    """
    writer = GlbWriter()
    count = len(skeleton)
    frames = np.tile(np.eye(3), (count, 1, 1)) if frames is None else frames
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # Y up to Z up
    rest = np.tile(np.eye(4), (count, 1, 1))
    rest[:, :3, :3] = axes @ frames
    rest[:, :3, 3] = skeleton.rest_positions @ axes.T / unit
    first = len(writer.document.nodes)
    names = names or list(skeleton.joint_names)

    def local(world):
        own = world.copy()
        for joint, parent in enumerate(skeleton.parents):
            if parent >= 0:
                own[..., joint, :, :] = np.linalg.inv(world[..., parent, :, :]) @ world[..., joint, :, :]
        turned = Rotation.from_matrix(own[..., :3, :3].reshape(-1, 3, 3)).as_quat()
        return turned.reshape(*own.shape[:-2], 4), own[..., :3, 3]

    turned, moved = local(rest)
    for joint in range(count):
        children = [first + child for child, parent in enumerate(skeleton.parents) if parent == joint]
        writer.node(
            name=names[joint],
            rotation=turned[joint].tolist(),
            translation=moved[joint].tolist(),
            children=children,
        )
    bind = writer.accessor(np.linalg.inv(rest).swapaxes(1, 2).reshape(-1, 16).astype(np.float32), "MAT4")
    writer.document.skins.append(
        gltf.Skin(joints=list(range(first, first + count)), inverseBindMatrices=bind, name="skin")
    )
    attributes = gltf.Attributes(
        POSITION=writer.accessor((positions @ axes.T / unit).astype(np.float32), "VEC3"),
        JOINTS_0=writer.accessor(indices.astype(np.uint8), "VEC4"),
        WEIGHTS_0=writer.accessor(weights.astype(np.float32), "VEC4"),
    )
    if uvs is not None:
        attributes.TEXCOORD_0 = writer.accessor(uvs.astype(np.float32), "VEC2")
    primitive = gltf.Primitive(
        attributes=attributes, indices=writer.accessor(faces.reshape(-1).astype(np.uint32), "SCALAR")
    )
    writer.document.meshes.append(gltf.Mesh(name=mesh_name, primitives=[primitive]))
    mesh = writer.node(name=mesh_name, mesh=0, skin=0)
    roots = [first + joint for joint, parent in enumerate(skeleton.parents) if parent < 0]
    armature = writer.node(
        name="Armature",
        scale=[unit] * 3,
        rotation=Rotation.from_matrix(axes.T).as_quat().tolist(),
        children=[*roots, mesh],
    )
    writer.document.scenes[0].nodes.append(armature)
    if motion is not None:
        turns, places = motion
        world = np.tile(np.eye(4), (len(turns), count, 1, 1))
        world[..., :3, :3] = axes @ turns @ frames
        world[..., :3, 3] = places @ axes.T / unit
        turned, moved = local(world)
        times = writer.accessor(
            (np.arange(len(turns)) / fps).astype(np.float32), "SCALAR", min=[0.0], max=[1.0]
        )
        animation = gltf.Animation(name=clip)
        for joint in range(count):
            for what, values in (("rotation", turned), ("translation", moved)):
                output = writer.accessor(values[:, joint].astype(np.float32), f"VEC{values.shape[2]}")
                animation.samplers.append(gltf.AnimationSampler(input=times, output=output))
                target = gltf.AnimationChannelTarget(node=first + joint, path=what)
                index = len(animation.samplers) - 1
                animation.channels.append(gltf.AnimationChannel(sampler=index, target=target))
        writer.document.animations.append(animation)
    path.write_bytes(writer.bytes())


def write_bvh(path, motion, *, names=None, unit=1.0, axes=None, order="ZXY"):
    """A BVH file of a moving skeleton with rigid bones.

    Args:
        path: The file.
        motion: A SkeletonMotion.
        names: Other names for the joints.
        unit: Units of the file per unit of the motion.
        axes: Rotation to the file's axes.
        order: Of the Euler angles.
    """
    axes = np.eye(3) if axes is None else axes
    skeleton, names = motion.skeleton, names or list(motion.skeleton.joint_names)
    rest = unit * skeleton.rest_positions @ axes.T
    local = relative(axes @ motion.rotations @ axes.T, skeleton.parents)
    lines, columns = ["HIERARCHY"], []

    def visit(joint, depth):
        parent = skeleton.parents[joint]
        offset = rest[joint] - (rest[parent] if parent >= 0 else 0)
        tabs = "\t" * depth
        channels = [f"{axis}rotation" for axis in order]
        if parent < 0:
            channels = ["Xposition", "Yposition", "Zposition", *channels]
            columns.append(unit * motion.positions[:, joint] @ axes.T)
        angles = Rotation.from_matrix(local[:, joint]).as_euler(order, degrees=True)
        columns.append(angles)
        lines.extend(
            [
                f"{tabs}{'ROOT' if parent < 0 else 'JOINT'} {names[joint]}",
                tabs + "{",
                f"{tabs}\tOFFSET " + " ".join(f"{x:.8f}" for x in offset),
                f"{tabs}\tCHANNELS {len(channels)} " + " ".join(channels),
            ]
        )
        children = [child for child, above in enumerate(skeleton.parents) if above == joint]
        for child in children:
            visit(child, depth + 1)
        if not children:
            lines.extend([tabs + "\tEnd Site", tabs + "\t{", f"{tabs}\t\tOFFSET 0 0 0", tabs + "\t}"])
        lines.append(tabs + "}")

    visit(0, 0)
    table = np.concatenate(columns, axis=1)
    lines += ["MOTION", f"Frames: {len(table)}", f"Frame Time: {1 / motion.fps:.8f}"]
    lines += [" ".join(f"{x:.8f}" for x in row) for row in table]
    path.write_text("\n".join(lines) + "\n")


def write_walker(character, shirt, body, *, size=1.0, start_poses=0):
    """Write the bundled body as a character of Mixamo becomes in Blender, walking, and its T-shirt as OBJ.

    Args:
        character: The GLB file.
        shirt: The OBJ file [m].
        body: The bundled body.
        size: Factor on all lengths of the character.
        start_poses: Frames of its rest pose before the walk, from which it jumps.
    """
    motion = moving(body)
    skeleton = body_skeleton(body)
    skeleton = dataclasses.replace(skeleton, rest_positions=size * skeleton.rest_positions)
    turns = np.concatenate([np.tile(np.eye(3), (start_poses, len(skeleton), 1, 1)), motion.rotations[:8]])
    away = body_skeleton(body).rest_positions + np.array([1.5, 0.0, 0.0])
    places = np.concatenate([np.tile(away, (start_poses, 1, 1)), motion.positions[:8]])
    order = np.argsort(-np.asarray(body.skin_weights), axis=1)[:, :4]
    weights = np.take_along_axis(np.asarray(body.skin_weights, np.float64), order, axis=1)
    write_character(
        character,
        skeleton,
        size * np.asarray(body.rest_positions, np.float64),
        np.asarray(body.faces),
        weights / weights.sum(axis=1, keepdims=True),
        np.take_along_axis(np.asarray(body.skin_indices), order, axis=1),
        names=[f"mixamorig:{MIXAMO_FROM_CMU.get(name, name)}" for name in body.joint_names],
        motion=(turns, size * places),
        frames=Rotation.from_rotvec(np.random.default_rng(0).normal(size=(31, 3))).as_matrix(),
        fps=motion.fps,
    )
    garment = read_garment_npz(find_asset("garment", "tshirt_1k"))
    shirt.write_text(obj_text("shirt", garment.rest_positions, garment.faces))
