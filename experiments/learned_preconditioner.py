"""Learn the weights of the solver's preconditioner: by message passing, and by a dozen numbers.

    python experiments/learned_preconditioner.py              # half an hour of one core
    python experiments/learned_preconditioner.py --smoke --out DIR

The preconditioner P is a polynomial in D^-1 W with springs W and a diagonal D. Here every spring and every
diagonal entry has a factor, and a symmetric matrix T of each vertex goes before and behind: T P T stays symmetric
and positive semi-definite whatever the factors are. They come from two LSDMP layers that see a frame's start once
("network"), or from twelve numbers that all frames share ("numbers"). With factors of one and T = I it is the
solver's P.

Both are trained by the gap after 10 and 20 L-BFGS iterations, differentiated through these, on frames of training
clips at 1k. Iterations to a share of the initial gap are counted on test clips, at 1k and, untrained for, at 4k.
Writes learned_preconditioner.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph
import numpy as np
import optax
from jaxtyping import Array, Float

from eslr_jax.assets import load_body, load_garment, load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.config import ModelConfig, SimConfig
from eslr_jax.evaluation.gap import trajectory_states
from eslr_jax.evaluation.report import environment
from eslr_jax.evaluation.scene_parts import time_in_turns
from eslr_jax.graph.build import incoming_edges
from eslr_jax.graph.features import mean_edge_length
from eslr_jax.graph.operators import mesh_tables, sum_receivers
from eslr_jax.io.atomic import atomic_write
from eslr_jax.models.lsdmp import Latents, LayerTables, LsdmpLayer
from eslr_jax.models.mlp import MLP
from eslr_jax.models.registry import draw_weights
from eslr_jax.numerics import safe_norm, safe_normalize, sum_products, vertex_normals
from eslr_jax.physics.guess import initial_guess
from eslr_jax.physics.lbfgs import Stop, minimize
from eslr_jax.physics.potential import potential
from eslr_jax.physics.preconditioner import Stiffness, stiffness_inverse, stretched_stiffness
from eslr_jax.scene.plan import prepare_scene
from eslr_jax.simulation.frame import frame_problem
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.terms.problem import FrameProblem
from eslr_jax.types import Garment

RESULTS = Path(__file__).parent / "results"
TRAIN = ("cmu_016_22", "cmu_047_01", "cmu_069_21")  # clips
TEST = ("cmu_016_32", "cmu_016_47")
GARMENTS = ("tshirt", "pants", "dress")
LAST_FRAME = 40  # frames are spread from the second to this one
TRUTH, ROLLOUT = 400, 100  # iterations of the optimum, and of the rollout that supplies the states
TRAINED = (10, 20)  # iterations whose gaps are the loss
LEAST_GAP = 1e-4  # of the initial one, below which the loss looks at nothing
COUNTED = 130  # iterations at most
MEMORY = 8  # pairs that L-BFGS keeps, as the solver's
WIDTH, LAYERS = 16, 2
LEARNING_RATES = {"numbers": 0.03, "network": 0.003}
TOUCHING = 0.004  # [m] from the body

Vectors = Float[Array, "vertices 3"]


class Frame(NamedTuple):
    """A frame to minimise."""

    problem: FrameProblem
    start: Vectors  # [m]
    initial: Float[Array, ""]  # energy [J] from which the gap counts
    best: Float[Array, ""]  # lowest energy found [J]


class Factors(NamedTuple):
    """What the preconditioner is changed by; zeros change nothing but `dominance`."""

    springs: Float[Array, "vertices degree"]  # logarithm
    rest: Float[Array, " vertices"]  # likewise, of the diagonal without springs
    dominance: Float[
        Array, " vertices"
    ]  # likewise, of the springs' further share in the diagonal, in fiftieths
    normal: Float[Array, " vertices"]  # added to T along the cloth's normal
    contact: Float[Array, " vertices"]  # along the body's
    edges: Float[Array, "vertices degree"]  # along each edge


class Places(NamedTuple):
    """What a frame's start says of vertices and edges."""

    problem: FrameProblem
    start: Vectors
    matrix: Stiffness
    gradient: Vectors  # [N]


def solved_frames(garment: str, clip: str, vertices: str, count: int) -> list[Frame]:
    """Return frames of a solved rollout with their optima."""
    poses = pose_body(load_body(), load_motion(clip), num_frames=LAST_FRAME + 2)
    scene = prepare_scene(load_garment(garment, vertices=vertices), poses)
    states, inputs = trajectory_states(rollout_scene(None, scene, SimConfig(iterations=ROLLOUT)), scene)

    @jax.jit
    def solve(scene, state, step) -> Frame:
        problem = frame_problem(scene, state, step)
        start, initial = initial_guess(problem)
        matrix = stretched_stiffness(problem, start)
        best = minimize(lambda x: potential(x, problem), start, matrix, Stop(TRUTH)).value
        return Frame(problem, start, initial, best)

    rows = np.linspace(1, LAST_FRAME, count).round().astype(int)
    return [solve(scene, *jax.tree.map(lambda leaf, row=row: leaf[row], (states, inputs))) for row in rows]


def places_of(frame: Frame) -> Places:
    """Return what the factors are made from."""
    problem, start = frame.problem, frame.start
    gradient = jax.grad(potential)(start, problem)
    return Places(problem, start, stretched_stiffness(problem, start), gradient)


def inverse_of(factors: Factors, places: Places) -> Callable[[Vectors], Vectors]:
    """Return the changed preconditioner."""
    matrix, start, problem = places.matrix, places.start, places.problem
    springs = matrix.springs * jnp.exp(factors.springs)
    share = 1.0 + 0.02 * jnp.exp(factors.dominance)
    diagonal = jnp.exp(factors.rest) * rest_of(matrix) + share * jnp.sum(springs, axis=1)
    balance = stiffness_inverse(Stiffness(diagonal, matrix.neighbors, springs))
    edges = safe_normalize(start[matrix.neighbors] - start[:, None])
    along = sum_products("vd,vdi->vdi", factors.edges, edges)
    turn = jnp.eye(3)[None] + sum_products("vdi,vdj->vij", along, edges)
    for size, axis in ((factors.normal, normals_of(places)), (factors.contact, body_normals(problem))):
        turn = turn + size[:, None, None] * axis[:, :, None] * axis[:, None, :]
    return lambda force: sum_products("vij,vj->vi", turn, balance(sum_products("vij,vj->vi", turn, force)))


def rest_of(matrix: Stiffness) -> Float[Array, " vertices"]:
    """Return the diagonal without springs [N/m]."""
    return jnp.maximum(matrix.diagonal - jnp.sum(matrix.springs, axis=1), 1e-9)


def normals_of(places: Places) -> Vectors:
    """Return the cloth's normals."""
    garment = places.problem.garment
    return vertex_normals(places.start, garment.faces, garment.face_incidence)


def body_normals(problem: FrameProblem) -> Vectors:
    """Return the body's normals at the nearest points."""
    assert problem.body is not None
    return problem.body.nearest.next_normals


def heights_of(places: Places) -> Float[Array, " vertices"]:
    """Return heights over the body's tangent planes [m]."""
    assert places.problem.body is not None
    points = places.problem.body.nearest.next_points
    return jnp.sum((places.start - points) * body_normals(places.problem), axis=1)


def strains_of(places: Places) -> Float[Array, "vertices degree"]:
    """Return the strain of the edges around every vertex; zero where padded."""
    garment = places.problem.garment
    lengths, rest = (
        safe_norm(points[garment.neighbors] - points[:, None])
        for points in (places.start, garment.rest_positions)
    )
    is_real = garment.neighbor_mask & (rest > 0)
    return jnp.where(is_real, lengths / jnp.where(is_real, rest, 1.0) - 1.0, 0.0)


class Numbers(nn.Module):
    """Factors by twelve numbers: of compression and stretch, of contact, and of the share that is no spring."""

    @nn.compact
    def __call__(self, places: Places) -> Factors:
        """Return the factors."""
        matrix, garment, body = places.matrix, places.problem.garment, places.problem.body
        assert body is not None
        k = self.param("numbers", nn.initializers.zeros, (12,))
        share = rest_of(matrix) / matrix.diagonal
        is_touching = body.nearest.is_near & (heights_of(places) < TOUCHING)
        touch = is_touching.astype(share.dtype)
        strain = strains_of(places) / 0.05
        pressed, pulled = jnp.clip(strain, -2.0, 0.0), jnp.clip(strain, 0.0, 2.0)
        return Factors(
            springs=k[0] * pressed + k[1] * pulled,
            rest=k[2] + k[3] * touch,
            dominance=jnp.full(share.shape, k[4]),
            normal=k[5] + k[6] * share + k[7] * touch,
            contact=(k[8] + k[9] * share) * touch,
            edges=(k[10] * pressed + k[11] * pulled) / degrees_of(garment)[:, None],
        )


class Network(nn.Module):
    """Factors by LSDMP layers, from features that don't turn with the scene."""

    @nn.compact
    def __call__(self, places: Places) -> Factors:
        """Return the factors."""
        garment, body = places.problem.garment, places.problem.body
        assert body is not None
        graph = mesh_graph(garment)
        tables, incoming = mesh_tables(graph, places.start.dtype), graph.globals["incoming_edges"]
        vertices, edges = vertex_features(places), edge_features(places)
        vertices = MLP(vertices.shape[1], WIDTH, WIDTH, 1)(vertices)
        edges = MLP(edges.shape[1], WIDTH, WIDTH, 1)(edges)
        latents = Latents(vertices, edges, sum_receivers(edges, tables))
        config = ModelConfig(latent_size=WIDTH, hidden_layers=1)
        for _ in range(LAYERS):
            latents, _ = LsdmpLayer(config)(latents, LayerTables(tables, jnp.zeros((len(vertices), 1))))
        of_vertex = MLP(WIDTH, WIDTH, 4, 1, norm=False, output_gain=0.05)(latents.garment).T
        of_edge = MLP(WIDTH, WIDTH, 2, 1, norm=False, output_gain=0.05)(latents.mesh).T

        def around(values: Float[Array, " edges"]) -> Float[Array, "vertices degree"]:
            return jnp.where(garment.neighbor_mask, jnp.append(values, 0.0)[incoming], 0.0)

        return Factors(
            springs=around(0.5 * (of_edge[0] + of_edge[0][garment.reverse_edges])),  # the same both ways
            rest=of_vertex[0],
            dominance=of_vertex[1],
            normal=of_vertex[2],
            contact=jnp.where(body.nearest.is_near, of_vertex[3], 0.0),
            edges=3.0 * around(of_edge[1]) / degrees_of(garment)[:, None],
        )


def degrees_of(garment: Garment) -> Float[Array, " vertices"]:
    """Return the number of neighbours of every vertex, at least one."""
    return jnp.maximum(jnp.sum(garment.neighbor_mask, axis=1), 1).astype(jnp.float32)


def mesh_graph(garment: Garment) -> jraph.GraphsTuple:
    """Return the graph of the mesh, without features."""
    incoming = incoming_edges(garment.neighbor_mask, garment.receivers.shape[0])
    return jraph.GraphsTuple(
        nodes=None,
        edges=None,
        senders={"mesh": garment.senders},
        receivers={"mesh": garment.receivers},
        globals={"reverse_edges": garment.reverse_edges, "incoming_edges": incoming},
        n_node=None,
        n_edge=None,
    )


def vertex_features(places: Places) -> Float[Array, "vertices features"]:
    """Return stiffness, force, curvature and contact of every vertex, about one in size."""
    problem, matrix, gradient = places.problem, places.matrix, places.gradient
    garment, body = problem.garment, problem.body
    assert body is not None
    mass = jnp.maximum(problem.masses, 1e-9)
    rest, force = rest_of(matrix), safe_norm(gradient)
    direction = safe_normalize(gradient)
    offsets = places.start[garment.neighbors] - places.start[:, None]  # padded with zeros
    bow = safe_norm(jnp.sum(offsets, axis=1)) / jnp.maximum(jnp.sum(safe_norm(offsets), axis=1), 1e-9)
    normal, body_normal, height = normals_of(places), body_normals(problem), heights_of(places)
    columns = [
        jnp.log(rest * problem.inertial_timestep**2 / mass) / 3.0,
        jnp.log1p(jnp.sum(matrix.springs, axis=1) / rest) / 3.0,
        jnp.arcsinh(force / (problem.constants.gravity * mass)) / 3.0,
        jnp.sum(direction * normal, axis=1),
        jnp.sum(direction * body_normal, axis=1),
        jnp.sum(normal * body_normal, axis=1),
        3.0 * bow,
        jnp.clip(height / 0.005, -3.0, 3.0),
        jnp.clip(height / 0.05, -3.0, 3.0),
        body.nearest.is_near.astype(mass.dtype),
        garment.is_pinned.astype(mass.dtype),
        degrees_of(garment) / 6.0 - 1.0,
    ]
    return jnp.stack([jnp.where(garment.vertex_mask, column, 0.0) for column in columns], axis=1)


def edge_features(places: Places) -> Float[Array, "edges features"]:
    """Return strain, rest length, bend and slope of every directed edge, about one in size."""
    garment, start = places.problem.garment, places.start
    senders, receivers, is_real = garment.senders, garment.receivers, garment.edge_mask
    vector = start[senders] - start[receivers]
    rest = safe_norm(garment.rest_positions[senders] - garment.rest_positions[receivers])
    strain = safe_norm(vector) / jnp.where(is_real, rest, 1.0) - 1.0
    mean = mean_edge_length(garment, garment)
    direction, normal = safe_normalize(vector), normals_of(places)
    columns = [
        jnp.clip(strain / 0.1, -5.0, 5.0),
        jnp.clip(strain / 0.01, -2.0, 2.0),
        rest / mean - 1.0,
        1.0 - jnp.sum(normal[senders] * normal[receivers], axis=1),
        3.0 * jnp.sum(direction * normal[receivers], axis=1),
        3.0 * jnp.sum(direction * normal[senders], axis=1),
        jnp.sum(direction * body_normals(places.problem)[receivers], axis=1),
    ]
    return jnp.stack([jnp.where(is_real, column, 0.0) for column in columns], axis=1)


MAKERS: dict[str, nn.Module | None] = {"solver": None, "numbers": Numbers(), "network": Network()}


def energies(maker: nn.Module | None, params: Any, frame: Frame, count: int) -> Float[Array, " energies"]:
    """Return the energies [J] at the start and after every L-BFGS iteration; differentiable by `params`."""
    places = places_of(frame)
    inverse = stiffness_inverse(places.matrix)
    if maker is not None:
        inverse = inverse_of(maker.apply(params, places), places)  # type: ignore[arg-type]
    return descend(partial(potential, problem=frame.problem), frame.start, inverse, count)


def descend(
    energy: Callable[[Vectors], Array], start: Vectors, inverse: Callable[[Vectors], Vectors], count: int
) -> Float[Array, " energies"]:
    """Return the energies of L-BFGS as `minimize` runs it, by the two-loop recursion and for reverse mode.

    The size of a step is found by a loop that has no derivative, and is held constant.

    Source: Nocedal and Wright 2006, algorithms 7.4 and 7.5.
    """
    first, gradient = jax.value_and_grad(energy)(start)

    def direction(gradient, steps, changes, weights, scale):
        left, shares = gradient, []
        for k in reversed(range(MEMORY)):
            shares.append(weights[k] * jnp.sum(steps[k] * left))
            left = left - shares[-1] * changes[k]
        move = scale * inverse(left)
        for k in range(MEMORY):
            back = weights[k] * jnp.sum(changes[k] * move)
            move = move + steps[k] * (shares[MEMORY - 1 - k] - back)
        return -move

    def size_of(x, value, move, slope):
        slack = 4 * jnp.finfo(value.dtype).eps * jnp.abs(value)

        def is_wanting(carry):
            size, trials, found = carry
            return (trials == 0) | ((found > value + 1e-4 * size * slope + slack) & (trials <= 10))

        def halve(carry):
            size, trials, _ = carry
            size = jnp.where(trials == 0, 1.0, 0.5 * size)
            return size, trials + 1, energy(x + size * move)

        size, _, found = jax.lax.while_loop(is_wanting, halve, (jnp.float32(0), jnp.int32(0), value))
        return jnp.where(found <= value + slack, size, 0.0)

    def iterate(carry, _):
        x, value, gradient, steps, changes, weights, scale = carry
        move = direction(gradient, steps, changes, weights, scale)
        given = jax.lax.stop_gradient((x, value, move, jnp.sum(move * gradient)))
        onward = x + jax.lax.stop_gradient(size_of(*given)) * move
        value, next_gradient = jax.value_and_grad(energy)(onward)
        step, change = onward - x, next_gradient - gradient
        curvature = jnp.sum(step * change)
        sizes = jax.lax.stop_gradient(jnp.sum(step * step) * jnp.sum(change * change))
        is_useful = curvature > 1e-10 * jnp.sqrt(sizes)
        step, change = jnp.where(is_useful, step, 0.0), jnp.where(is_useful, change, 0.0)
        weight = jnp.where(is_useful, 1.0 / jnp.where(is_useful, curvature, 1.0), 0.0)
        weighted = jnp.sum(change * inverse(change))
        scale = jnp.where(is_useful, curvature / jnp.where(is_useful, weighted, 1.0), scale)
        steps, changes = (
            jnp.concatenate([rows[1:], row[None]]) for rows, row in ((steps, step), (changes, change))
        )
        weights = jnp.append(weights[1:], weight)
        return (onward, value, next_gradient, steps, changes, weights, scale), value

    nothing = jnp.zeros((MEMORY, *start.shape))
    carry = (start, first, gradient, nothing, nothing, jnp.zeros(MEMORY), jnp.float32(1))
    _, values = jax.lax.scan(iterate, carry, None, length=count)
    return jnp.append(first, values)


def shares_of(values: Float[Array, " energies"], frame: Frame) -> Float[Array, " energies"]:
    """Return what energies leave of the initial gap."""
    return (values - frame.best) / (frame.initial - frame.best)


def init(maker: nn.Module, places: Places) -> Any:
    """Return new parameters."""
    return draw_weights(maker.init(jax.random.key(0), places), seed=0)


def train(name: str, frames: list[list[Frame]], steps: int) -> Any:
    """Return trained parameters; frames are drawn from one garment after the other."""
    maker = MAKERS[name]
    assert maker is not None
    params = init(maker, places_of(frames[0][0]))
    rate = optax.cosine_decay_schedule(LEARNING_RATES[name], steps)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))
    state = optimizer.init(params)

    def loss_of(params, frame: Frame) -> Array:
        left = shares_of(energies(maker, params, frame, max(TRAINED)), frame)
        return jnp.mean(jnp.log(jnp.maximum(left[jnp.array(TRAINED)], 0.0) + LEAST_GAP))

    @jax.jit
    def update(params, state, frame: Frame):
        loss, gradient = jax.value_and_grad(loss_of)(params, frame)
        is_finite = jnp.isfinite(optax.tree.norm(gradient))
        gradient = jax.tree.map(lambda leaf: jnp.where(is_finite, leaf, 0.0), gradient)
        changes, state = optimizer.update(gradient, state)
        return optax.apply_updates(params, changes), state, loss

    draws, losses = np.random.default_rng(1), []
    for step in range(steps):
        rows = frames[step % len(frames)]
        params, state, loss = update(params, state, rows[draws.integers(len(rows))])
        losses.append(float(loss))
        if (step + 1) % 300 == 0:
            print(f"{name} {step + 1}: loss {np.mean(losses[-300:]):.3f}", flush=True)
    return params


def count_iterations(name: str, params: Any, frames: list[Frame]) -> dict[str, float]:
    """Return mean iterations to 1 % and 0.1 % of the initial gap, and the geometric mean of gaps on the way."""
    curve = jax.jit(partial(energies, MAKERS[name], count=COUNTED))
    left = np.array([shares_of(curve(params, frame), frame) for frame in frames])

    def mean_count(share: float) -> float:
        return float(np.mean([np.argmax(row < share) if np.any(row < share) else COUNTED for row in left]))

    gaps = {f"gap_{k}": float(np.exp(np.mean(np.log(np.maximum(left[:, k], 1e-9))))) for k in TRAINED}
    return {"to_1_percent": mean_count(0.01), "to_0.1_percent": mean_count(0.001), **gaps}


def factor_ms(params: dict[str, Any], frame: Frame, turns: int) -> dict[str, float]:
    """Return the milliseconds that each takes to make its factors, once a frame."""

    def make(name: str) -> Callable:
        maker = MAKERS[name]
        assert maker is not None
        return jax.jit(lambda params, places: maker.apply(params, places))

    places = jax.jit(places_of)(frame)
    calls = {name: (make(name), (params[name], places)) for name in ("numbers", "network")}
    return {name: min(times) for name, times in time_in_turns(calls, turns).items()}


def main() -> None:
    """Train, count and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--steps", type=int, nargs=2, default=[900, 4500], help="of the numbers and the network"
    )
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smoke", action="store_true", help="one garment, two frames, two steps")
    chosen = parser.parse_args()
    train_clips, test_clips, garments, count, turns = TRAIN, TEST, GARMENTS, 6, 15
    sizes = {"1k": garments, "4k": ("tshirt", "dress")}
    if chosen.smoke:
        train_clips, test_clips, garments, count, turns = TEST[:1], TEST[:1], GARMENTS[:1], 2, 1
        sizes, chosen.steps = {"1k": garments}, [2, 2]

    def frames_of(garment: str, clips: tuple[str, ...], size: str) -> list[Frame]:
        return [frame for clip in clips for frame in solved_frames(garment, clip, size, count)]

    frames = [frames_of(garment, train_clips, "1k") for garment in garments]
    params: dict[str, Any] = {"solver": None}
    for name, steps in zip(("numbers", "network"), chosen.steps, strict=True):
        params[name] = train(name, frames, steps)
    sought: dict[str, Any] = {}
    for size, names in sizes.items():
        for garment in names:
            rows = frames_of(garment, test_clips, size)
            sought[f"{garment} {size}"] = {
                name: count_iterations(name, params[name], rows) for name in MAKERS
            }
            print(garment, size, sought[f"{garment} {size}"], flush=True)
    result = {
        "steps": dict(zip(("numbers", "network"), chosen.steps, strict=True)),
        "weights": {name: sum(leaf.size for leaf in jax.tree.leaves(params[name])) for name in MAKERS},
        "numbers": np.asarray(params["numbers"]["params"]["numbers"]).tolist(),
        "frames": {"train": sum(map(len, frames)), "test of a garment": count * len(test_clips)},
        "iterations": sought,
        "factors_ms": factor_ms(params, rows[0], turns),
        "factors_of": f"{garment} {size}",
        **environment(),
    }
    chosen.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(chosen.out / "learned_preconditioner.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
