"""MeshGraphNet in PyTorch, in the order of operations of HOOD's baselines, for timing only.

Every edge set gathers and concatenates both ends before its perceptron, sums go through `index_add`, and all
body vertices pass through the vertex perceptron. Architecture: HOOD's fine15 and fine48.
"""

import torch
from torch import nn

BODY_VERTICES = 6890  # SMPL
WORLD_SHARE = 0.9  # of the garment's vertices that have a world edge


def perceptron(inputs: int, size: int, outputs: int, norm: bool = True) -> nn.Sequential:
    """Linear-ReLU-Linear-ReLU-Linear, then LayerNorm."""
    layers = [nn.Linear(inputs, size), nn.ReLU(), nn.Linear(size, size), nn.ReLU(), nn.Linear(size, outputs)]
    return nn.Sequential(*layers, *([nn.LayerNorm(outputs)] if norm else []))


class Layer(nn.Module):
    """Edges from both ends, vertices from the sums over their edges, residuals on both."""

    def __init__(self, size: int):
        super().__init__()
        self.mesh, self.world, self.vertex = (perceptron(3 * size, size, size) for _ in range(3))

    def forward(self, cloth, body, mesh, to_cloth, to_body, index):
        """Return all five sets of latents, one layer on."""
        senders, receivers, at_cloth, at_body = index
        mesh_step = self.mesh(torch.cat([cloth[receivers], cloth[senders], mesh], dim=1))
        cloth_step = self.world(torch.cat([cloth[at_cloth], body[at_body], to_cloth], dim=1))
        body_step = self.world(torch.cat([body[at_body], cloth[at_cloth], to_body], dim=1))
        mesh_sum = torch.zeros_like(cloth).index_add(0, receivers, mesh_step)
        world_sum = torch.zeros_like(cloth).index_add(0, at_cloth, cloth_step)
        body_sum = torch.zeros_like(body).index_add(0, at_body, body_step)
        new_cloth = cloth + self.vertex(torch.cat([mesh_sum, world_sum, cloth], dim=1))
        new_body = body + self.vertex(torch.cat([torch.zeros_like(body), body_sum, body], dim=1))
        return new_cloth, new_body, mesh + mesh_step, to_cloth + cloth_step, to_body + body_step


class MeshGraphNet(nn.Module):
    """Encoder, layers, decoder."""

    def __init__(self, num_layers: int, size: int = 128):
        super().__init__()
        self.nodes, self.mesh, self.world = (perceptron(inputs, size, size) for inputs in (20, 12, 9))
        self.layers = nn.ModuleList(Layer(size) for _ in range(num_layers))
        self.decoder = perceptron(size, size, 3, norm=False)

    def forward(self, cloth, body, mesh, to_cloth, to_body, index):
        """Return the output at the cloth's vertices."""
        edges = self.mesh(mesh), self.world(to_cloth), self.world(to_body)
        rows = (self.nodes(cloth), self.nodes(body), *edges)
        for layer in self.layers:
            rows = layer(*rows, index)
        return self.decoder(rows[0])


def make_forward(senders, receivers, num_vertices: int, num_layers: int = 15):
    """Return a function that runs one forward pass on random features of a mesh of directed edges."""
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    network = MeshGraphNet(num_layers)
    num_world = int(WORLD_SHARE * num_vertices)
    index = (
        torch.as_tensor(senders.copy()).long(),
        torch.as_tensor(receivers.copy()).long(),
        torch.randperm(num_vertices, generator=generator)[:num_world],
        torch.randint(BODY_VERTICES, (num_world,), generator=generator),
    )
    counts = (num_vertices, 20), (BODY_VERTICES, 20), (len(senders), 12), (num_world, 9), (num_world, 9)
    rows = [torch.randn(*count, generator=generator) for count in counts]

    def forward():
        with torch.inference_mode():
            return network(*rows, index)

    return forward
