"""Baselines that see the body's motion and not the cloth: one network a garment, trained on energies alone.

    python experiments/paper posed GARMENT pbns|snug|snug-m [--out FOLDER] [--steps 2000] [--smoke]

They predict displacements of the rest mesh, which the skin weights then carry along. What each keeps and lacks:

- pbns: four layers of 32 and a basis of displacements, one pose at a time. Its own springs and hinges are
  replaced by our energies, without inertia and friction: the floor that static poses leave.
- snug: four GRUs of 256 and a linear layer. Its energies are ours, without friction. Windows of three frames,
  hidden states that begin at random, and inertia on the last frame alone follow GAPS, as SNUG's own training was
  not published.
- snug-m: snug that also reads the fabric, which changes from window to window. It stands in for MSN (Liu et al.
  2023), of which neither code nor text was found.

All read rotations relative to the root instead of SMPL's axis-angles, and no body shape.
Source: Bertiche et al. 2021 (PBNS); Santesteban et al. 2022 (SNUG); Chen et al. 2024 (GAPS).
"""

import dataclasses
import time
from functools import partial
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax.config import TrainConfig
from eslr_jax.fabric.materials import COTTON
from eslr_jax.networks.features import DENSITY_SCALE, material_inputs
from eslr_jax.networks.network import System
from eslr_jax.pipeline.assets import load_body, load_garment, load_motion, split_clips
from eslr_jax.pose import lbs
from eslr_jax.simulation.scene import initial_state
from eslr_jax.solver.potential import potential_terms
from eslr_jax.training.data import TrainingData, build_training_data
from eslr_jax.training.pool import FPS, Slot, sample_material
from eslr_jax.training.step import slot_problem
from eslr_jax.types import Garment, Material
from paper.supervised import fit, options, read_archive, write_archive

SYSTEMS = ("pbns", "snug", "snug-m")
WINDOW = 4  # frames; the first only tells where the others' contacts are searched
_BATCH = 16  # windows
_UNIT = 0.1  # [J], of the loss
_OFFSET = 0.01  # [m], of a displacement per unit of output
_INPUTS = ("mean", "deviation", "joints")  # of a network, beside its weights
_FEWEST = 0.05  # a joint counts that carries a vertex by at least this weight


class Displacements(nn.Module):
    """From features of consecutive poses to displacements of the rest mesh."""

    system: str
    num_vertices: int

    @nn.compact
    def __call__(
        self, features: Float[Array, "windows frames features"], hidden: Float[Array, "layers windows 256"]
    ) -> Float[Array, "windows frames vertices 3"]:
        """Return displacements [m]; `hidden` is what the GRUs remember of the frames before."""
        x = features
        for layer in range(4):
            if self.system == "pbns":
                x = nn.relu(nn.Dense(32)(x))
            else:
                x = nn.RNN(nn.GRUCell(256))(x, initial_carry=hidden[layer])
        small = nn.initializers.variance_scaling(0.01, "fan_in", "normal")
        out = nn.Dense(3 * self.num_vertices, use_bias=self.system != "pbns", kernel_init=small)(x)
        return _OFFSET * out.reshape((*out.shape[:-1], self.num_vertices, 3))


@struct.dataclass
class PosedNetwork:
    """A trained network and what its input needs."""

    params: Any
    mean: Float[Array, " features"]
    deviation: Float[Array, " features"]
    joints: Int[Array, " joints"]  # whose rotations are read
    system: str = struct.field(pytree_node=False)


def carried_joints(garment: Garment, num_joints: int) -> Int[Array, " joints"]:
    """Return the joints that carry some of the garment."""
    carried = np.zeros(num_joints)
    np.maximum.at(carried, np.asarray(garment.skin_indices).ravel(), np.asarray(garment.skin_weights).ravel())
    return jnp.asarray(np.flatnonzero(carried >= _FEWEST))


def pose_features(
    transforms: Float[Array, "frames joints 3 4"], joints: Int[Array, " read"], *, is_static: bool
) -> Float[Array, "frames features"]:
    """Return what is seen of a body's motion; turning and shifting the whole scene does not change it.

    Two columns of every joint's rotation relative to the root, and the vertical as the root sees it. Unless
    `is_static`, also the root's turn since the last frame and the velocity [m/s] of the point that it carries.
    """
    turned, moved = transforms[..., :3], transforms[:, 0, :, 3]
    root = turned[:, 0]
    relative = jnp.einsum("fba,fjbc->fjac", root, turned[:, joints])[..., :2]
    parts = [relative.reshape((len(root), -1)), root[:, 1]]
    if not is_static:
        before = jnp.maximum(jnp.arange(len(root)) - 1, 0)
        turn = jnp.einsum("fba,fbc->fac", root[before], root)[..., :2].reshape((len(root), 6))
        velocity = jnp.einsum("fba,fb->fa", root, moved - moved[before]) * FPS
        parts += [turn, velocity]
    return jnp.concatenate(parts, axis=1)


def displace(
    network: PosedNetwork, garment: Garment, transforms: Float[Array, "frames joints 3 4"]
) -> Float[Array, "frames vertices 3"]:
    """Return the garment's positions on a moving body [m], shape [frames, vertices, 3]; cotton."""
    features = _inputs(network, garment, transforms, COTTON)
    last = network.params["params"]["Dense_4" if network.system == "pbns" else "Dense_0"]
    module = Displacements(network.system, last["kernel"].shape[1] // 3)
    return carry(garment, module.apply(network.params, features[None], jnp.zeros((4, 1, 256)))[0], transforms)


def carry(
    garment: Garment,
    offsets: Float[Array, "frames vertices 3"],
    transforms: Float[Array, "frames joints 3 4"],
) -> Float[Array, "frames vertices 3"]:
    """Return the displaced rest mesh skinned to every frame [m]; padded vertices are not displaced."""
    missing = garment.rest_positions.shape[0] - offsets.shape[1]
    offsets = jnp.pad(offsets, ((0, 0), (0, missing), (0, 0)))

    def one(frame: tuple[Array, Array]) -> Array:
        offset, posed = frame
        return lbs.skin(garment.rest_positions + offset, garment.skin_weights, garment.skin_indices, posed)

    return jax.lax.map(one, (offsets, transforms))


def _inputs(
    network: PosedNetwork, garment: Garment, transforms: Float[Array, "frames joints 3 4"], material: Material
) -> Float[Array, "frames features"]:
    """Return standardised features of a motion, with the fabric's for snug-m."""
    features = pose_features(transforms, network.joints, is_static=network.system == "pbns")
    features = (features - network.mean[None]) / network.deviation[None]
    if network.system != "snug-m":
        return features
    # Bending stiffness, mu and lambda over HOOD's ranges, and the logarithm of the density.
    fabric = jnp.append(material_inputs(garment, material)[0], jnp.log(material.density / DENSITY_SCALE))
    return jnp.concatenate([features, jnp.broadcast_to(fabric, (len(features), 4))], axis=1)


@dataclasses.dataclass(frozen=True)
class Replay(System):
    """A network whose weights are the positions of all frames: what sees no cloth is known beforehand."""

    def apply(self, params: Any, problem: Any, state: Any, /) -> Any:
        """Return the positions of the next frame."""
        return params[state.frame + 1]


def train(system: str, name: str, steps: int, seed: int = 0) -> tuple[PosedNetwork, list[float]]:
    """Train a network for a garment on the bundled training clips; return it and its losses [0.1 J]."""
    garment = load_garment(name)
    data = build_training_data([garment], load_body(), [load_motion(clip) for clip in split_clips("train")])
    joints = carried_joints(garment, data.joint_transforms.shape[1])
    seen = pose_features(data.joint_transforms, joints, is_static=system == "pbns")
    is_inside = data.frames_left[:-1] > 0  # the joined clips jump where one ends
    seen = seen[1:][np.asarray(is_inside)]
    network = PosedNetwork(None, seen.mean(axis=0), jnp.maximum(seen.std(axis=0), 1e-3), joints, system)
    module = Displacements(system, garment.rest_positions.shape[0])
    width = seen.shape[1] + (4 if system == "snug-m" else 0)
    params = module.init(jax.random.key(seed), jnp.zeros((1, WINDOW, width)), jnp.zeros((4, 1, 256)))
    # Last frames of windows that lie within a clip.
    ends = np.flatnonzero(np.asarray(data.frames_left)[: 1 - WINDOW] >= WINDOW - 1) + WINDOW - 1
    draw = np.random.default_rng(seed)

    def windows(_: int) -> tuple[PosedNetwork, TrainingData, np.ndarray]:
        return network, data, draw.choice(ends, _BATCH)

    params, losses = fit(partial(_loss_and_gradient, module), params, windows, steps, seed)
    return network.replace(params=params), losses


def _loss_and_gradient(
    module: Displacements,
    params: Any,
    batch: tuple[PosedNetwork, TrainingData, Int[Array, " windows"]],
    key: Array,
) -> tuple[Float[Array, ""], Any]:
    """Return the loss of a batch of windows, given by their last frames, and its gradient.

    An energy's slope is taken frame by frame, and pulled back through all positions at once.
    """
    network, data, frames = batch
    garment = data.garment(jnp.int32(0))
    keys = jax.random.split(key, _BATCH + 1)
    hidden = 0.1 * jax.random.normal(keys[0], (4, _BATCH, 256))  # GAPS
    probability = 1.0 if network.system == "snug-m" else 0.0
    materials = jax.vmap(partial(sample_material, probability=probability))(keys[1:])
    windows = frames[:, None] + jnp.arange(1 - WINDOW, 1)[None]
    transforms = data.joint_transforms[windows]

    def positions_of(params):
        features = jax.vmap(lambda motion, fabric: _inputs(network, garment, motion, fabric))(
            transforms, materials
        )
        offsets = module.apply(params, features, hidden)
        return jax.lax.map(lambda window: carry(garment, *window), (offsets, transforms))

    positions, pull_back = jax.vjp(positions_of, params)

    def slope_of(sample):
        """Return an energy and its slope: that of a still cloth, and of inertia too for a window's last frame."""
        (before, position, velocity), frame, material, is_last = sample
        zero = jnp.zeros(())
        state = initial_state(before, jnp.where(is_last, velocity, 0.0))
        slot = Slot(state, frame - 1, frame - 2, zero, zero, jnp.int32(0), material, jnp.zeros((), bool))
        problem = slot_problem(slot, data, jnp.int32(0), TrainConfig(model=Replay()))

        def loss(position):
            terms = potential_terms(position, problem)
            inertia = 0.0 if network.system == "pbns" else jnp.where(is_last, terms["inertia"], 0.0)
            still = sum(terms[name] for name in ("stretch", "bending", "gravity", "collision"))
            return (still + inertia) / _UNIT

        return jax.value_and_grad(loss)(position)

    before, after = positions[:, :-1], positions[:, 1:]
    velocities = jnp.broadcast_to((positions[:, -2:-1] - positions[:, -3:-2]) * FPS, after.shape)
    counted = windows[:, 1:]
    samples = (
        (before, after, velocities),
        counted.astype(jnp.int32),
        jax.tree.map(lambda leaf: jnp.repeat(leaf[:, None], WINDOW - 1, axis=1), materials),
        jnp.broadcast_to(counted == windows[:, -1:], counted.shape),
    )
    flat = jax.tree.map(lambda leaf: leaf.reshape((-1, *leaf.shape[2:])), samples)
    losses, slopes = jax.lax.map(slope_of, flat)
    cotangent = jnp.zeros_like(positions).at[:, 1:].set(slopes.reshape(after.shape) / len(losses))
    return jnp.mean(losses), pull_back(cotangent)[0]


def write_network(network: PosedNetwork, path: Path, training: dict[str, Any]) -> None:
    """Write a network as an npz archive, and how it was trained beside it."""
    inputs = {name: getattr(network, name) for name in _INPUTS}
    write_archive(path, {**network.params, **inputs}, {"system": network.system, "training": training})


def read_network(path: Path) -> tuple[PosedNetwork, dict[str, Any]]:
    """Return a network that `write_network` wrote, and its training record."""
    arrays, record = read_archive(path)
    inputs = {name: arrays.pop(name) for name in _INPUTS}
    return PosedNetwork(arrays, **inputs, system=record["system"]), record["training"]


def main() -> None:
    parser = options(__doc__, 2000)
    parser.add_argument("system", choices=SYSTEMS)
    chosen = parser.parse_args()
    if chosen.smoke:
        chosen.steps = 2
    began = time.process_time()
    network, losses = train(chosen.system, chosen.garment, chosen.steps, chosen.seed)
    training = {
        "steps": chosen.steps,
        "core_hours": (time.process_time() - began) / 3600,
        "final_loss_j": float(np.mean(losses[-100:])) * _UNIT,
    }
    write_network(network, chosen.out / f"{chosen.system}_{chosen.garment}.npz", training)
