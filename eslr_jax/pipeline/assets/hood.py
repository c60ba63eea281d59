"""Read HOOD's checkpoints: its weights under our names.

Three layouts of checkpoints are read: "postcvpr" (levels), "cvpr" (five lists of steps, one encoder for all
coarse levels) and the MeshGraphNets "fine15" and "fine48". A converted network computes the same as HOOD's from
the same graph; `networks.hood` says in what our graphs differ.

Source: Grigorev, Black and Hilliges, "HOOD" (2023), repository at 9bc1076, models/ and
utils/normalization.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from eslr_jax.errors import CheckpointError
from eslr_jax.networks.build import COARSE_SETS
from eslr_jax.networks.eslr import Eslr
from eslr_jax.networks.hood import STAGES, Hood
from eslr_jax.networks.network import Network
from eslr_jax.pipeline.formats.torch_archive import read_torch
from eslr_jax.types import MIN_DEVIATION, Normalizer

Tensors = Mapping[str, np.ndarray]

_NORMALIZERS = {"garment": "node", "mesh": "mesh_edge", "world": "world_edge", "output": "output"}
_CORE = "_learned_model."


def read_hood(path: str | Path) -> Network:
    """Read the network of a checkpoint that HOOD's training wrote, or of its runner or model alone.

    Raises:
        AssetError: The file is missing or damaged, or it is no file of PyTorch.
        CheckpointError: It holds no network of HOOD's that we have.
    """
    content = read_torch(path, content="checkpoint")
    tensors = content.get("training_module", content) if isinstance(content, dict) else None
    if not isinstance(tensors, dict) or not any(_CORE in str(name) for name in tensors):
        raise CheckpointError(f"{path} holds no weights of HOOD; give a checkpoint that its training wrote")
    tensors = {str(name).removeprefix("model."): value for name, value in tensors.items()}
    try:
        network = _convert(tensors)
    except ValueError as error:
        raise CheckpointError(f"{path} is of an architecture that is not converted: {error}") from error
    except KeyError as error:
        raise CheckpointError(
            f"{path} has no {error.args[0]}, which HOOD's networks postcvpr, cvpr, fine15 and fine48 have; "
            "other networks are not converted"
        ) from error
    network.config.check(network)
    return network


def _convert(tensors: Tensors) -> Network:
    is_flat = f"{_CORE}processor_steps.0.node_processor.0.layers.0.weight" in tensors
    trained = {
        "type_embedding": _tensor(tensors, "nodetype_embedding.weight"),
        "garment_encoder": _mlp(tensors, "node_encoder"),
        "mesh_encoder": _mlp(tensors, "edgeset_encoders.mesh"),
        "world_encoder": _mlp(tensors, "edgeset_encoders.world"),
        "decoder": _mlp(tensors, "decoder", norm=False),
    }
    size = trained["garment_encoder"]["kernel_0"].shape[1]
    if is_flat:
        steps = _count(tensors, "processor_steps")
        trained["layers"] = _stack(_flat_step(tensors, f"processor_steps.{k}", size) for k in range(steps))
    else:
        is_cvpr = f"{_CORE}processor_steps1.0.node_processor_dict.node.0.layers.0.weight" in tensors
        counts = set()
        trained["level_embedding"] = _tensor(tensors, "vertexlevel_embedding.weight")
        for kind in COARSE_SETS:
            encoder = "edgeset_encoders." + ("coarse" if is_cvpr else kind)
            trained[f"coarse_encoders_{kind}"] = _mlp(tensors, encoder)
        for stage, sets in enumerate(STAGES):
            place = f"processor_steps{stage + 1}" if is_cvpr else f"levels.{stage}"
            count = _count(tensors, place)
            layers = [_stage_step(tensors, f"{place}.{k}", sets) for k in range(count)]
            trained[f"stages_{stage}"] = _stack(layers)
            counts.add(count)
        if len(counts) > 1:
            raise ValueError(f"its stages have {sorted(counts)} steps, and ours all have as many")
        (steps,) = counts
    hidden = sum(name.startswith("kernel") for name in trained["decoder"]) - 1
    widths = {"latent_size": size, "hidden_layers": hidden}
    if is_flat:
        flat = {"smoothing_steps": 0, "attention_blocks": 0, "update_body": True}
        config = Eslr(message_passing_steps=steps, **flat, **widths)
    else:
        config = Hood(steps_per_stage=steps, **widths)
    statistics = {
        name: _normalizer(tensors, f"_{theirs}_normalizer") for name, theirs in _NORMALIZERS.items()
    }
    return Network(trained, config, statistics)


def _flat_step(tensors: Tensors, name: str, size: int) -> dict[str, Any]:
    """Return a step of a MeshGraphNet; its vertex perceptron reads the vertex last, ours reads it first."""
    vertex = _mlp(tensors, f"{name}.node_processor")
    vertex["kernel_0"] = np.roll(vertex["kernel_0"], size, axis=0)
    return {
        "mesh_mlp": _mlp(tensors, f"{name}.mesh_edge_processor"),
        "world_mlp": _mlp(tensors, f"{name}.world_edge_processor"),
        "vertex_mlp": vertex,
    }


def _stage_step(tensors: Tensors, name: str, sets: tuple[str, ...]) -> dict[str, Any]:
    """Return a step of a hierarchical network on some edge sets."""
    theirs = {"mesh": "mesh_edge"} | {kind: kind.replace("coarse", "coarse_edge") for kind in COARSE_SETS}
    edges = {
        f"edge_mlps_{kind}": _mlp(tensors, f"{name}.edge_processor_dict.{theirs[kind]}") for kind in sets
    }
    return {
        **edges,
        "world_mlp": _mlp(tensors, f"{name}.edge_processor_dict.world_edge"),
        "vertex_mlp": _mlp(tensors, f"{name}.node_processor_dict.node"),
    }


def _mlp(tensors: Tensors, name: str, *, norm: bool = True) -> dict[str, np.ndarray]:
    """Return a perceptron; every other layer of HOOD's is a ReLU."""
    inner = f"{_CORE}{name}.0.layers." if norm else f"{_CORE}{name}.layers."
    count = max(sum(key.startswith(inner) for key in tensors) // 2, 1)
    layers = {}
    for k in range(count):
        layers[f"kernel_{k}"] = _tensor(tensors, f"{inner}{2 * k}.weight").T
        layers[f"bias_{k}"] = _tensor(tensors, f"{inner}{2 * k}.bias")
    if norm:
        layers["norm_scale"] = _tensor(tensors, f"{_CORE}{name}.1.weight")
        layers["norm_bias"] = _tensor(tensors, f"{_CORE}{name}.1.bias")
    return layers


def _normalizer(tensors: Tensors, name: str) -> Normalizer:
    """Return a normaliser; HOOD keeps sums and sums of squares."""
    count = float(_tensor(tensors, f"{name}._acc_count")[0])
    total, squares = (
        np.asarray(_tensor(tensors, f"{name}.{part}"), np.float64)[0]
        for part in ("_acc_sum", "_acc_sum_squared")
    )
    mean = total / max(count, 1.0)
    least = count * MIN_DEVIATION**2  # HOOD divides a feature that never changed by its floor
    return Normalizer(
        count=np.float32(count),  # type: ignore[arg-type]
        mean=mean.astype(np.float32),  # type: ignore[arg-type]
        squared_deviations=np.maximum(squares - count * mean**2, least).astype(np.float32),  # type: ignore[arg-type]
        num_updates=np.int32(_tensor(tensors, f"{name}._num_accumulations")[0]),  # type: ignore[arg-type]
    )


def _tensor(tensors: Tensors, name: str) -> np.ndarray:
    """Return a tensor in float32; raise a KeyError if there is none, a CheckpointError if it is not finite."""
    value = tensors[name]
    if not isinstance(value, np.ndarray) or not value.ndim or not np.isfinite(value).all():
        raise CheckpointError(
            f"{name} of the checkpoint is no array of finite numbers; train the network again"
        )
    return value.astype(np.float32)


def _count(tensors: Tensors, place: str) -> int:
    """Return the number of steps in a list of modules."""
    start = len(_CORE) + len(place) + 1
    names = {name[start:].partition(".")[0] for name in tensors if name.startswith(f"{_CORE}{place}.")}
    return max(len(names), 1)  # a missing list is named by its first weight


def _stack(layers: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Stack the weights of equal layers along a new leading axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *layers)
