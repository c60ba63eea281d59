"""The paper's tables: every system beside its controls, the solver and the optimum.

    python experiments/paper tables [--tables native_garments unseen_garments new_motion model_cost]
        [--models LABEL=NAME,NAME ...] [--controls] [--anew] [--clips NAME ...] [--frames 100] [--smoke]

native_garments (I, II): six garments on three unseen clips. unseen_garments (III): garments that no network has
seen, with other modes of the geodesic embedding. new_motion (IV): every third clip of DeepMimic, where the paper
takes a Mixamo character. model_cost (V): parameters, layers, latency and memory on the T-shirt, from 4k on also
of the full-size networks; and the Total of Table I where that was measured at the same size.

A row is LABEL=NAME,NAME: networks that differ by their seed, whose mean and spread it shows. A name is that of a
bundled network or an exported file, see `rollouts.read_system`. A second row is of the same network untrained.
--controls adds it with a decoder of zeros, and with zero and with random geodesic coordinates.

A table is never written over one of another setting, nor a row that names its networks over one of others: give
another --out or label. A row that a table has is kept, and not measured again. Rows are written one by one, each
with the versions and the device that made it, so that several runs can fill a table.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import harness
import jax
import numpy as np

from eslr_jax import SimConfig, load_body, load_garment, load_motion, pose_body, prepare_scene
from eslr_jax.networks.hood import STAGES, Hood
from eslr_jax.networks.registry import MODELS
from eslr_jax.pipeline.assets import load_splits
from eslr_jax.pipeline.assets.models import DEFAULT_MODEL, START_MODEL
from eslr_jax.pipeline.report.report import environment
from eslr_jax.pipeline.report.scene_parts import take_turns
from eslr_jax.simulation.frame import frame_inputs, frame_problem
from eslr_jax.simulation.stepper import make_stepper
from eslr_jax.terms import FAST
from paper.rollouts import (
    CONTROLS,
    CONTROLS_OF_WEIGHTS,
    GUESS,
    OPTIMUM,
    RESULTS,
    Reference,
    Setting,
    System,
    find_references,
    measure_system,
    read_system,
)

WEIGHTS = RESULTS / "weights"  # seeds that are not bundled
# Applied once a frame. They were trained by configs/paper/1k.toml, and then for as many steps again at half its
# learning rate. hood-5 has a fifth of the steps. The other networks have recipes of their own.
DEEP = (
    f"mgn-5=mgn-5-correction,{WEIGHTS / 'mgn-5_60k_s1.npz'}",
    "hood-5=hood-5-correction",
    "gsa-5=gsa-5-correction",
    "lsdmp-5=lsdmp-5-correction",
    f"eslr-5=eslr-5-correction,{WEIGHTS / 'eslr-5_60k_s1.npz'}",
)
BUNDLED = (
    f"eslr-small={DEFAULT_MODEL}",
    *(f"{START_MODEL}+{iterations}={START_MODEL}+{iterations}" for iterations in (5, 20)),
)
SYSTEMS = (f"guess={GUESS}", *DEEP, *BUNDLED, f"optimum={OPTIMUM}")
FULL_SIZE = ("mgn-48", "mgn-15", "eslr-15", "eslr-10", "hood")
# Of a table of energies, each by the labels of its rows; notes are written by hand.
PARTS = ("mean", "seeds", "garments", "networks", "environments", "notes")
TABLES = ("native_garments", "unseen_garments", "new_motion", "model_cost")
_CLIPS = 3  # of the test split, if none are given
_NEW_MOTION_FRAMES = 60  # the clips are short
_LAYERS = ("message_passing_steps", "steps_per_stage", "layers")  # by system, of HOOD's in each stage
_TURNS = 7  # in which latencies are measured

Rows = dict[str, tuple[str, ...]]


def main() -> None:
    parser = harness.parser(__doc__, "few frames of one garment on one clip", RESULTS)
    parser.add_argument("--vertices", default="1k", choices=["1k", "4k", "10k"])
    parser.add_argument("--tables", nargs="+", default=TABLES, choices=TABLES)
    parser.add_argument("--models", nargs="+", metavar="LABEL=NAME,NAME", help="rows")
    parser.add_argument("--controls", action="store_true", help="rows for each network's controls")
    parser.add_argument(
        "--anew", action="store_true", help="measure rows again that the table has; others stay in any case"
    )
    parser.add_argument("--clips", nargs="+", help="only these")
    parser.add_argument("--garments", nargs="+", help="only these")
    parser.add_argument("--frames", type=int, default=100, help="of every rollout")
    chosen = parser.parse_args()
    if chosen.smoke:
        chosen.models, chosen.frames = chosen.models or (DEEP[-1], f"optimum={OPTIMUM}"), 5
    rows = {
        label: tuple(names.split(","))
        for label, names in (row.split("=", 1) for row in chosen.models or SYSTEMS)
    }
    cost_file = chosen.out / f"model_cost_{chosen.vertices}.json"
    if "model_cost" in chosen.tables:  # before anything is trained and measured
        check_costs(cost_file, (*rows, *full_size(chosen.vertices, chosen.smoke)))
    for name in chosen.tables:
        if name == "model_cost":
            costs = cost_table(rows, chosen.vertices, chosen.smoke)
            harness.keep(cost_file, with_totals(costs, chosen.out / f"{TABLES[0]}.json"))
        else:
            setting = table_setting(name, chosen.clips, chosen.garments, chosen.frames, chosen.vertices)
            if not (setting.garments and setting.clips):
                print(f"{name}: left out, as none of its garments or none of its clips is asked for")
                continue
            if chosen.smoke:
                setting = setting._replace(garments=setting.garments[:1], clips=setting.clips[-1:])
            file = chosen.out / f"{name}.json"
            parts = rows_of_setting(file, setting)
            has_controls = chosen.controls or (chosen.smoke and name == TABLES[0])
            asked = with_changes(rows, name, has_controls)
            if not chosen.anew:
                check_networks(file, asked, parts["networks"])
            missing = asked if chosen.anew else {k: row for k, row in asked.items() if k not in parts["mean"]}
            references = find_references(setting) if missing else []
            for label, networks in missing.items():
                row = measure_row(networks, setting, references)
                parts = with_row(rows_of_setting(file, setting), label, row)  # another run may have written
                harness.keep(file, {**setting._asdict(), **parts})


def table_setting(
    table: str, clips: Sequence[str] | None, garments: Sequence[str] | None, frames: int, vertices: str
) -> Setting:
    """Return the garments and clips of a table; those that are given are taken where they belong to it."""
    splits = load_splits()
    kinds = splits["garments"]
    if table == "new_motion":
        all_clips, all_garments = splits["motions"]["unseen_motion"], [*kinds["train"], *kinds["unseen"]]
        own_clips, own_garments = all_clips[::3], ["tshirt", "dress"]
        frames = min(frames, _NEW_MOTION_FRAMES)
    else:
        all_clips = splits["motions"]["test"]
        all_garments = own_garments = kinds["unseen" if table == "unseen_garments" else "train"]
        own_clips = all_clips[:_CLIPS]
    worn = own_garments if garments is None else [name for name in garments if name in all_garments]
    played = own_clips if clips is None else [name for name in clips if name in all_clips]
    return Setting(tuple(worn), tuple(played), frames, vertices)


def with_changes(rows: Rows, table: str, has_controls: bool) -> Rows:
    """Return the rows of a table: with those of the controls, and of other embeddings for unseen garments."""
    changed = dict(rows)
    for label, (name, *_) in rows.items():
        network = read_system(name).network
        if network is not None and "~" not in name:  # which is a control or another mode itself
            has_attention = getattr(network.config, "attention_blocks", 0) > 0
            fitting = CONTROLS if has_attention else CONTROLS_OF_WEIGHTS
            changes = fitting if has_controls else fitting[:1]
            if table == "unseen_garments" and has_attention:
                changes = (*changes, "raw", "landmarks")
            changed |= {f"{label}, {change}": (f"{name}~{change}",) for change in changes}
    return changed


def measure_row(names: Sequence[str], setting: Setting, references: list[Reference]) -> dict[str, Any]:
    """Return the parts of a row: means over its seeds, and the seeds' own if there are several."""
    seeds = [measure_system(name, setting, references) for name in names]
    means = {
        garment: {column: float(np.mean([seed[garment][column] for seed in seeds])) for column in row}
        for garment, row in seeds[0].items()
    }
    row = {
        "mean": {**means.pop("all"), "seeds": len(seeds), **training_cost(names)},
        "garments": means,
        "networks": [short_name(name) for name in names],
        "environments": environment(),
    }
    if len(seeds) > 1:
        row["seeds"] = {column: [seed["all"][column] for seed in seeds] for column in seeds[0]["all"]}
    return row


def with_row(parts: dict[str, dict[str, Any]], label: str, row: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the parts of a table with another row, or a new one in its place.

    Rows that stand beside the same network untrained say what learning removes of the gap.
    """
    changed = {
        name: {**rows, label: row[name]} if name in row else {k: v for k, v in rows.items() if k != label}
        for name, rows in parts.items()
    }
    means = changed["mean"]
    for name in means:
        if untrained := means.get(f"{name}, untrained"):
            learned = untrained["gap_share"] - means[name]["gap_share"]
            means[name] = {**means[name], "learned_share": learned}
    return changed


def training_cost(names: Sequence[str]) -> dict[str, float]:
    """Return parameters of a row's network, and the core-hours of all its seeds where each is known."""
    costs = [dict(read_system(name).cost) for name in names]
    hours = [cost.pop("core_hours", None) for cost in costs]
    return costs[0] if None in hours else {**costs[0], "core_hours": sum(hours)}


def rows_of_setting(file: Path, setting: Setting) -> dict[str, dict[str, Any]]:
    """Return the parts of a table that was written before, row by row; empty ones where there is none.

    One of other garments, clips, frames or vertices may not be written over: SystemExit says which differ.
    """
    found = harness.kept(file)
    parts = {name: found.get(name, {}) for name in PARTS}
    asked = {"clips": list(setting.clips), "frames": setting.frames, "vertices": setting.vertices}
    differs = [name for name, value in asked.items() if found.get(name, value) != value]
    if any(set(row) != set(setting.garments) for row in parts["garments"].values()):
        differs.append("garments")
    if differs:
        raise SystemExit(
            f"{file} is of other {', '.join(differs)}; give another --out, or move the file away"
        )
    return parts


def check_networks(file: Path, rows: Rows, kept: dict[str, list[str]]) -> None:
    """Refuse to take a row that the table has for one of other networks: SystemExit names both."""
    for label, names in rows.items():
        if label in kept and kept[label] != [short_name(name) for name in names]:
            own = ", ".join(kept[label])
            raise SystemExit(
                f"{file} has a row {label} of {own}; give another label, or --anew to replace it"
            )


def short_name(name: str) -> str:
    """Return a name of `read_system` that is the same on another machine: of a path the last two parts."""
    return "/".join(Path(name).parts[-2:])


def full_size(vertices: str, is_smoke: bool) -> tuple[str, ...]:
    """Return the architectures without weights whose cost is measured too."""
    if is_smoke:
        return FULL_SIZE[-1:]
    return FULL_SIZE if vertices != "1k" else ()


def check_costs(file: Path, names: Sequence[str]) -> None:
    """Refuse to write over a table with rows that would be lost, as times compare only within a run."""
    found = harness.kept(file).get("mean", {})
    if lost := [name for name in found if name not in names]:
        raise SystemExit(f"{file} has rows for {', '.join(lost)}; measure them too, or give another --out")


def cost_table(rows: Rows, vertices: str, is_smoke: bool) -> dict[str, Any]:
    """Return what systems and the full-size networks cost: a frame of the T-shirt, contact search included.

    Memory is what XLA allocates for the call, weights included.
    """
    read = {label: read_system(name) for label, (name, *_) in rows.items()}
    systems = {label: system for label, system in read.items() if system.network_on is None}
    for name in full_size(vertices, is_smoke):
        if name in systems:  # with its weights, and what they cost
            continue
        network = MODELS[name].new_network()
        cost = {"parameters": network.num_parameters}
        systems[name] = System(network, SimConfig(iterations=0), cost, network.garment_options)
    poses = pose_body(load_body(), load_motion("cmu_016_32"), num_frames=2)
    parts, found = {}, {}
    for label, system in systems.items():
        garment = load_garment("tshirt", vertices=vertices, **system.garment_options)  # type: ignore[arg-type]
        scene = prepare_scene(garment, poses, terms=FAST)
        inputs = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))

        def forward(network, state, config=system.config, scene=scene, inputs=inputs):
            return make_stepper(network, config)(frame_problem(scene, state, inputs), state)[0].position

        arguments = system.network, scene.initial_state
        memory: Any = jax.jit(forward).lower(*arguments).compile().memory_analysis()
        parts[label] = (forward, arguments)
        size = memory.temp_size_in_bytes + memory.argument_size_in_bytes
        found[label] = {**system.cost, "memory_mb": size / 1e6}
        if system.network is not None:
            config = system.network.config
            layers = next(getattr(config, name) for name in _LAYERS if hasattr(config, name))
            found[label] |= {
                "layers": layers * (len(STAGES) if isinstance(config, Hood) else 1),
                "refinement_steps": config.refinement_steps,
            }
    for label, milliseconds in take_turns(parts, 1 if is_smoke else _TURNS).items():
        found[label]["latency_ms"] = milliseconds
    return {"vertices": vertices, "mean": found, "environment": environment()}


def with_totals(costs: dict[str, Any], energies: Path) -> dict[str, Any]:
    """Return the table of costs with the Total [J] of the rows that a table of energies at its size has."""
    found = harness.kept(energies)
    if found.get("vertices") == costs["vertices"]:
        for label in costs["mean"].keys() & found["mean"].keys():
            costs["mean"][label]["total"] = found["mean"][label]["total"]
    return costs
