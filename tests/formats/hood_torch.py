"""HOOD's networks in PyTorch, with the names and shapes of its checkpoints; written from their description.

`PYTHONPATH=.:tests python tests/formats/hood_torch.py` writes the checkpoints and answers of `tests/fixtures`.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import torch
from torch import nn

LEVELS = (
    ("coarse_edge0", "mesh_edge"),
    ("coarse_edge0", "coarse_edge1"),
    ("coarse_edge1",),
    ("coarse_edge0", "coarse_edge1"),
    ("coarse_edge0", "mesh_edge"),
)
OUR_NAMES = {"mesh_edge": "mesh", "coarse_edge0": "coarse0", "coarse_edge1": "coarse1"}


class Perceptron(nn.Module):
    def __init__(self, inputs, hidden, outputs):
        super().__init__()
        sizes = [inputs, hidden, hidden, outputs]
        layers = []
        for a, b in itertools.pairwise(sizes):
            layers += [nn.Linear(a, b), nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, x):
        return self.layers(x)


def normed(inputs, size):
    return nn.Sequential(Perceptron(inputs, size, size), nn.LayerNorm(size))


class Sums(nn.Module):
    """The normaliser: counts, sums and sums of squares as parameters."""

    def __init__(self, size):
        super().__init__()

        def parameter(value):
            return nn.Parameter(torch.tensor(value), requires_grad=False)

        self._acc_count, self._num_accumulations = parameter([0.0]), parameter([0.0])
        self._acc_sum = nn.Parameter(torch.zeros(1, size), requires_grad=False)
        self._acc_sum_squared = nn.Parameter(torch.zeros(1, size), requires_grad=False)

    def collect(self, rows):
        rows = rows.detach()
        self._acc_count += len(rows)
        self._num_accumulations += 1
        self._acc_sum += rows.sum(0)
        self._acc_sum_squared += (rows**2).sum(0)

    def mean_and_deviation(self):
        mean = self._acc_sum[0] / self._acc_count
        variance = self._acc_sum_squared[0] / self._acc_count - mean**2
        return mean, variance.clamp(min=0).sqrt().clamp(min=1e-8)

    def forward(self, rows):
        mean, deviation = self.mean_and_deviation()
        return (rows - mean) / deviation


class Step(nn.Module):
    """A step of the hierarchical networks."""

    def __init__(self, size, sets):
        super().__init__()
        self.sets = sets
        self.edge_processor_dict = nn.ModuleDict(
            {name: normed(3 * size, size) for name in (*sets, "world_edge")}
        )
        self.node_processor_dict = nn.ModuleDict({"node": normed((2 + len(sets)) * size, size)})

    def edge(self, name, rows):
        return self.edge_processor_dict[name](rows)

    def vertex(self, own, sums, world):
        return self.node_processor_dict["node"](torch.cat([own, *sums, world], 1))


class FlatStep(nn.Module):
    """A step of the MeshGraphNets; the vertex perceptron reads the vertex last."""

    sets = ("mesh_edge",)

    def __init__(self, size):
        super().__init__()
        self.node_processor = normed(3 * size, size)
        self.mesh_edge_processor, self.world_edge_processor = normed(3 * size, size), normed(3 * size, size)

    def edge(self, name, rows):
        return getattr(self, f"{name}_processor")(rows)

    def vertex(self, own, sums, world):
        return self.node_processor(torch.cat([*sums, world, own], 1))


class Core(nn.Module):
    def __init__(self, layout, size, steps):
        super().__init__()
        nodes = 20 if layout == "fine" else 24
        self.node_encoder, self.decoder = normed(nodes, size), Perceptron(size, size, 3)
        coarse = {"fine": [], "cvpr": ["coarse"], "postcvpr": ["coarse0", "coarse1", "coarse2"]}[layout]
        kinds = {"mesh": 12, "world": 9} | dict.fromkeys(coarse, 12)
        self.edgeset_encoders = nn.ModuleDict({name: normed(count, size) for name, count in kinds.items()})
        if layout == "fine":
            self.processor_steps = nn.ModuleList(FlatStep(size) for _ in range(steps))
            self.all_steps = [*self.processor_steps]
            return
        levels = [nn.ModuleList(Step(size, sets) for _ in range(steps // 5)) for sets in LEVELS]
        if layout == "cvpr":
            for k, level in enumerate(levels, 1):
                setattr(self, f"processor_steps{k}", level)
        else:
            self.levels = nn.ModuleList(levels)
        self.all_steps = [step for level in levels for step in level]


class Network(nn.Module):
    def __init__(self, layout, size, steps):
        super().__init__()
        self._learned_model = Core(layout, size, steps)
        nodes = 17 if layout == "fine" else 21
        self._output_normalizer, self._node_normalizer = Sums(3), Sums(nodes)
        self._mesh_edge_normalizer, self._world_edge_normalizer = Sums(9), Sums(9)
        self.nodetype_embedding = nn.Embedding(9, 9)
        if layout != "fine":
            self.vertexlevel_embedding = nn.Embedding(4, 4)
        self.layout = layout

    def forward(self, graph, is_collecting=False):
        """Return accelerations [m per frame^2] for a graph of NumPy arrays, with a body row for every vertex."""
        core, tensor = self._learned_model, lambda x: torch.tensor(np.asarray(x))
        levels = torch.zeros(len(graph["garment"]), dtype=torch.long)
        for k, kept in enumerate(graph["kept"]):
            levels[tensor(kept)] = k + 1
        nodes = {}
        for name in ("garment", "body"):
            rows, types = tensor(graph[name]), tensor(graph[f"{name}_type"]).long()
            parts = [rows[:, :3], self.nodetype_embedding.weight[types]]
            if self.layout != "fine":
                parts.append(self.vertexlevel_embedding.weight[levels if name == "garment" else 0 * levels])
            nodes[name] = torch.cat([*parts, rows[:, 3:]], 1)
        near = tensor(graph["world_mask"])
        if is_collecting:
            self._node_normalizer.collect(torch.cat([nodes["garment"], nodes["body"][near]])[:, :-3])
            self._world_edge_normalizer.collect(
                torch.cat([tensor(graph[name])[near] for name in ("world", "world_reverse")])
            )
            for name in graph["edges"]:
                self._mesh_edge_normalizer.collect(tensor(graph[name])[:, :-3])
            self._output_normalizer.collect(nodes["garment"][:, :3])
            return None

        def scale(rows, normalizer, changing):
            return torch.cat([normalizer(rows[:, :changing]), rows[:, changing:]], 1)

        latents = {
            name: core.node_encoder(scale(rows, self._node_normalizer, rows.shape[1] - 3))
            for name, rows in nodes.items()
        }
        for name in graph["edges"]:
            encoder = "coarse" if self.layout == "cvpr" and name != "mesh" else name
            rows = scale(tensor(graph[name]), self._mesh_edge_normalizer, 9)
            latents[name] = core.edgeset_encoders[encoder](rows)
        for name in ("world", "world_reverse"):
            latents[name] = core.edgeset_encoders["world"](self._world_edge_normalizer(tensor(graph[name])))
        for step in core.all_steps:
            latents = self.pass_messages(step, latents, graph, near)
        mean, deviation = self._output_normalizer.mean_and_deviation()
        return core.decoder(latents["garment"]) * deviation + mean

    def pass_messages(self, step, latents, graph, near):
        v, b, new = latents["garment"], latents["body"], dict(latents)
        sums = []
        joined = torch.zeros(len(v), dtype=torch.bool)
        for kind in step.sets:
            name = OUR_NAMES[kind]
            senders, receivers = (torch.tensor(np.asarray(x)).long() for x in graph["edges"][name])
            message = step.edge(kind, torch.cat([v[receivers], v[senders], latents[name]], 1))
            sums.append(torch.zeros_like(v).index_add(0, receivers, message))
            new[name] = latents[name] + message
            joined |= True if name == "mesh" else torch.tensor(np.asarray(graph["kept"][int(name[-1])]))
        mask = (near & joined)[:, None].float()
        to_garment = mask * step.edge("world_edge", torch.cat([v, b, latents["world"]], 1))
        to_body = mask * step.edge("world_edge", torch.cat([b, v, latents["world_reverse"]], 1))
        new["world"], new["world_reverse"] = latents["world"] + to_garment, latents["world_reverse"] + to_body
        new["garment"] = v + step.vertex(v, sums, to_garment)
        new["body"] = b + step.vertex(b, [torch.zeros_like(b)] * len(sums), to_body)
        return new


def save(path, layout, *, size, steps, graph=None):
    """Write a checkpoint with random weights, whose normalisers have seen a graph; return the network."""
    torch.manual_seed(0)
    network = Network(layout, size, steps)
    trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
    with torch.no_grad():
        for parameter in trained:  # scales of one and biases of zero would hide where they go
            parameter += 0.1 * torch.randn(parameter.shape)
    if graph is not None:
        network(graph, is_collecting=True)
    runner = nn.Module()
    runner.model = network
    content = {
        "training_module": runner.state_dict(),
        "config": {"lr": 5e-5},
        "optimizer": torch.optim.Adam(trained).state_dict(),
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


def write_fixtures(folder):
    """Write a checkpoint of every layout, as narrow as a perceptron can be read, its input and its answer."""
    from reference_models import make_scene

    from eslr_jax.mesh.coarse import add_coarse_edges
    from eslr_jax.networks.build import build_graph
    from eslr_jax.networks.registry import MODELS

    arrays = {}
    for layout in ("postcvpr", "cvpr", "fine"):
        garment, material, inputs = make_scene(8, 6)
        kind = MODELS["mgn-15" if layout == "fine" else "hood"].graph
        graph = build_graph(
            add_coarse_edges(garment) if kind.has_coarse_edges else garment, material, inputs, kind
        )
        seen = plain_graph(graph)
        network = save(folder / f"hood_{layout}.pth", layout, size=4, steps=5, graph=seen)
        with torch.no_grad():
            arrays[f"{layout}/answer"] = network(seen).numpy()
        rows = {f"{layout}/{name}": rows for name, rows in {**graph.nodes, **graph.edges}.items()}
        ends = {f"{layout}/{name}_ends": np.stack(pair) for name, pair in seen["edges"].items()}
        arrays |= rows | ends
    np.savez_compressed(folder / "hood_answers.npz", **arrays)


if __name__ == "__main__":
    write_fixtures(Path(__file__).parents[1] / "fixtures")
