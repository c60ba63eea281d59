"""HOOD's checkpoints: what PyTorch computed with them, and what is no network of HOOD's."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from commands import eslr, eslr_here, refused, succeeded
from reference_models import make_scene, quick_jit
from test_torch_archive import Tensor, write_archive

from eslr_jax import load_model
from eslr_jax.mesh.coarse import add_coarse_edges
from eslr_jax.networks.apply import apply_model, scale_output
from eslr_jax.networks.build import build_graph
from eslr_jax.pipeline.formats.torch_archive import read_torch

FIXTURES = Path(__file__).parents[1] / "fixtures"


def convert(checkpoint, out):
    succeeded(eslr_here("convert", checkpoint, "--out", out))


@pytest.mark.parametrize("layout", ["postcvpr", "cvpr", "fine"])
def test_a_converted_checkpoint_computes_what_pytorch_computed(tmp_path, layout):
    """The fixtures hold a network's input and answer, see their README."""
    convert(FIXTURES / f"hood_{layout}.pth", tmp_path / "hood.npz")
    network = load_model(tmp_path / "hood.npz")
    kind = network.config.graph
    garment, material, inputs = make_scene(8, 6)
    garment = add_coarse_edges(garment) if kind.has_coarse_edges else garment
    graph = quick_jit(lambda: build_graph(garment, material, inputs, kind))()
    with np.load(FIXTURES / "hood_answers.npz") as stored:
        given = {name.removeprefix(f"{layout}/"): stored[name] for name in stored.files if layout in name}
    for name in ("mesh", "coarse0", "coarse1", "coarse2")[: 4 if kind.has_coarse_edges else 1]:
        np.testing.assert_array_equal(given[f"{name}_ends"], [graph.senders[name], graph.receivers[name]])
    graph = graph._replace(
        nodes={name: jnp.asarray(given[name]) for name in graph.nodes},
        edges={name: jnp.asarray(given[name]) for name in graph.edges},
    )
    run = quick_jit(lambda network, graph: scale_output(network, apply_model(network, graph, garment)))
    expected = given["answer"]
    np.testing.assert_allclose(run(network, graph), expected, atol=1e-5 * np.abs(expected).max())
    record = json.loads((tmp_path / "hood.json").read_text())
    assert record["training"] == {"converted_from": f"hood_{layout}.pth"}


def test_what_is_no_network_of_hoods_is_refused(tmp_path):
    weight = Tensor(np.zeros(3, np.float32))
    tensors = read_torch(FIXTURES / "hood_postcvpr.pth", content="checkpoint")["training_module"]
    tensors = {name: Tensor(np.asarray(value)) for name, value in tensors.items()}
    longer = {name.replace("levels.2.0.", "levels.2.1."): value for name, value in tensors.items()} | tensors
    assert len(longer) > len(tensors)
    for content, cause in (
        ({"training_module": {"encoder.weight": weight}}, "holds no weights of HOOD"),
        ([1, 2], "holds no weights of HOOD"),
        ({"model._learned_model.node_encoder.0.layers.0.weight": weight}, "has no nodetype_embedding.weight"),
        ({"training_module": longer}, "not converted: its stages have [1, 2] steps"),
    ):
        write_archive(tmp_path / "other.pth", content)
        refused(eslr_here("convert", tmp_path / "other.pth", "--out", tmp_path / "a.npz"), "other.pth", cause)
    assert not (tmp_path / "a.npz").exists()


@pytest.mark.slow
def test_a_converted_network_simulates(tmp_path):
    convert(FIXTURES / "hood_postcvpr.pth", tmp_path / "hood.npz")
    words = ("--frames", 4, "--iterations", 20, "--no-pictures", "--out", tmp_path / "run")
    succeeded(eslr("simulate", "--model", tmp_path / "hood.npz", *words))
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["finite"]
    assert report["max_principal_stretch"] < 2
