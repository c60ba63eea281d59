"""MAT on our own data: a transformer over a garment's faces that steps the cloth, frame after frame.

    python experiments/paper mat GARMENT [--out FOLDER] [--steps 2000] [--smoke]

It keeps faces as tokens with the published features of two frames, one token for the whole, heads that average
along geodesics, the change of every face's frame as output, the Poisson solve that joins faces, and the
least-squares step off the body; supervised, one frame at a time, with noise on its inputs. It lacks seven eighths
of the width, half the layers and of the feed-forward parts' width, the scale of encoded inputs, attention by
softmax (linear attention takes a tenth of the time), the turn of the nearest body face about its normal, and
singular values; the Laplacian of the step off the body is the rest mesh's. All it sees is turned to the garment's
heading.
Source: Li et al. 2024 (MAT), whose published run names no flags; weights of losses are ours.
"""

import dataclasses
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.contact.nearest import CONTACT_RADIUS, find_contacts
from eslr_jax.networks.attention import linear_attention, orthogonal_projection, relu_features
from eslr_jax.networks.network import System
from eslr_jax.terms import Collision
from eslr_jax.terms.term import FrameProblem
from eslr_jax.types import ClothState, Contacts, Scene
from paper.mat_space import (
    Change,
    Space,
    change_between,
    face_frames,
    heading,
    prepare_space,
    rebuild,
    step_off,
)
from paper.supervised import Truth, fit, load_truth, options, read_archive, write_archive

_WIDTH, _LAYERS, _HEADS = 64, 3, 4  # MAT: 512, 6, 8
_GEODESIC_HEADS = 1  # of the heads; MAT: 2 of 8
_NOISE = 0.1  # standard deviations, on the inputs
_BATCH = 4
_LEAST = 1e-6  # deviation of a column


class Seen(NamedTuple):
    """What the network is told of a frame, in the garment's heading."""

    faces: Float[Array, "faces 34"]
    whole: Float[Array, " 6"]  # mean displacements of the cloth and of the body near it [m]


@struct.dataclass
class Weights:
    """Weights, means and deviations, and the garment that they are applied to."""

    params: Any
    seen_mean: Seen  # of faces with a leading axis of one
    seen_deviation: Seen
    change_mean: Change
    change_deviation: Change
    space: Any = None  # a `Space`, where the network is applied


class Transformer(nn.Module):
    """From what faces see to how they change, both standardised."""

    @nn.compact
    def __call__(
        self, seen: Seen, geodesic: Float[Array, "faces faces"], mask: Float[Array, " faces"]
    ) -> Change:
        """Return the change; faces whose mask is zero are attended by none."""
        faces, whole = nn.Dense(_WIDTH)(seen.faces), nn.Dense(_WIDTH)(seen.whole)
        x = jnp.concatenate([faces, whole[None]])
        is_token = jnp.append(mask > 0, True)
        for layer in range(_LAYERS):
            x = nn.LayerNorm()(x + self._attend(x, geodesic, is_token, layer))
            x = nn.LayerNorm()(x + nn.Dense(_WIDTH)(nn.relu(nn.Dense(2 * _WIDTH)(x))))
        return Change(nn.Dense(9, name="faces")(x[:-1]), nn.Dense(3, name="whole")(x[-1]))

    def _attend(self, x: Array, geodesic: Array, is_token: Array, layer: int) -> Array:
        """Return every token's mix of all; the first channels are a mean along geodesics instead (MAT)."""
        size = _WIDTH // _HEADS
        directions = jnp.asarray(orthogonal_projection(4 * size, size, seed=layer), x.dtype)
        q, k, v = (nn.Dense(_WIDTH)(x).reshape((-1, _HEADS, size)) for _ in range(3))

        def head(q: Array, k: Array, v: Array) -> Array:
            return linear_attention(*relu_features(q, k, directions), v, is_token)

        mixed = jax.vmap(head, in_axes=1, out_axes=1)(q, k, v).reshape((-1, _WIDTH))
        mixed = nn.Dense(_WIDTH)(mixed)
        own = _GEODESIC_HEADS * size
        return mixed.at[:-1, :own].set(geodesic @ x[:-1, :own])


@dataclasses.dataclass(frozen=True)
class Mat(System):
    """The stepper's network; its weights are `Weights` with a space."""

    def apply(self, params: Weights, problem: FrameProblem, state: ClothState, /) -> Any:
        """Return positions at t + 1 [m]."""
        contacts = problem.data_of(Collision).nearest
        turn = heading(state.position, params.space)
        step = problem.timestep * state.velocity
        seen = observe(state.position, step, contacts, params.space, turn)
        moved = rebuild(predict(params, seen), state.position, params.space, turn)
        return step_off(moved, contacts, params.space)


def observe(
    position: Float[Array, "vertices 3"],
    step: Float[Array, "vertices 3"],
    contacts: Contacts,
    space: Space,
    turn: Float[Array, "3 3"],
) -> Seen:
    """Return what the network is told of positions at t, of the step since t - 1 [m] and of contacts."""
    garment = space.garment
    # Rows of vectors are turned back by a product from the right.
    drift, swing = contacts.next_points - contacts.points, contacts.next_normals - contacts.normals
    arrows = (position, step, drift, contacts.normals, swing)
    x, moved, body, normals, turned = (rows @ turn for rows in arrows)
    is_real = garment.vertex_mask[:, None]
    now, before = (face_frames(y, garment) @ space.inverse_frames for y in (x, x - moved))
    distance = jnp.clip(contacts.distances, -CONTACT_RADIUS, CONTACT_RADIUS)[:, None]
    own = x - jnp.mean(x, axis=0, where=is_real, keepdims=True)
    at_vertices = [own, moved, distance, normals, body, turned]
    at_faces = jnp.mean(jnp.concatenate(at_vertices, axis=1)[garment.faces], axis=1)
    faces = jnp.concatenate([now.reshape((-1, 9)), (now - before).reshape((-1, 9)), at_faces], axis=1)
    near = is_real & contacts.is_near[:, None]
    pull = jnp.sum(jnp.where(near, body, 0.0), axis=0) / jnp.maximum(jnp.sum(near, dtype=body.dtype), 1.0)
    return Seen(faces, jnp.append(jnp.mean(moved, axis=0, where=is_real), pull))


def predict(network: Weights, seen: Seen) -> Change:
    """Return the change of a frame."""
    scaled = standardise(seen, network.seen_mean, network.seen_deviation)
    change = Transformer().apply(network.params, scaled, network.space.geodesic, network.space.face_mask)
    return jax.tree.map(
        lambda x, mean, deviation: mean + deviation * x, change, network.change_mean, network.change_deviation
    )


def standardise(values: Any, mean: Any, deviation: Any) -> Any:
    """Return values in deviations from their means."""
    return jax.tree.map(lambda x, centre, spread: (x - centre) / spread, values, mean, deviation)


def loss(network: Weights, seen: Seen, change: Change, key: Array) -> Float[Array, ""]:
    """Return the mean error of a frame in standard deviations; both arguments are standardised."""
    keys = jax.random.split(key)
    noisy = Seen(*(x + _NOISE * jax.random.normal(k, x.shape) for x, k in zip(seen, keys, strict=True)))
    mask = network.space.face_mask
    found: Any = Transformer().apply(network.params, noisy, network.space.geodesic, mask)
    of_faces = jnp.mean(jnp.abs(found.faces - change.faces), axis=0, where=mask[:, None] > 0)
    return jnp.mean(of_faces) + jnp.mean(jnp.abs(found.whole - change.whole))


@jax.jit
def _pairs(positions: Float[Array, "frames vertices 3"], scene: Scene, space: Space) -> tuple[Seen, Change]:
    """Return inputs and targets of every frame of a rollout but the first."""
    body = scene.body
    assert body is not None

    def pair(frame: tuple[Array, ...]) -> tuple[Seen, Change]:
        before, now, after, bodies, next_bodies = frame
        contacts = find_contacts(now, bodies, next_bodies, body.surface, space.garment.vertex_blocks)
        turn = heading(now, space)
        return observe(now, now - before, contacts, space, turn), change_between(now, after, space, turn)

    tracks = (positions[:-2], positions[1:-1], positions[2:], body.positions[1:-1], body.positions[2:])
    return jax.lax.map(pair, tracks)


def train(truth: Truth, steps: int, seed: int = 0) -> tuple[Weights, dict[str, Any]]:
    """Train on a garment's simulated rollouts; return the network and how it was trained."""
    began = time.process_time()
    space = prepare_space(truth.worn[0].scene.garment)
    found = [
        jax.device_get(_pairs(positions, worn.scene, space))
        for positions, worn in zip(truth.positions, truth.worn, strict=True)
    ]
    seen, change = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    moments = [column_moments(values, np.asarray(space.face_mask) > 0) for values in (seen, change)]
    seen, change = standardise(seen, *moments[0]), standardise(change, *moments[1])
    first = jax.tree.map(lambda x: x[0], seen)
    params = Transformer().init(jax.random.key(seed), first, space.geodesic, space.face_mask)
    network = Weights(params, *moments[0], *moments[1], space)
    draw = np.random.default_rng(seed)

    def batch(_: int) -> tuple[Any, Weights]:
        rows = draw.integers(len(seen.whole), size=_BATCH)
        return jax.tree.map(lambda x: x[rows], (seen, change)), network

    def mean_loss(params: Any, batch: tuple[Any, Weights], key: Array) -> Array:
        rows, network = batch
        own = partial(loss, network.replace(params=params))
        return jnp.mean(jax.lax.map(lambda row: own(*row), (*rows, jax.random.split(key, _BATCH))))

    params, losses = fit(jax.value_and_grad(mean_loss), params, batch, steps, seed)
    training = {
        "steps": steps,
        "core_hours": (time.process_time() - began) / 3600,
        "truth_core_hours": truth.core_hours,
        "final_loss": float(np.mean(losses[-50:])),  # standard deviations, faces and whole added
    }
    return network.replace(params=params), training


def column_moments(values: Any, is_face: np.ndarray) -> tuple[Any, Any]:
    """Return means and deviations of the columns of `Seen` or `Change`, given for many frames."""
    make, faces, whole = type(values), values.faces[:, is_face], values.whole
    mean = make(faces.mean(axis=(0, 1))[None], whole.mean(axis=0))
    deviation = make(faces.std(axis=(0, 1))[None], whole.std(axis=0))
    return mean, jax.tree.map(lambda x: np.maximum(x, _LEAST), deviation)


def untrained(network: Weights) -> Weights:
    """Return the network with heads of zeros, which answers with the mean change of the training data."""
    weights = network.params["params"]
    still = {name: jax.tree.map(jnp.zeros_like, weights[name]) for name in ("faces", "whole")}
    return network.replace(params={"params": {**weights, **still}})


def write_network(network: Weights, path: Path, training: dict[str, Any]) -> None:
    """Write weights, means and deviations, and how the network was trained beside them."""
    scales = {
        name: getattr(network, name)._asdict()
        for name in ("seen_mean", "seen_deviation", "change_mean", "change_deviation")
    }
    write_archive(path, {**network.params, **scales}, {"training": training})


def read_network(path: Path) -> tuple[Weights, dict[str, Any]]:
    """Return a network that `write_network` wrote, without a space, and its training record."""
    arrays, record = read_archive(path)
    scales = {name: Seen(**arrays.pop(name)) for name in ("seen_mean", "seen_deviation")}
    scales |= {name: Change(**arrays.pop(name)) for name in ("change_mean", "change_deviation")}
    return Weights(arrays, **scales), record["training"]  # type: ignore[arg-type]: by name


def main() -> None:
    chosen = options(__doc__, 2000).parse_args()
    truth = load_truth(chosen.garment, chosen.out, is_smoke=chosen.smoke)
    network, training = train(truth, 2 if chosen.smoke else chosen.steps, chosen.seed)
    write_network(network, chosen.out / f"mat_{chosen.garment}.npz", training)
