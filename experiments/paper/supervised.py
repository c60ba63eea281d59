"""What trained systems share: the loop, and the supervised ones' ground truth, rollouts of the training clips."""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import harness
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import Array, Float

from eslr_jax import SimConfig, rollout_scene
from eslr_jax.files.npz import read_arrays, write_arrays
from eslr_jax.pipeline.assets import split_clips
from paper.worn import OPTIMUM_ITERATIONS, Setting, Worn, check_optimum, wear

_FRAMES = 100  # of a clip, as in the tables
_RATE = 1e-3  # of Adam (PBNS, GAPS, MAT), falling to zero along a cosine


def options(description: str | None, steps: Any, **settings: Any) -> argparse.ArgumentParser:
    """Return the parser of a script that trains a network for one garment, with settings of --steps."""
    parser = harness.parser(description, "two steps on one short clip", "out/one_garment")
    parser.add_argument("garment")
    parser.add_argument("--steps", type=int, default=steps, **settings)
    parser.add_argument("--seed", type=int, default=0)
    return parser


class Truth(NamedTuple):
    """Near-optimal rollouts of a garment."""

    worn: list[Worn]  # the garment on every clip
    positions: Float[np.ndarray, "clips frames vertices 3"]  # [m]
    core_hours: float  # that the rollouts took


def load_truth(garment: str, folder: Path, *, is_smoke: bool = False) -> Truth:
    """Return rollouts of a garment at 1k vertices, simulated the first time and then read from `folder`."""
    clips, frames = tuple(split_clips("train")), _FRAMES
    if is_smoke:
        clips, frames = clips[:1], 5
    setting = Setting((garment,), clips, frames, "1k")
    worn = wear((), setting)
    path = folder / f"truth_{garment}.npz"
    if not path.exists():
        began = time.process_time()
        config = SimConfig(iterations=OPTIMUM_ITERATIONS)
        found = []
        for row in worn:
            trajectory = rollout_scene(None, row.scene, config)
            check_optimum(trajectory, row.garment)
            found.append(np.asarray(trajectory.positions))
            print(f"truth {len(found)} of {len(clips)} {time.process_time() - began:.0f} s", flush=True)
        hours = (time.process_time() - began) / 3600
        arrays = {"positions": np.stack(found), "clips": np.array(clips), "core_hours": np.array(hours)}
        write_arrays(path, arrays)
    kept = read_arrays(path, content="ground truth")
    if tuple(kept["clips"]) != clips or kept["positions"].shape[1] != frames:
        raise ValueError(f"{path} holds rollouts of other clips or lengths; remove it")
    return Truth(worn, kept["positions"], float(kept["core_hours"]))


def write_archive(path: Path, arrays: dict[str, Any], record: dict[str, Any]) -> None:
    """Write nested dictionaries of arrays, whose keys hold no slash, and a record beside them as JSON; say so."""
    leaves = {"/".join(keys): np.asarray(leaf) for keys, leaf in flatten_dict(arrays).items()}
    write_arrays(path, leaves, is_compressed=True)
    path.with_suffix(".json").write_text(json.dumps(record, indent=1))
    print(path, record["training"])


def read_archive(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the arrays and the record that `write_archive` wrote."""
    arrays = {
        tuple(name.split("/")): jnp.asarray(leaf)
        for name, leaf in read_arrays(path, content="network").items()
    }
    return unflatten_dict(arrays), json.loads(path.with_suffix(".json").read_text())


def fit(
    slope_of: Callable[[Any, Any, Array], tuple[Array, Any]],
    params: Any,
    batches: Callable[[int], Any],
    steps: int,
    seed: int,
) -> tuple[Any, list[float]]:
    """Return weights after so many steps of Adam, and their losses; `slope_of` gives loss and gradient."""
    optimizer = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(_RATE, steps))
    )

    @jax.jit
    def step(params, moments, batch, key):
        value, slope = slope_of(params, batch, key)
        updates, moments = optimizer.update(slope, moments, params)
        return optax.apply_updates(params, updates), moments, value

    moments, losses, keys = optimizer.init(params), [], jax.random.split(jax.random.key(seed), steps)
    began = time.process_time()
    for k in range(steps):
        params, moments, value = step(params, moments, batches(k), keys[k])
        losses.append(float(value))
        if k % 50 == 0:
            spent = time.process_time() - began
            print(f"step {k} loss {np.mean(losses[-50:]):.4f} {spent:.0f} s", flush=True)
    return params, losses
