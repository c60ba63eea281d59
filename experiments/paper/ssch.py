"""SSCH on our own data: one network a garment, from the body's motion to a latent shape, and on to the cloth.

    python experiments/paper ssch GARMENT [--out FOLDER] [--steps 2000 400] [--smoke]

It keeps a garment space without the pose, a variational auto-encoder of 25 latents whose random shapes are kept
off the body at rest, and GRUs that turn the body's motion into latents; supervised by simulated rollouts, here
the solver's. It lacks the diffused body model (the garment's own skin weights hold, and simulated cloth is
unposed vertex by vertex), the body's shape, the learned pose code (ten principal components stand for it) and
half to three quarters of the width. The body at rest is its mesh, not a learned distance.
Source: Santesteban et al. 2021 (SSCH), whose loss weights were not published; ours are.
"""

import time
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax import load_body, load_garment
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.pose import lbs
from eslr_jax.terms.collision import penetration
from eslr_jax.types import BodySurface, Garment
from paper.posed import carried_joints, carry, pose_features
from paper.supervised import Truth, fit, load_truth, options, read_archive, write_archive

_LATENTS = 25  # SSCH
_CODE = 10  # numbers for a pose (SSCH)
_WIDTH = 512  # of encoder and decoder; SSCH's decoder has 2000
_MEMORY = 256  # of both GRUs; SSCH: 500
_CLEARANCE = 4e-3  # [m] that decoded cloth keeps off the body at rest
_DAMPING = 1e-2  # of `unpose`, over the squared stretch of a blend of rotations
_SHAPES, _COLLIDING, _SEQUENCES = 64, 4, 8  # of a batch; shapes whose contacts are searched; sequences
_SEQUENCE = 48  # frames
_MATCH = 0.1  # weight of the latents' error beside the cloth's
_DIVERGENCE = 1e-3  # weight of the latents' divergence from a normal distribution


class Encoder(nn.Module):
    """From standardised offsets to the mean and logarithmic variance of latents."""

    @nn.compact
    def __call__(self, x: Float[Array, "shapes values"]) -> tuple[Array, Array]:
        """Return both, shape [shapes, 25]."""
        for _ in range(2):
            x = nn.relu(nn.Dense(_WIDTH)(x))
        mean, spread = jnp.split(nn.Dense(2 * _LATENTS)(x), 2, axis=-1)
        return mean, spread


class Decoder(nn.Module):
    """From latents to standardised offsets."""

    num_values: int

    @nn.compact
    def __call__(self, z: Float[Array, "*batch latents"]) -> Float[Array, "*batch values"]:
        """Return offsets in standard deviations."""
        for _ in range(4):
            z = nn.relu(nn.LayerNorm(epsilon=1e-3)(nn.Dense(_WIDTH)(z)))
        return nn.Dense(self.num_values)(z)


class Regressor(nn.Module):
    """From the body's motion to latents."""

    @nn.compact
    def __call__(
        self, features: Float[Array, "batch frames features"]
    ) -> Float[Array, "batch frames latents"]:
        """Return latents; nothing is remembered before the first frame."""
        for _ in range(2):
            features = nn.RNN(nn.GRUCell(_MEMORY))(features)  # type: ignore[assignment]: no carry is asked for
        return nn.Dense(_LATENTS)(features)


@struct.dataclass
class Ssch:
    """Weights, and what inputs and outputs need."""

    params: dict[str, Any]  # of encoder, decoder and regressor
    joints: Int[Array, " joints"]  # whose rotations are read
    basis: Float[Array, "rotations code"]  # of poses
    mean: Float[Array, " features"]  # of the regressor's input
    deviation: Float[Array, " features"]
    offset_mean: Float[Array, "vertices 3"]  # of the rest mesh [m]
    offset_deviation: Float[Array, "vertices 3"]


def motion_features(
    transforms: Float[Array, "frames joints 3 4"], network: Ssch
) -> Float[Array, "frames features"]:
    """Return the pose's code with its first two differences, and the root's motion with its first.

    Unlike SSCH's they hold the vertical as the root sees it, so a lying body is told from a standing one.
    """
    seen = pose_features(transforms, network.joints, is_static=False)
    count = network.basis.shape[0]
    code, root = seen[:, :count] @ network.basis, seen[:, count:]
    moved = _change(code)
    features = jnp.concatenate([code, moved, _change(moved), root, _change(root)], axis=1)
    return (features - network.mean[None]) / network.deviation[None]


def _change(x: Float[Array, "frames values"]) -> Float[Array, "frames values"]:
    """Return the difference from the frame before; zero in the first."""
    return jnp.diff(x, axis=0, prepend=x[:1])


def unpose(
    garment: Garment, position: Float[Array, "vertices 3"], transforms: Float[Array, "joints 3 4"]
) -> Float[Array, "vertices 3"]:
    """Return the offsets of the rest mesh [m] that skinning carries to `position`.

    Where weights mix joints far apart, blended rotations flatten space and cannot be turned back; damped least
    squares then leave a part of the offset.
    """

    def posed(offsets: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        return lbs.skin(
            garment.rest_positions + offsets, garment.skin_weights, garment.skin_indices, transforms
        )

    still = jnp.zeros_like(position)
    start = posed(still)
    blend = jnp.stack([posed(still + axis[None]) - start for axis in jnp.eye(3)], axis=2)
    squared = jnp.einsum("vab,vac->vbc", blend, blend) + _DAMPING * jnp.eye(3)[None]
    return jnp.linalg.solve(squared, jnp.einsum("vab,va->vb", blend, position - start)[..., None])[..., 0]


def _encode(params: Any, scaled: Float[Array, "shapes vertices 3"]) -> tuple[Array, Array]:
    """Return mean and logarithmic variance of latents, both of shape [shapes, 25]."""
    found: Any = Encoder().apply(params, scaled.reshape((len(scaled), -1)))
    return found


def standardise(
    offsets: Float[Array, "shapes vertices 3"], network: Ssch
) -> Float[Array, "shapes vertices 3"]:
    """Return offsets in deviations from their means."""
    return (offsets - network.offset_mean[None]) / network.offset_deviation[None]


def decode(network: Ssch, latents: Float[Array, "*batch latents"]) -> Float[Array, "*batch vertices 3"]:
    """Return offsets of the rest mesh [m]."""
    shape = network.offset_mean.shape
    scaled: Any = Decoder(shape[0] * 3).apply(network.params["decoder"], latents)
    scaled = scaled.reshape((*latents.shape[:-1], *shape))
    scales = network.offset_mean, network.offset_deviation
    mean, deviation = (jnp.broadcast_to(x, scaled.shape) for x in scales)
    return mean + scaled * deviation


def displace(
    network: Ssch, garment: Garment, transforms: Float[Array, "frames joints 3 4"]
) -> Float[Array, "frames vertices 3"]:
    """Return the garment's positions on a moving body [m]; padded vertices stay in place."""
    features = motion_features(transforms, network)
    latents: Any = Regressor().apply(network.params["regressor"], features[None])
    return carry(garment, decode(network, latents[0]), transforms)


def shape_loss(
    params: Any,
    network: Ssch,
    offsets: Float[Array, "shapes vertices 3"],
    rest: tuple[Garment, BodySurface, Float[Array, "surface_vertices 3"]],
    key: Array,
) -> Float[Array, ""]:
    """Return the auto-encoder's loss: errors of offsets [m] and of their Laplacians, depth, divergence [cm].

    Shapes are judged at rest: `rest` has the garment, and the body's surface and places [m].
    """
    garment, surface, body = rest

    def depth_of(offsets: Float[Array, "vertices 3"]) -> Float[Array, " vertices"]:
        position = garment.rest_positions + offsets
        found = find_contacts(position, body, body, surface, garment.vertex_blocks)
        return penetration(position, jax.lax.stop_gradient(found), _CLEARANCE)

    network = network.replace(params=params)
    scaled = standardise(offsets, network)
    mean, spread = _encode(params["encoder"], scaled)
    keys = jax.random.split(key)
    decoded = decode(network, mean + jnp.exp(0.5 * spread) * jax.random.normal(keys[0], mean.shape))
    drawn = decode(network, jax.random.normal(keys[1], (_COLLIDING, _LATENTS)))
    depth = jax.lax.map(depth_of, jnp.concatenate([decoded[:_COLLIDING], drawn]))
    error = decoded - offsets
    divergence = 0.5 * jnp.mean(jnp.sum(jnp.exp(spread) + mean**2 - 1.0 - spread, axis=1))
    bumps = _bumps(error, garment)
    return 100.0 * (jnp.mean(jnp.abs(error)) + jnp.mean(jnp.abs(bumps)) + jnp.mean(depth)) + (
        _DIVERGENCE * divergence
    )


def _bumps(x: Float[Array, "shapes vertices 3"], garment: Garment) -> Float[Array, "shapes vertices 3"]:
    """Return how far vertices are from the mean of their neighbours."""
    mask = garment.neighbor_mask[None, :, :, None]
    around = jnp.sum(jnp.where(mask, x[:, garment.neighbors], 0.0), axis=2)
    return x - around / jnp.maximum(jnp.sum(mask, axis=2, dtype=x.dtype), 1.0)


def motion_loss(
    params: Any,
    network: Ssch,
    features: Float[Array, "sequences frames features"],
    offsets: Float[Array, "sequences frames vertices 3"],
    latents: Float[Array, "sequences frames latents"],
) -> Float[Array, ""]:
    """Return the regressor's loss: errors of the decoded cloth [cm] and of the latents."""
    found: Any = Regressor().apply(params, features)
    error = decode(network, found) - offsets
    return 100.0 * jnp.mean(jnp.abs(error)) + _MATCH * jnp.mean(jnp.abs(found - latents))


def prepare(
    garment: Garment,
    transforms: Float[Array, "clips frames joints 3 4"],
    offsets: Float[Array, "clips frames vertices 3"],
    seed: int,
) -> Ssch:
    """Return a network with random weights, its scales taken from the data."""
    joints = carried_joints(garment, transforms.shape[2])
    seen = np.concatenate([pose_features(clip, joints, is_static=True)[:, :-3] for clip in transforms])
    _, _, rows = np.linalg.svd(seen - seen.mean(axis=0), full_matrices=False)
    flat = offsets.reshape((-1, *offsets.shape[2:]))
    basis, scales = jnp.asarray(rows[:_CODE].T), (flat.mean(axis=0), jnp.maximum(flat.std(axis=0), 1e-4))
    network = Ssch({}, joints, basis, jnp.zeros(1), jnp.ones(1), *scales)
    inputs = np.concatenate([motion_features(clip, network) for clip in transforms])
    keys = jax.random.split(jax.random.key(seed), 3)
    values = flat[0].size
    params = {
        "encoder": Encoder().init(keys[0], jnp.zeros((1, values))),
        "decoder": Decoder(values).init(keys[1], jnp.zeros((1, _LATENTS))),
        "regressor": Regressor().init(keys[2], jnp.zeros((1, 2, inputs.shape[1]))),
    }
    mean, deviation = map(jnp.asarray, (inputs.mean(axis=0), np.maximum(inputs.std(axis=0), 1e-3)))
    return network.replace(params=params, mean=mean, deviation=deviation)


def train(truth: Truth, steps: tuple[int, int], seed: int = 0) -> tuple[Ssch, dict[str, Any]]:
    """Train auto-encoder and regressor on a garment's rollouts; return the network and how it was trained."""
    began = time.process_time()
    garment, body = load_garment(truth.worn[0].garment), truth.worn[0].scene.body
    assert body is not None
    rest = garment, body.surface, jnp.asarray(load_body().rest_positions)[body.surface.vertex_ids]
    count = garment.rest_positions.shape[0]
    transforms = jnp.stack([worn.poses.joint_transforms for worn in truth.worn])
    positions = jnp.asarray(truth.positions[:, :, :count])
    unposed = jax.jit(lambda frames: jax.lax.map(lambda frame: unpose(garment, *frame), frames))
    offsets = jnp.stack([unposed(clip) for clip in zip(positions, transforms, strict=True)])
    network = prepare(garment, transforms, offsets, seed)
    flat = offsets.reshape((-1, count, 3))
    draw = np.random.default_rng(seed)

    parts = {name: network.params[name] for name in ("encoder", "decoder")}
    parts, shape_losses = fit(
        jax.value_and_grad(lambda params, batch, key: shape_loss(params, network, batch, rest, key)),
        parts,
        lambda _: flat[draw.integers(len(flat), size=_SHAPES)],
        steps[0],
        seed,
    )
    network = network.replace(params={**network.params, **parts})
    features = jax.vmap(lambda clip: motion_features(clip, network))(transforms)
    length = min(_SEQUENCE, features.shape[1])
    latents, _ = _encode(parts["encoder"], standardise(flat, network))
    latents = latents.reshape((*offsets.shape[:2], -1))

    def sequences(_: int) -> tuple[Array, Array, Array]:
        clips = draw.integers(len(features), size=_SEQUENCES)
        starts = draw.integers(features.shape[1] - length + 1, size=_SEQUENCES)
        frames = starts[:, None] + np.arange(length)
        chosen = (clips[:, None], frames)
        return features[chosen], offsets[chosen], latents[chosen]

    regressor, motion_losses = fit(
        jax.value_and_grad(lambda params, batch, _: motion_loss(params, network, *batch)),
        network.params["regressor"],
        sequences,
        steps[1],
        seed,
    )
    training = {
        "steps": list(steps),
        "core_hours": (time.process_time() - began) / 3600,
        "truth_core_hours": truth.core_hours,
        "final_loss_cm": [float(np.mean(losses[-50:])) for losses in (shape_losses, motion_losses)],
    }
    return network.replace(params={**network.params, "regressor": regressor}), training


def write_network(network: Ssch, path: Path, training: dict[str, Any]) -> None:
    """Write what `displace` needs, and how the network was trained beside it."""
    arrays = {field: getattr(network, field) for field in Ssch.__dataclass_fields__}
    params = {name: network.params[name] for name in ("decoder", "regressor")}
    write_archive(path, {**arrays, "params": params}, {"training": training})


def read_network(path: Path) -> tuple[Ssch, dict[str, Any]]:
    """Return a network that `write_network` wrote, and its training record."""
    arrays, record = read_archive(path)
    return Ssch(**arrays), record["training"]


def main() -> None:
    chosen = options(__doc__, (2000, 400), nargs=2, metavar=("SHAPE", "MOTION")).parse_args()
    truth = load_truth(chosen.garment, chosen.out, is_smoke=chosen.smoke)
    network, training = train(truth, (2, 2) if chosen.smoke else tuple(chosen.steps), chosen.seed)
    write_network(network, chosen.out / f"ssch_{chosen.garment}.npz", training)
