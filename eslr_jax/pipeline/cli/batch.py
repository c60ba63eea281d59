"""`eslr batch`: every combination of garments, fabrics, motions, bodies and draws, each scene a task of Dask."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import json
import os
import re
import secrets
import shutil
import tomllib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from eslr_jax.config import from_dict
from eslr_jax.errors import AssetError, ConfigError, EslrError
from eslr_jax.files.atomic import atomic_write, ensure_output_dir
from eslr_jax.files.parsing import one_line
from eslr_jax.pipeline.cli import console
from eslr_jax.pipeline.cli.console import app, progress, say, use_compile_cache
from eslr_jax.pipeline.cli.options import Options
from eslr_jax.pipeline.extras import require

MANIFEST = "manifest.json"
FORMAT = "eslr-batch-1"
_PART = ".part"  # suffix of a folder that is being written
_NAMED = ("garment", "fabric", "motion", "body")  # options in the name of a scene
# Options that move no body, and more whose values a compiled program takes; with others it is another one.
_CLOTH_ALONE = ("fabric", "wind", "gust", "damping", "tolerance")
_TRACED = (*_CLOTH_ALONE, "motion", "betas", "start", "arm_abduction")
_FIGURES = (  # of a run's report
    "num_frames", "num_vertices", "within_tolerance", "p99_principal_stretch", "penetration_max_mm", "frame_ms",
    "compile_s",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _Split:
    """Which scenes are held out: whole motions, garments and so on, so that none is in two splits."""

    by: str = "motion"
    validation: float = 0.0  # shares
    test: float = 0.0


@dataclasses.dataclass(frozen=True)
class _File:
    """What a file of scenes holds."""

    every: dict  # option -> its values
    options: dict = dataclasses.field(default_factory=dict)  # the same for all scenes
    draw: dict = dataclasses.field(default_factory=dict)  # option -> [low, high], or several such ranges
    seeds: int = 1  # draws of each combination
    split: _Split = _Split()


@dataclasses.dataclass(frozen=True)
class BatchScene:
    """One scene of a batch."""

    options: dict[str, Any]  # of `eslr simulate`, plain values
    seed: int
    split: str  # train, validation or test

    @property
    def name(self) -> str:
        """Its folder: what is simulated, and a hash of all options."""
        known = [self.options.get(key) for key in _NAMED]
        words = ["+".join(Path(str(part)).stem for part in _listed(value)) for value in known if value]
        words = [re.sub(r"[^A-Za-z0-9_+]", "_", word) for word in words]
        digest = hashlib.sha256(json.dumps([self.options, self.seed], sort_keys=True).encode()).hexdigest()
        return "-".join([*words, f"s{self.seed}", digest[:8]])[-120:].lstrip("-")

    @property
    def program(self) -> str:
        """What tells the compiled program apart."""
        return _without(self.options, _TRACED)


@app.command(name="batch")
@dataclasses.dataclass(frozen=True)
class Batch:
    """Simulate many scenes on many processes or machines, each to a run's folder; write a manifest of them.

    The same command goes on where it stopped: scenes that are done stay, and those that failed are tried again.
    """

    # TOML file: [every] has lists of values of the options of `eslr simulate`, of which each combination is a
    # scene; [options] has values for all; [draw] has ranges from which each of `seeds` draws; [split] tells
    # which to hold out.
    scenes: tyro.conf.Positional[Path]
    # Folder to write to: a folder for each scene, and manifest.json.
    out: Path
    # Number of processes on this machine.
    workers: int = 2
    # Address of a Dask scheduler, such as tcp://host:8786, whose workers are used instead. They need this
    # package, and the same files at the same places.
    scheduler: str | None = None

    def __call__(self) -> None:
        """Simulate what is not done yet, print what failed, and the manifest's name."""
        scenes = read_scenes(self.scenes)
        if self.workers < 1:
            raise ConfigError(f"--workers {self.workers}: give 1 or more")
        require("distributed", extra="batch", purpose="eslr batch")
        out = self.out.expanduser().resolve()
        open_ = {name: scene for name, scene in scenes.items() if not (out / name).is_dir()}
        if len(open_) < len(scenes):
            say(f"{len(scenes) - len(open_)} of {len(scenes)} scenes are done already")
        failures: dict[str, str] = {}
        if open_:
            with _client(self.workers, self.scheduler) as client, progress("scenes", len(open_)) as advance:
                _clear_parts(ensure_output_dir(out))
                near = shared_reach(scenes, out, client)
                _write_manifest(out, scenes, failures)
                for done, (name, error) in enumerate(simulate_scenes(open_, out, client, near), 1):
                    if error is not None:
                        failures[name] = error
                    _write_manifest(out, scenes, failures)
                    advance(done, len(open_))
        _clear_parts(out)
        _write_manifest(out, scenes, failures)
        if failures:
            table = Table("scene", "cause", box=None)
            for name, error in sorted(failures.items()):
                table.add_row(name, error)
            Console().print(table, markup=False, highlight=False)
        print(out / MANIFEST)
        if failures:
            raise EslrError(
                f"{len(failures)} of {len(scenes)} scenes failed; mend the causes above, and start the same "
                "command again for these alone"
            )


def read_scenes(path: Path) -> dict[str, BatchScene]:
    """Return the scenes of a TOML file by name.

    Raises:
        ConfigError: The file is missing or not TOML, or a value is unknown or impossible; it names the file.
    """
    try:
        given = from_dict(_File, tomllib.loads(path.read_text()))
        return {scene.name: scene for scene in _combine(given)}
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} can't be read; give a TOML file of scenes") from error
    except (tomllib.TOMLDecodeError, ConfigError) as error:
        raise ConfigError(f"{path}: {error}") from error


def _combine(given: _File) -> Iterator[BatchScene]:
    """Yield every combination with each of its draws."""
    for key, values in given.every.items():
        if not isinstance(values, list) or not values:
            raise ConfigError(f"every.{key} = {values!r}; give a list of values")
    if given.seeds < 1:
        raise ConfigError(f"seeds = {given.seeds}; give 1 or more")
    if given.seeds > 1 and not given.draw:
        raise ConfigError(f"seeds = {given.seeds} without [draw] are all the same; add what each draws")
    tables = (given.options, given.every, given.draw)
    if doubled := [key for one, other in itertools.combinations(tables, 2) for key in one.keys() & other]:
        raise ConfigError(f"{doubled[0]} is in two tables; give it in one of [options], [every] and [draw]")
    held_out = _hold_out(given)
    for chosen in itertools.product(*given.every.values()):
        values = dict(zip(given.every, chosen, strict=True))
        for seed in range(given.seeds):
            options = given.options | values | _draw(given.draw, values, seed)
            for key in ("garment", "fabric", "term"):
                if isinstance(options.get(key), str):
                    options[key] = [options[key]]
            from_dict(Options, options).check()
            yield BatchScene(
                options, seed, held_out.get(json.dumps(values.get(given.split.by, seed)), "train")
            )


def _draw(ranges: Mapping[str, Any], values: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Draw options evenly between their bounds; a combination draws the same whatever others there are."""
    digest = hashlib.sha256(json.dumps([values, seed], sort_keys=True).encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest))
    result: dict[str, Any] = {}
    for key, bounds in ranges.items():
        table = np.asarray(bounds, float) if _is_numbers(bounds) else np.zeros(0)
        if table.shape[-1:] != (2,) or table.ndim > 2 or not (table[..., 0] <= table[..., 1]).all():
            raise ConfigError(f"draw.{key} = {bounds!r}; give [low, high], or a list of such ranges")
        drawn = np.round(rng.uniform(table[..., 0], table[..., 1]), 4).tolist()
        result[key] = f"{drawn}s" if key == "start" else drawn
    return result


def _is_numbers(bounds: Any) -> bool:
    """Tell whether nested lists hold nothing but numbers, as many in each."""
    try:
        return np.asarray(bounds).dtype.kind in "if"
    except ValueError:
        return False


def _hold_out(given: _File) -> dict[str, str]:
    """Return the split of each value that is held out, as JSON; their order in the file does not matter."""
    split = given.split
    if split.by != "seed" and split.by not in given.every:
        raise ConfigError(f"split.by = {split.by!r}; name an option of [every], or seed")
    if not (split.validation >= 0 and split.test >= 0 and split.validation + split.test < 1):
        raise ConfigError("split.validation and split.test are shares, together less than 1; change them")
    values = range(given.seeds) if split.by == "seed" else given.every[split.by]
    texts = sorted(map(json.dumps, values), key=lambda text: hashlib.sha256(text.encode()).digest())
    counts = {name: round(getattr(split, name) * len(texts)) for name in ("validation", "test")}
    for name, count in counts.items():
        if getattr(split, name) > 0 and not count:
            raise ConfigError(
                f"split.{name} = {getattr(split, name)} of {len(texts)} values of {split.by} is none; give a "
                "larger share, more values, or another split.by"
            )
    names = [name for name, count in counts.items() for _ in range(count)]
    return dict(zip(texts, names, strict=False))


def _without(options: Mapping[str, Any], keys: Sequence[str]) -> str:
    """Return options but for some as text."""
    return json.dumps({key: value for key, value in options.items() if key not in keys}, sort_keys=True)


def _listed(value: Any) -> list:
    """Return a value of an option that may be a list as a list."""
    return value if isinstance(value, list) else [value]


@contextlib.contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Any]:
    """Connect with a scheduler, or start a cluster of processes on this machine."""
    import logging

    from distributed import Client, LocalCluster  # pyright: ignore[reportMissingImports]

    with contextlib.ExitStack() as stack:
        where: Any = scheduler
        if scheduler is None:
            where = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=None,  # Dask would stop a worker that compiles
                dashboard_address=None,
                silence_logs=logging.CRITICAL,
            )
            stack.enter_context(where)  # pyright: ignore[reportArgumentType]
        try:
            client = stack.enter_context(Client(where, timeout=20))  # pyright: ignore[reportArgumentType]
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"--scheduler {scheduler}: nobody answers there ({one_line(error)}); check the address, or leave "
                "it out to use this machine"
            ) from error
        yield client


def shared_reach(scenes: Mapping[str, BatchScene], out: Path, client: Any) -> dict[str, np.ndarray | None]:
    """Return for each program the vertices of the body that the cloth of any of its scenes reaches.

    All its scenes search these, so that they have arrays of one size, whatever the motion and the body's shape.
    They are kept in the folder for the next time.
    """
    posed: dict[str, dict[str, dict[str, Any]]] = {}
    for scene in scenes.values():
        posed.setdefault(scene.program, {})[_without(scene.options, _CLOTH_ALONE)] = scene.options
    files = {
        program: out / f".reach-{hashlib.sha256(repr(sorted(alike)).encode()).hexdigest()[:16]}.npy"
        for program, alike in posed.items()
    }
    asked = {
        program: client.map(reach_of, list(posed[program].values()), place=os.getcwd(), pure=False)
        for program, file in files.items()
        if not file.is_file()
    }
    for program, futures in asked.items():
        found = [each for each in client.gather(futures, errors="skip") if each is not None]
        if found:
            with atomic_write(files[program]) as temporary:
                np.save(temporary, np.unique(np.concatenate(found)))
    return {program: np.load(file) if file.is_file() else None for program, file in files.items()}


def reach_of(options: dict[str, Any], place: str) -> np.ndarray | None:
    """Return the vertices of the body that a scene's cloth can reach; None where the scene can't be prepared."""
    from eslr_jax.pipeline.cli.simulate import reached_vertices

    _begin_work(place)
    with warnings.catch_warnings(action="ignore"):
        try:
            return reached_vertices(from_dict(Options, options))
        except Exception:  # simulating it will say why
            return None


def _begin_work(place: str) -> None:
    """Prepare a worker's process, which shares the terminal with others, for a task from a working directory."""
    console.stderr.quiet = True
    use_compile_cache()
    os.chdir(place)


def simulate_scenes(
    scenes: Mapping[str, BatchScene], out: Path, client: Any, near: Mapping[str, np.ndarray | None]
) -> Iterator[tuple[str, str | None]]:
    """Simulate scenes on a cluster, and yield each one's name with what went wrong, as they end.

    The first scene of every program goes ahead and compiles it for all; the others follow one program after
    another, so that a worker loads few. A scene whose worker dies is given to another one.
    """
    from distributed import as_completed  # pyright: ignore[reportMissingImports]

    groups: dict[str, list[str]] = {}
    for name, scene in scenes.items():
        groups.setdefault(scene.program, []).append(name)
    names: dict[str, str] = {}

    def submit(name: str) -> Any:
        scene = scenes[name]
        given = scene.options, near[scene.program], str(out / name), os.getcwd()
        future = client.submit(simulate_scene, *given, pure=False)
        names[future.key] = name
        return future

    ended = as_completed([submit(group.pop(0)) for group in groups.values()])
    for future in ended:
        name = names[future.key]
        error = future.result() if future.status == "finished" else one_line(future.exception())
        yield name, error
        ended.update([submit(other) for other in groups.pop(scenes[name].program, [])])


def simulate_scene(options: dict[str, Any], near: np.ndarray | None, folder: str, place: str) -> str | None:
    """Simulate a scene on a worker, from the working directory `place`; return what went wrong, None if nothing.

    The folder appears when all its files are in it. Where another worker was faster, its files stay.
    """
    from eslr_jax.pipeline.cli.simulate import Simulate, simulate_run
    from eslr_jax.simulation.interrupt import Interruption

    _begin_work(place)
    target = Path(folder)
    part = target.with_name(f".{target.name}.{secrets.token_hex(4)}{_PART}")
    try:
        with warnings.catch_warnings(record=True) as heard, Interruption() as stop:
            warnings.filterwarnings("always", category=UserWarning, module="eslr_jax")
            plain = from_dict(Options, options)
            report = simulate_run(Simulate(**vars(plain), out=part, pictures=False), stop, near=near)
        if report["error"] is not None:
            return str(report["error"])
        said = list(dict.fromkeys(str(entry.message) for entry in heard))
        (part / "options.json").write_text(json.dumps({"options": options, "warnings": said}, indent=2))
        part.rename(target)
        return None
    except OSError as error:
        return None if target.is_dir() else one_line(error)
    except Exception as error:  # whatever it is, the other scenes go on
        return str(error) if isinstance(error, EslrError) else f"{type(error).__name__}: {one_line(error)}"
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _clear_parts(out: Path) -> None:
    """Remove what workers left that were killed."""
    for part in out.glob(f".*{_PART}"):
        shutil.rmtree(part, ignore_errors=True)


def _write_manifest(out: Path, scenes: Mapping[str, BatchScene], failures: Mapping[str, str]) -> None:
    """Write what the scenes are, and how each of them went."""
    entries = {}
    for name, scene in scenes.items():
        entry: dict[str, Any] = {"status": "open", **dataclasses.asdict(scene)}
        if (out / name).is_dir():
            report = json.loads((out / name / "report.json").read_text())
            entry |= {"status": "done", **{key: report.get(key) for key in _FIGURES}}
        elif name in failures:
            entry |= {"status": "failed", "error": failures[name]}
        entries[name] = entry
    with atomic_write(out / MANIFEST) as temporary:
        temporary.write_text(json.dumps({"format": FORMAT, "scenes": entries}, indent=1))


def read_manifest(out: Path) -> dict[str, dict[str, Any]]:
    """Return the entries of a batch's manifest by the names of the scenes.

    Raises:
        AssetError: It is damaged, or of another version.
    """
    try:
        content = json.loads((out / MANIFEST).read_text())
        if content["format"] == FORMAT:
            return content["scenes"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise AssetError(
            f"{out / MANIFEST} is damaged; run eslr batch again, which writes it anew"
        ) from error
    raise AssetError(f"{out / MANIFEST} is of another version; run eslr batch again, which writes it anew")
