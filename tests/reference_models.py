"""Plain builds of graph and network: segment sums, concatenations, no shared sums, no custom derivatives.

`plain_network` runs with NumPy in float64 as the oracle of the tests, and with JAX as the baseline of the
benchmarks. It reads the same weights and the same graph as the package and shares no code with it.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np


def numpy_segment_sum(rows, segments, num_segments):
    total = np.zeros((num_segments, *rows.shape[1:]), rows.dtype)
    np.add.at(total, np.asarray(segments), rows)
    return total


# Compiles in half the time; for tests of what is computed, not of how.
quick_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})

SEGMENT_SUMS = {np: numpy_segment_sum, jnp: jax.ops.segment_sum}


def to_float64(tree):
    """Return a pytree as NumPy arrays, floats in float64."""

    def cast(leaf):
        leaf = np.asarray(leaf)
        return leaf.astype(np.float64) if np.issubdtype(leaf.dtype, np.floating) else leaf

    return jax.tree.map(cast, tree)


def plain_norm(x, weights, prefix, xp):
    mean = x.mean(axis=-1, keepdims=True)
    variance = ((x - mean) ** 2).mean(axis=-1, keepdims=True)
    scale, bias = weights[f"{prefix}_scale"], weights[f"{prefix}_bias"]
    return (x - mean) / xp.sqrt(variance + 1e-5) * scale + bias


def plain_mlp(x, weights, xp):
    num_layers = sum(name.startswith("kernel") for name in weights)
    for k in range(num_layers):
        x = x @ weights[f"kernel_{k}"] + weights[f"bias_{k}"]
        if k < num_layers - 1:
            x = xp.maximum(x, 0)
    return plain_norm(x, weights, "norm", xp) if "norm_scale" in weights else x


def plain_layer(latents, graph, weights, config, xp):
    """Paper, eqs. 1-4, edge set by edge set; `latents` maps names of nodes and edges to rows."""
    segment_sum = SEGMENT_SUMS[xp]
    v, b = latents["garment"], latents.get("body")
    num_vertices = v.shape[0]
    senders, receivers = graph.senders, graph.receivers
    has_body = "world" in graph.edges
    moves_body = has_body and "world_reverse" in graph.edges
    concat = lambda *rows: xp.concatenate(rows, axis=1)  # noqa: E731
    new = dict(latents)

    step = plain_mlp(
        concat(v[receivers["mesh"]], v[senders["mesh"]], latents["mesh"]), weights["mesh_mlp"], xp
    )
    mesh_sum = segment_sum(step, receivers["mesh"], num_vertices)
    new["mesh"] = latents["mesh"] + step
    world_sum = xp.zeros_like(mesh_sum)
    if has_body:
        mask = graph.globals["world_mask"][:, None].astype(v.dtype)
        step = plain_mlp(
            concat(v[receivers["world"]], b[senders["world"]], latents["world"]), weights["world_mlp"], xp
        )
        world_sum = segment_sum(step * mask, receivers["world"], num_vertices)
        new["world"] = latents["world"] + step
    new["garment"] = v + plain_mlp(concat(v, mesh_sum, world_sum), weights["vertex_mlp"], xp)
    if moves_body:
        at_body, at_garment = receivers["world_reverse"], senders["world_reverse"]
        step = plain_mlp(
            concat(b[at_body], v[at_garment], latents["world_reverse"]), weights["world_mlp"], xp
        )
        new["world_reverse"] = latents["world_reverse"] + step
        body_sum = segment_sum(step, at_body, b.shape[0])
        new["body"] = b + plain_mlp(concat(b, xp.zeros_like(b), body_sum), weights["vertex_mlp"], xp)
    if not config.smoothing_steps:
        return new

    is_real, degree = real_edges(graph, num_vertices, v.dtype, xp)
    if has_body:
        degree = degree + segment_sum(mask, receivers["world"], num_vertices)
    p, q = new["garment"], new.get("body")
    for _ in range(config.smoothing_steps):
        arriving = (p[senders["mesh"]] + new["mesh"]) * is_real
        total = segment_sum(arriving, receivers["mesh"], num_vertices)
        if has_body:
            arriving = (q[senders["world"]] + new["world"]) * mask
            total = total + segment_sum(arriving, receivers["world"], num_vertices)
        if moves_body:
            q = p[senders["world_reverse"]] + new["world_reverse"]
        p = total / xp.maximum(degree, 1)
    p = xp.where(degree > 0, p, new["garment"])
    smoothed = {"garment": new["garment"] + plain_mlp(p, weights["smooth_mlp"], xp)}
    if moves_body:
        smoothed["body"] = new["body"] + plain_mlp(q, weights["smooth_mlp"], xp)
    return {**new, **smoothed}


def real_edges(graph, num_vertices, dtype, xp):
    """Return one for every mesh edge that is not padding, and the number of these that enter each vertex."""
    is_real = (graph.senders["mesh"] != graph.receivers["mesh"])[:, None].astype(dtype)
    return is_real, SEGMENT_SUMS[xp](is_real, graph.receivers["mesh"], num_vertices)


def exact_attention(queries, keys, values):
    """Return softmax(q k^T / sqrt(size)) v."""
    scores = queries @ keys.T / np.sqrt(queries.shape[1])
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True) @ values


def plain_features(queries, keys, projection, kernel, xp):
    """Random features of attention, unstabilised: float64 holds the exponentials of the tests' sizes."""
    if kernel == "relu":
        return (xp.maximum(x @ projection.T, 0) + 1e-3 for x in (queries, keys))
    scale = queries.shape[1] ** -0.25
    queries, keys = queries * scale, keys * scale
    phi = []
    for x, top in ((queries, "row"), (keys, "all")):
        exponents = x @ projection.T - (x**2).sum(axis=1, keepdims=True) / 2
        largest = exponents.max(axis=1, keepdims=True) if top == "row" else exponents.max()
        phi.append(xp.exp(exponents - largest) + 1e-6)
    return phi


def plain_block(x, embedding, mask, projection, weights, config, xp):
    here = plain_norm(x, weights, "attention_norm", xp) if config.is_attention_normed else x
    located = xp.concatenate([here, embedding / 0.5], axis=1)
    queries, keys, values = located @ weights["query"], located @ weights["key"], here @ weights["value"]
    phi_q, phi_k = plain_features(
        queries, keys, projection, "softmax" if config.is_attention_normed else "relu", xp
    )
    phi_k = phi_k * mask[:, None].astype(x.dtype)
    attended = (phi_q @ (phi_k.T @ values)) / (phi_q @ phi_k.sum(axis=0)[:, None])
    x = x + attended @ weights["output"] + weights["output_bias"]
    if config.is_attention_normed:
        x = x + plain_mlp(plain_norm(x, weights, "feedforward_norm", xp), weights["feedforward"], xp)
    return x


def plain_normalize(rows, normalizer, num_static, xp):
    changing = rows[:, : rows.shape[1] - num_static]
    deviation = xp.maximum(xp.sqrt(normalizer.squared_deviations / xp.maximum(normalizer.count, 1.0)), 1e-8)
    deviation = xp.where(normalizer.count > 0, deviation, 1.0)
    return xp.concatenate([(changing - normalizer.mean) / deviation, rows[:, changing.shape[1] :]], axis=1)


def plain_network(network, graph, garment, xp=np):
    """Return the raw output of the network; everything in the floating type of its inputs."""
    config, weights, statistics = network.config, network.params, network.statistics
    nodes, edges = dict(graph.nodes), dict(graph.edges)
    if "encoder" in weights:
        encoded = plain_encoded_vertices(nodes, edges, graph, weights, xp)
        features = encoded
        for layer in range(config.layers):
            features = plain_smoothing(features, graph, layer_weights(weights["layers"], layer), config, xp)
        return plain_mlp(features, weights["decoder"], xp)
    encoders = {name: weights[f"{name}_encoder"] for name in ("garment", "mesh", "world")}
    encoders["world_reverse"] = encoders["world"]
    if not config.reads_gradient:
        table = weights["type_embedding"]
        for name, rows in nodes.items():
            types = table[graph.globals[f"{name}_type"]]
            rows = xp.concatenate([rows[:, :3], types, rows[:, 3:]], axis=1)
            nodes[name] = plain_normalize(rows, statistics["garment"], 3, xp)
        edges["mesh"] = plain_normalize(edges["mesh"], statistics["mesh"], 3, xp)
        for name in set(edges) & {"world", "world_reverse"}:
            edges[name] = plain_normalize(edges[name], statistics["world"], 0, xp)
        encoders["body"] = encoders["garment"]
    else:
        encoders["body"] = weights["body_encoder"]
    latents = {name: plain_mlp(rows, encoders[name], xp) for name, rows in {**nodes, **edges}.items()}
    encoded = latents["garment"]
    for layer in range(config.message_passing_steps):
        latents = plain_layer(latents, graph, layer_weights(weights["layers"], layer), config, xp)
    return plain_decoder(latents["garment"], encoded, network, garment, xp)


HOOD_STAGES = ("coarse0 mesh", "coarse0 coarse1", "coarse1", "coarse0 coarse1", "coarse0 mesh")


def plain_hood(network, graph):
    """Return the accelerations of the hierarchical network, before the output's normaliser, in NumPy."""
    weights, statistics = network.params, network.statistics
    coarse = graph.globals["coarse"]
    level = np.max([(k + 1) * edges.is_kept for k, edges in enumerate(coarse)], axis=0)
    rows = {}
    is_hood = "type_embedding" in weights
    for name, features in graph.nodes.items():
        if not is_hood:
            is_garment = name == "garment"
            parts = [features, weights["level_embedding"][level]] if is_garment else [features]
            rows[name] = plain_mlp(np.concatenate(parts, axis=1), weights[f"{name}_encoder"], np)
            continue
        embeddings = (
            weights["type_embedding"][graph.globals[f"{name}_type"]],
            weights["level_embedding"][level if name == "garment" else np.zeros_like(level)],
        )
        features = np.concatenate([features[:, :3], *embeddings, features[:, 3:]], axis=1)
        features = plain_normalize(features, statistics["garment"], 3, np)
        rows[name] = plain_mlp(features, weights["garment_encoder"], np)
    for name, features in graph.edges.items():
        kind, num_static = ("world", 0) if name.startswith("world") else ("mesh", 3)
        encoder = weights[f"coarse_encoders_{name}" if name.startswith("coarse") else f"{kind}_encoder"]
        features = plain_normalize(features, statistics[kind], num_static, np) if is_hood else features
        rows[name] = plain_mlp(features, encoder, np)
    for stage, names in enumerate(HOOD_STAGES):
        joined = np.zeros(len(level), bool) | ("mesh" in names)
        for k, edges in enumerate(coarse):
            if f"coarse{k}" in names:
                joined |= edges.is_kept
        for step in range(network.config.steps_per_stage):
            layer = layer_weights(weights[f"stages_{stage}"], step)
            rows = plain_hood_step(rows, graph, layer, names.split(), joined)
    return plain_mlp(rows["garment"], weights["decoder"], np)


def plain_hood_step(rows, graph, weights, names, joined):
    """One step: messages of the stage's edge sets and of the world edges that end where `joined` holds."""
    v, b, new = rows["garment"], rows.get("body"), dict(rows)
    sums = {}
    for name in names:
        ends = [v[graph.receivers[name]], v[graph.senders[name]]]
        step = plain_mlp(np.concatenate([*ends, rows[name]], axis=1), weights[f"edge_mlps_{name}"], np)
        sums[name] = numpy_segment_sum(step, graph.receivers[name], len(v))
        new[name] = rows[name] + step
    sums["world"], nothing = np.zeros_like(v), np.zeros_like(v)
    if b is not None:
        mask = (graph.globals["world_mask"] & joined)[:, None]
        for name, ends in (("world", [v, b]), ("world_reverse", [b, v])):
            step = mask * plain_mlp(np.concatenate([*ends, rows[name]], axis=1), weights["world_mlp"], np)
            sums[name], new[name] = step, rows[name] + step
        inputs = [b, *[nothing for _ in names], sums["world_reverse"]]
        new["body"] = b + plain_mlp(np.concatenate(inputs, axis=1), weights["vertex_mlp"], np)
    inputs = [v, *[sums[name] for name in sorted(names)], sums["world"]]
    new["garment"] = v + plain_mlp(np.concatenate(inputs, axis=1), weights["vertex_mlp"], np)
    return new


def plain_encoded_vertices(nodes, edges, graph, weights, xp):
    """Return vertex latents from rows with the features of vertex, body point and world edge."""
    rows = [nodes["garment"]]
    for features in (nodes["body"], edges["world"]) if "world" in edges else ():
        rows.append(xp.where(graph.globals["world_mask"][:, None], features, 0.0))
    joined = xp.concatenate(rows, axis=1)
    missing = weights["encoder"]["kernel_0"].shape[0] - joined.shape[1]
    joined = xp.concatenate([joined, xp.zeros((len(joined), missing), joined.dtype)], axis=1)
    return plain_mlp(joined, weights["encoder"], xp)


def plain_smoothing(v, graph, weights, config, xp):
    """One layer: every smoothing beside the latents themselves."""
    rows, smoothed = [v], v
    is_real, degree = real_edges(graph, v.shape[0], v.dtype, xp)
    for _ in range(config.smoothing_steps):
        arriving = smoothed[graph.senders["mesh"]] * is_real
        total = SEGMENT_SUMS[xp](arriving, graph.receivers["mesh"], v.shape[0])
        smoothed = total / xp.maximum(degree, 1)
        rows.append(smoothed)
    return v + plain_mlp(xp.concatenate(rows, axis=1), weights["vertex_mlp"], xp)


def plain_decoder(features, encoded, network, garment, xp):
    """Attention beside the layers, and the decoder on both."""
    weights, config = network.params, network.config
    if config.attention_blocks:
        x = encoded
        for block in range(config.attention_blocks):
            x = plain_block(
                x,
                garment.geodesic_embedding,
                garment.vertex_mask,
                network.constants["projection"],
                layer_weights(weights["blocks"], block),
                config,
                xp,
            )
        features = xp.concatenate([features, x], axis=1)
    return plain_mlp(features, weights["decoder"], xp)


def layer_weights(stacked, layer):
    """Return one layer of weights that are stacked along their first axis."""
    return jax.tree.map(lambda leaf: leaf[layer], stacked)


@functools.cache
def trained(config):
    """Return a network whose biases and scales have values that a mistake would show."""
    network, generator = config.new_network(), np.random.default_rng(1)
    return network.replace(
        params=jax.tree.map(
            lambda leaf: leaf + 0.1 * generator.standard_normal(leaf.shape, np.float32), network.params
        )
    )


# --- scene --------------------------------------------------------------------------------------------------


def tube(num_around: int, num_along: int):
    """Return an open tube about half a metre wide and 0.8 m high, counter-clockwise seen from outside."""
    row, column = np.meshgrid(np.arange(num_along), np.arange(num_around), indexing="ij")
    angle = 2 * np.pi * column / num_around
    radius = 0.25 * (1 + 0.05 * np.sin(3 * angle))
    height = 0.8 * row / max(num_along - 1, 1)
    positions = np.stack([radius * np.cos(angle), height, -radius * np.sin(angle)], -1).reshape(-1, 3)
    lower = row[:-1] * num_around + column[:-1]
    right = row[:-1] * num_around + (column[:-1] + 1) % num_around
    upper, upper_right = lower + num_around, right + num_around
    faces = [np.stack([lower, right, upper], -1), np.stack([right, upper_right, upper], -1)]
    return positions, np.concatenate([part.reshape(-1, 3) for part in faces])


def make_scene(num_around: int, num_along: int, *, body: bool = True, pad: bool = False, seed: int = 0):
    """Return a tube, a fabric and random inputs; every tenth vertex is beyond the radius of world edges."""
    from eslr_jax import prepare_garment
    from eslr_jax.fabric.materials import COTTON
    from eslr_jax.networks.features import RefinementInputs
    from eslr_jax.types import Contacts

    positions, faces = tube(num_around, num_along)
    num_real = len(positions)
    is_pinned = positions[:, 1] > 0.79
    garment = prepare_garment(
        positions,
        faces,
        skin_weights=np.ones((num_real, 1)),
        skin_indices=np.zeros((num_real, 1), int),
        is_pinned=is_pinned,
        pad=pad,
    )
    garment = jax.tree.map(jnp.asarray, garment)
    num_vertices = garment.rest_positions.shape[0]
    generator = np.random.default_rng(seed)

    def noise(scale, *columns):
        rows = scale * generator.standard_normal((num_real, *columns))
        return jnp.asarray(
            np.pad(rows, ((0, num_vertices - num_real), *[(0, 0)] * len(columns))), jnp.float32
        )

    position = garment.rest_positions + noise(0.003, 3)
    outward = np.asarray(position) * [1, 0, 1]
    normals = jnp.asarray(outward / np.linalg.norm(outward, axis=1, keepdims=True), jnp.float32)
    next_normals = normals + noise(0.1, 3)
    next_normals = next_normals / jnp.linalg.norm(next_normals, axis=1, keepdims=True)
    distances = jnp.where(jnp.arange(num_vertices) % 10 == 3, 0.05, 0.01 + noise(0.004))
    points = position - normals * distances[:, None]
    material = jax.tree.map(jnp.asarray, COTTON)
    weight = 9.81 * material.density * garment.vertex_areas
    contacts = Contacts(
        points=points,
        next_points=points + noise(0.01, 3),
        normals=normals,
        next_normals=next_normals,
        distances=distances,
        is_near=distances < 0.04,
        faces=jnp.zeros(len(distances), jnp.int32),
    )
    velocity = noise(0.01, 3)
    inputs = RefinementInputs(
        position=position,
        velocity=velocity,
        timestep=jnp.float32(1 / 30),
        contacts=contacts if body else None,
        inertial_guess=position + velocity,
        guess=position + velocity + noise(0.002, 3),
        gradient=weight[:, None] * noise(1.0, 3),
        step=noise(0.003, 3),
        weight=weight,
        correction=noise(0.002, 3),
        previous_gradient=weight[:, None] * noise(2.0, 3),
    )
    return garment, material, inputs
