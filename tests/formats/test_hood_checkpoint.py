"""HOOD's checkpoints, made by an independent network in PyTorch."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from commands import eslr_here
from reference_models import make_scene, quick_jit
from test_torch_archive import Tensor, write_archive

from eslr_jax import CheckpointError
from eslr_jax.mesh.coarse import add_coarse_edges
from eslr_jax.networks.apply import apply_model, scale_output
from eslr_jax.networks.build import build_graph
from eslr_jax.networks.registry import MODELS, read_network
from eslr_jax.pipeline.assets.hood import read_hood
from eslr_jax.pipeline.formats.torch_archive import read_torch

COUNTS = {"postcvpr": 5_146_852, "cvpr": 5_076_964, "fine": 3_854_164}
SIZE = 16
FIXTURES = Path(__file__).parents[1] / "fixtures"


def save(path, layout, *, size=SIZE, steps=5, graph=None):
    """Write a checkpoint by PyTorch, or skip the test where there is none."""
    pytest.importorskip("torch")
    import hood_torch

    seen = None if graph is None else hood_torch.plain_graph(graph)
    return hood_torch.save(path, layout, size=size, steps=steps, graph=seen)


def convert(checkpoint, out):
    done = eslr_here("convert", checkpoint, "--out", out)
    assert done.returncode == 0, done.stderr


def answer_of(path, graph, garment):
    """Return the accelerations of a converted network."""
    network, _ = read_network(path)
    run = quick_jit(lambda network, graph: scale_output(network, apply_model(network, graph, garment)))
    return run(network, graph)


def scene_graph(config):
    """Return a tube and its graph."""
    garment, material, inputs = make_scene(8, 6)
    garment = add_coarse_edges(garment) if config.graph.has_coarse_edges else garment
    return garment, quick_jit(lambda: build_graph(garment, material, inputs, config.graph))()


@pytest.mark.parametrize("layout", COUNTS)
def test_without_pytorch_its_checkpoint_computes_what_it_computed(tmp_path, layout):
    """The fixtures hold a network's input and answer; `hood_torch` wrote them."""
    convert(FIXTURES / f"hood_{layout}.pth", tmp_path / "hood.npz")
    config = read_network(tmp_path / "hood.npz")[0].config
    garment, graph = scene_graph(config)
    with np.load(FIXTURES / "hood_answers.npz") as stored:
        given = {name.removeprefix(f"{layout}/"): stored[name] for name in stored.files if layout in name}
    for name in ("mesh", "coarse0", "coarse1", "coarse2")[: 4 if config.graph.has_coarse_edges else 1]:
        np.testing.assert_array_equal(given[f"{name}_ends"], [graph.senders[name], graph.receivers[name]])
    graph = graph._replace(
        nodes={name: jnp.asarray(given[name]) for name in graph.nodes},
        edges={name: jnp.asarray(given[name]) for name in graph.edges},
    )
    expected = given["answer"]
    actual = answer_of(tmp_path / "hood.npz", graph, garment)
    np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("layout", COUNTS)
def test_a_converted_network_computes_the_same(tmp_path, layout):
    torch = pytest.importorskip("torch")
    from hood_torch import plain_graph

    save(tmp_path / "hood.pth", layout)
    config = read_hood(tmp_path / "hood.pth").config
    garment, graph = scene_graph(config)
    network = save(tmp_path / "hood.pth", layout, graph=graph)
    with torch.no_grad():
        expected = network(plain_graph(graph)).numpy()
    convert(tmp_path / "hood.pth", tmp_path / "hood.npz")
    converted, record = read_network(tmp_path / "hood.npz")
    assert record == {"converted_from": "hood.pth"}
    assert converted.config == config
    assert config.latent_size == SIZE
    actual = answer_of(tmp_path / "hood.npz", graph, garment)
    np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("layout", COUNTS)
def test_full_size_checkpoints_have_the_published_sizes(tmp_path, layout):
    save(tmp_path / "hood.pth", layout, size=128, steps=15)
    network = read_hood(tmp_path / "hood.pth")
    shared = 2 * (12 * 128 + 128 + 2 * 16512 + 256)  # "cvpr" encodes all coarse levels by one perceptron
    assert network.num_parameters == COUNTS[layout] + (shared if layout == "cvpr" else 0)


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


def test_stages_of_unlike_length_are_refused(tmp_path):
    path = tmp_path / "longer.pth"
    content = read_torch(FIXTURES / "hood_postcvpr.pth", content="checkpoint")
    tensors = content["training_module"]
    more = {name.replace("levels.2.0.", "levels.2.1."): value for name, value in tensors.items()}
    assert len(more | tensors) > len(tensors)
    write_archive(
        path, {"training_module": {name: Tensor(np.asarray(x)) for name, x in (more | tensors).items()}}
    )
    with pytest.raises(
        CheckpointError, match=r"longer.pth is of an .* not converted: its stages have \[1, 2\] steps"
    ):
        read_hood(path)


@pytest.mark.slow
def test_a_converted_network_simulates(tmp_path):
    garment, material, inputs = make_scene(8, 6)
    graph = build_graph(add_coarse_edges(garment), material, inputs, MODELS["hood"].graph)
    save(tmp_path / "hood.pth", "postcvpr", graph=graph)
    convert(tmp_path / "hood.pth", tmp_path / "hood.npz")
    words = ("--frames", 4, "--iterations", 20, "--no-pictures", "--out", tmp_path / "run")
    done = eslr_here("simulate", "--model", tmp_path / "hood.npz", *words)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["finite"]
    assert report["max_principal_stretch"] < 2
