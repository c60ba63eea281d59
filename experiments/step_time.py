"""Time a step of the networks: the package's build against a plain one, reduced precision, and PyTorch.

    python experiments/step_time.py

All builds of a comparison run alternately (A B A B ...) in one process and are compared as ratios of medians.
Compilation and temporary memory are reported apart. The comparison with PyTorch (extra `bench`) runs in a process
of its own on one core; without PyTorch it is left out.

Writes step_time.json.
"""

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
from harness import EXPERIMENTS, cores, keep, parser

from eslr_jax.networks.apply import apply_model, measure_statistics, merge_statistics
from eslr_jax.networks.build import build_graph
from eslr_jax.networks.registry import MODELS
from eslr_jax.pipeline.report.report import environment
from eslr_jax.pipeline.report.scene_parts import time_in_turns
from eslr_jax.training.loop import keep_memory

sys.path.append(str(EXPERIMENTS.parent / "tests"))  # of reference_models

SIZES = {"1k": (32, 32), "4k": (64, 64), "12k": (110, 110), "50k": (224, 224)}
MODEL = "eslr-15"
OPTIMIZER = optax.adam(1e-4)


def take_turns(functions: dict, turns: int) -> dict[str, float]:
    """Return the median milliseconds of compiled functions, called in turns after one warm-up."""
    return {name: float(np.median(times)) for name, times in time_in_turns(functions, turns).items()}


def compile_timed(function, args) -> tuple:
    """Return the compiled function, and its seconds of compilation and MB of temporary memory."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*args).compile()
    seconds = time.perf_counter() - start
    memory = compiled.memory_analysis()
    return compiled, {
        "compile_s": round(seconds, 3),
        "temporary_mb": round(memory.temp_size_in_bytes / 1e6, 1) if memory else None,
    }


def load(model: str, size: str) -> tuple:
    """Return network, graph and garment of a tube of that size."""
    from reference_models import make_scene

    network = MODELS[model].new_network()
    scene = make_scene(*SIZES[size])
    graph = jax.jit(lambda *scene: build_graph(*scene, network.config.graph))(*scene)
    measured = measure_statistics(network, graph, scene[0], scene[2].velocity)
    return merge_statistics(network, measured), graph, scene[0]


def builds_of(config) -> dict:
    """Return the three builds of a network, each a function of (network, graph, garment)."""
    from reference_models import plain_network

    reduced = dataclasses.replace(config, precision="bfloat16")
    return {
        "plain": lambda *args: plain_network(*args, jnp),
        "exact": apply_model,
        "reduced": lambda network, *args: apply_model(network.replace(config=reduced), *args),
    }


def training_step(build):
    """Return a step of Adam on a quadratic loss: forward, backward, update."""

    def step(network, graph, garment, state):
        def loss(params):
            return jnp.sum(build(network.replace(params=params), graph, garment) ** 2)

        update, state = OPTIMIZER.update(jax.grad(loss)(network.params), state)
        return optax.apply_updates(network.params, update), state

    return step


def measure_size(size: str, turns: int, training: bool) -> dict:
    """Return times, compile times and memory of every build at one size."""
    network, graph, garment = load(MODEL, size)
    result: dict = {
        "vertices": int(garment.vertex_areas.shape[0]),
        "edges": int(garment.senders.shape[0]),
        "builds": {},
    }
    args, builds, times = (network, graph, garment), builds_of(network.config), {}
    kinds: dict[str, tuple] = {"forward": (builds, args, turns)}
    if training:
        steps = {name: training_step(build) for name, build in builds.items()}
        kinds["train"] = (steps, (*args, OPTIMIZER.init(network.params)), max(3, turns // 2))
    for kind, (functions, given, repeats) in kinds.items():
        compiled = {}
        for name, function in functions.items():
            program, result["builds"][f"{kind}_{name}"] = compile_timed(function, given)
            compiled[f"{kind}_{name}"] = (program, given)
        times |= take_turns(compiled, repeats)
    for name, milliseconds in times.items():
        result["builds"][name]["run_ms"] = round(milliseconds, 2)
        result["builds"][name]["us_per_vertex"] = round(1e3 * milliseconds / result["vertices"], 2)
    for kind in kinds:
        for build in ("exact", "reduced"):
            result[f"{kind}_{build}_vs_plain"] = ratio(times, f"{kind}_plain", f"{kind}_{build}")
    return result


def ratio(times: dict[str, float], slow: str, fast: str) -> float:
    """Return how many times as fast `fast` is."""
    return round(times[slow] / times[fast], 3)


def measure_torch(size: str, turns: int) -> dict:
    """Return ratios to PyTorch; to be called in a process bound to one core."""
    import torch
    import torch_meshgraphnet

    functions, garment = {}, None
    for model in ("eslr-15", "mgn-15"):
        network, graph, garment = load(model, size)
        for name, build in builds_of(network.config).items():
            if name != "plain":
                args = (network, graph, garment)
                functions[f"{model} {name}"] = (compile_timed(build, args)[0], args)
    edges = (np.asarray(garment.senders), np.asarray(garment.receivers))
    functions["torch mgn-15"] = (torch_meshgraphnet.make_forward(*edges, garment.vertex_areas.shape[0]), ())
    times = take_turns(functions, turns)
    return {
        "torch": torch.__version__,
        "threads": 1,
        "run_ms": {name: round(milliseconds, 1) for name, milliseconds in times.items()},
        **{
            f"{model}_{build}_vs_torch_mgn15": ratio(times, "torch mgn-15", f"{model[:-2]}-15 {build}")
            for model in ("eslr15", "mgn15")
            for build in ("exact", "reduced")
        },
    }


def torch_in_a_process(size: str, turns: int, keeps_memory: bool) -> dict | None:
    """Run `measure_torch` on one core, or return None where that is not possible."""
    if importlib.util.find_spec("torch") is None or not hasattr(os, "sched_setaffinity"):
        return None
    core = max(os.sched_getaffinity(0))
    code = (
        f"import json, os; os.sched_setaffinity(0, {{{core}}})\n"
        f"import step_time; {keeps_memory} and step_time.keep_memory()\n"
        f"print(json.dumps(step_time.measure_torch({size!r}, {turns})))"
    )
    process: dict = {"env": {**os.environ, "OMP_NUM_THREADS": "1"}, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-c", code], check=False, cwd=EXPERIMENTS, **process)
    if done.returncode:
        print(done.stderr[-2000:], file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parsed = parser(__doc__, "1k, one turn, neither training nor PyTorch")
    parsed.add_argument("--sizes", nargs="+", default=["1k", "4k"], choices=SIZES, help="vertices")
    parsed.add_argument("--turns", type=int, default=10, help="turns per comparison")
    parsed.add_argument("--no-training", action="store_true", help="leave the training steps out")
    parsed.add_argument("--no-torch", action="store_true", help="leave the comparison with PyTorch out")
    parsed.add_argument(
        "--keep-memory", action="store_true", help="keep freed memory, for both sides (glibc)"
    )
    options = parsed.parse_args()
    if options.smoke:
        options.sizes, options.turns, options.no_training, options.no_torch = ["1k"], 1, True, True
    if options.keep_memory:
        keep_memory()

    sizes = {}
    for size in options.sizes:
        print(f"{size}: {MODEL} ...", file=sys.stderr)
        sizes[size] = measure_size(size, options.turns, not options.no_training)
        if not options.no_torch:
            print(f"{size}: PyTorch ...", file=sys.stderr)
            sizes[size]["torch"] = torch_in_a_process(size, options.turns, options.keep_memory)
    report = {
        "model": MODEL,
        "sizes": sizes,
        "cores": cores(),
        "keeps_memory": options.keep_memory,
        "load": round(os.getloadavg()[0], 1),
        **environment(),
    }
    keep(options.out / "step_time.json", report)
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
