"""A pool of trajectories that training keeps alive: the network learns on the states it makes itself."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.config import TrainConfig
from eslr_jax.contact.nearest import clear_of_body
from eslr_jax.fabric.materials import COTTON
from eslr_jax.networks.features import BENDING_RANGE, DENSITY_RANGE, LAME_LAMBDA_RANGE, LAME_MU_RANGE
from eslr_jax.simulation.scene import initial_state
from eslr_jax.training.data import FPS, TrainingData
from eslr_jax.types import ClothState, Material


@struct.dataclass
class Slot:
    """One live trajectory; stacked along a leading axis in the pool."""

    state: ClothState
    frame: Int[Array, ""]  # index into the joined clips
    before: Int[Array, ""]  # of the frame before; the same one where the body stands still
    yaw: Float[Array, ""]  # turn of the whole scene [rad]
    girth: Float[Array, ""]  # by which the body is thicker than the bundled one [m]
    age: Int[Array, ""]  # frames since the start
    material: Material
    is_done: Bool[Array, ""]  # start anew before the next use
    # coefficients of the body's shape [standard deviations]; None: all trajectories have the same body
    shape: Float[Array, " shapes"] | None = None


def empty_pool(data: TrainingData, slots_per_garment: int, config: TrainConfig) -> Slot:
    """Return a pool whose slots all start anew at their first use."""
    count = data.num_garments * slots_per_garment
    start = partial(start_trajectory, config=config)
    slot = jax.eval_shape(start, jax.random.key(0), data, jnp.int32(0))
    # Every leaf its own buffer: the state is donated.
    pool = jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), slot)
    return pool.replace(is_done=jnp.ones(count, bool))


def start_trajectory(key: Array, data: TrainingData, index: Int[Array, ""], config: TrainConfig) -> Slot:
    """Start at a random frame of a random clip on a body of random shape: skinned, noisy, pushed out of it.

    `index` is the garment's. `config`, static, says how large noise, girth and shapes are, and how often a
    fabric is random and the body stands still.
    """
    keys = jax.random.split(key, 7)
    garment = data.garment(index)
    frame = data.start_frames[jax.random.randint(keys[0], (), 0, data.start_frames.shape[0])]
    yaw = jax.random.uniform(keys[1], maxval=2 * jnp.pi)
    shape = None
    if data.shapes is not None:
        bound, count = config.shape_range, data.shapes.surface.shape[-1]
        shape = jax.random.uniform(keys[5], (count,), minval=-bound, maxval=bound)
    is_still = jax.random.uniform(keys[6]) < config.still_probability
    # A clip's first frame has none before it: there the clip turns round.
    before = jnp.where(is_still, frame, jnp.where(data.is_same_clip(frame - 1, frame), frame - 1, frame + 1))
    frames = (frame, data.next_frame(frame, before))
    transforms, later = (data.transforms(k, yaw, shape) for k in frames)
    skinned = data.skinned(index, transforms, shape)
    velocity = (data.skinned(index, later, shape) - skinned) * FPS
    noise = config.noise * jax.random.normal(keys[2], skinned.shape)
    position = skinned + jnp.where(garment.is_pinned[:, None], 0.0, noise)
    girth = jax.random.uniform(keys[4], minval=-config.girth, maxval=config.girth)
    body = data.body(transforms, girth, shape)
    position = clear_of_body(position, body, data.surface, garment)
    state = initial_state(position, velocity)
    material = sample_material(keys[3], config.material_probability)
    return Slot(state, frame, before, yaw, girth, jnp.int32(0), material, jnp.zeros((), bool), shape)


def turn_round(key: Array, slot: Slot, data: TrainingData, probability: float) -> Slot:
    """Return a trajectory whose body, with `probability`, goes back where it came from, at once and as fast.

    Cloth that flies on is stretched then, as by a clip's end. It is rare in clips, so networks tear there.
    """
    is_turned = jax.random.uniform(key) < probability
    onward = data.next_frame(slot.frame, slot.before)
    return slot.replace(before=jnp.where(is_turned, onward, slot.before))


def sample_material(key: Array, probability: float) -> Material:
    """Return a random fabric from HOOD's training ranges with `probability`, else cotton."""
    keys = jax.random.split(key, 5)

    def uniform(k, bounds):
        return jax.random.uniform(k, minval=bounds[0], maxval=bounds[1])

    def log_uniform(k, bounds):
        return jnp.exp(uniform(k, (jnp.log(bounds[0]), jnp.log(bounds[1]))))

    drawn = Material(
        density=uniform(keys[0], DENSITY_RANGE),
        lame_mu=log_uniform(keys[1], LAME_MU_RANGE),
        lame_lambda=uniform(keys[2], LAME_LAMBDA_RANGE),
        bending_stiffness=log_uniform(keys[3], BENDING_RANGE),
        thickness=jnp.float32(COTTON.thickness),
    )
    is_random = jax.random.uniform(keys[4]) < probability
    return jax.tree.map(lambda new, old: jnp.where(is_random, new, old).astype(jnp.float32), drawn, COTTON)
