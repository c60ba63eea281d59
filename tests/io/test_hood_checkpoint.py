"""HOOD's checkpoints, made by an independent network in PyTorch."""

from __future__ import annotations

import json

import numpy as np
import pytest
from reference_models import make_scene, quick_jit
from test_torch_archive import Tensor, write_archive

from eslr_jax.cli.convert import convert
from eslr_jax.cli.simulate import simulate
from eslr_jax.errors import AssetError, CheckpointError
from eslr_jax.geometry.coarse import add_coarse_edges
from eslr_jax.graph.build import build_graph
from eslr_jax.io.hood import read_hood
from eslr_jax.io.weights import read_weights
from eslr_jax.models.registry import MODELS, apply_model, check_params, count_parameters, scale_output

COUNTS = {"postcvpr": 5_146_852, "cvpr": 5_076_964, "fine": 3_854_164}
SIZE = 16


def save(path, layout, *, size=SIZE, steps=5, graph=None):
    """Write a checkpoint with random weights, whose normalisers have seen a graph; return the network."""
    torch = pytest.importorskip("torch")
    from hood_torch import Network

    torch.manual_seed(0)
    network = Network(layout, size, steps)
    if graph is not None:
        network(graph, is_collecting=True)
    runner = torch.nn.Module()
    runner.model = network
    optimizer = torch.optim.Adam(parameter for parameter in network.parameters() if parameter.requires_grad)
    content = {
        "training_module": runner.state_dict(),
        "config": {"lr": 5e-5},
        "optimizer": optimizer.state_dict(),
    }
    torch.save(content, path)
    return network


def plain_graph(graph):
    """Return what the network in PyTorch reads of a graph."""
    names = [name for name in graph.edges if not name.startswith("world")]
    return {
        **{name: np.asarray(rows) for name, rows in {**graph.nodes, **graph.edges}.items()},
        "garment_type": graph.globals["garment_type"],
        "body_type": graph.globals["body_type"],
        "world_mask": graph.globals["world_mask"],
        "edges": {name: (graph.senders[name], graph.receivers[name]) for name in names},
        "kept": [np.asarray(level.is_kept) for level in graph.globals.get("coarse", ())],
    }


@pytest.mark.parametrize("layout", COUNTS)
def test_a_converted_network_computes_the_same(tmp_path, layout):
    pytest.importorskip("torch")
    import torch

    garment, material, inputs = make_scene(8, 6)
    save(tmp_path / "hood.pth", layout)
    _, config = read_hood(tmp_path / "hood.pth")
    garment = add_coarse_edges(garment) if config.hierarchical else garment
    graph = quick_jit(lambda: build_graph(garment, material, inputs, config))()
    network = save(tmp_path / "hood.pth", layout, graph=plain_graph(graph))
    with torch.no_grad():
        expected = network(plain_graph(graph)).numpy()
    convert(tmp_path / "hood.pth", tmp_path / "hood.npz")
    params, config, record = read_weights(tmp_path / "hood.npz")
    assert record == {"converted_from": "hood.pth"}
    assert (config.latent_size, config.message_passing_steps) == (SIZE, 5)
    actual = quick_jit(
        lambda params, graph: scale_output(config, params, apply_model(config, params, graph, garment))
    )(params, graph)
    np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("layout", COUNTS)
def test_full_size_checkpoints_have_the_published_sizes(tmp_path, layout):
    save(tmp_path / "hood.pth", layout, size=128, steps=15)
    params, config = read_hood(tmp_path / "hood.pth")
    check_params(config, params)
    shared = 2 * (12 * 128 + 128 + 2 * 16512 + 256)  # "cvpr" encodes all coarse levels by one perceptron
    assert count_parameters(params) == COUNTS[layout] + (shared if layout == "cvpr" else 0)


def test_what_is_no_network_of_hoods_is_refused(tmp_path):
    path = tmp_path / "other.pth"
    write_archive(path, {"training_module": {"encoder.weight": Tensor(np.zeros(3, np.float32))}})
    with pytest.raises(CheckpointError, match="holds no weights of HOOD"):
        read_hood(path)
    write_archive(
        path, {"model._learned_model.node_encoder.0.layers.0.weight": Tensor(np.zeros(3, np.float32))}
    )
    with pytest.raises(CheckpointError, match=r"has no nodetype_embedding\.weight"):
        read_hood(path)
    write_archive(path, [1, 2])
    with pytest.raises(CheckpointError, match="holds no weights of HOOD"):
        read_hood(path)
    with pytest.raises(AssetError, match=r"--out .*npz file"):
        convert(path, tmp_path / "hood.pth")


@pytest.mark.slow
def test_a_converted_network_simulates(tmp_path):
    garment, material, inputs = make_scene(8, 6)
    graph = build_graph(add_coarse_edges(garment), material, inputs, MODELS["hood"])
    save(tmp_path / "hood.pth", "postcvpr", graph=plain_graph(graph))
    convert(tmp_path / "hood.pth", tmp_path / "hood.npz")
    simulate(model=str(tmp_path / "hood.npz"), frames=4, iterations=20, pictures=False, out=tmp_path / "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["finite"]
    assert report["max_principal_stretch"] < 2
