"""What the scripts of this folder share: options, results in files, and tables."""

import argparse
import importlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from fast_compilation import compile_fast

from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.assets.budget import device_name
from eslr_jax.pipeline.report.report import environment

EXPERIMENTS = Path(__file__).parent
RESULTS = EXPERIMENTS / "results"
os.environ.setdefault("MPLBACKEND", "Agg")  # figures are files
if "--smoke" in sys.argv:  # before a script compiles anything
    compile_fast()


def parser(description: str | None, smoke: str, out: str | Path = RESULTS) -> argparse.ArgumentParser:
    """Return a parser with the options of every script: --smoke, which does what `smoke` says, and --out."""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawTextHelpFormatter)
    made.add_argument("--smoke", action="store_true", help=smoke)
    made.add_argument("--out", type=_folder, default=str(out), help="of the results; it is made")
    return made


def _folder(text: str) -> Path:
    Path(text).mkdir(parents=True, exist_ok=True)
    return Path(text)


def run_script(package: str) -> None:
    """Run the script of a folder that the command line names first."""
    scripts = sorted(
        path.stem for path in (EXPERIMENTS / package).glob("*.py") if "\ndef main(" in path.read_text()
    )
    if len(sys.argv) < 2 or sys.argv[1] not in scripts:
        raise SystemExit(f"python experiments/{package} SCRIPT ...; scripts are {', '.join(scripts)}")
    sys.argv[0] += f" {sys.argv.pop(1)}"
    importlib.import_module(f"{package}.{sys.argv[0].split()[-1]}").main()


def machine() -> dict[str, Any]:
    """Return what a result was made with: the device, and in `environment` the versions."""
    return {"device": device_name(), "environment": environment()}


def cores() -> int | None:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def kept(path: Path) -> dict[str, Any]:
    """Return a result that was kept before; empty without one."""
    return json.loads(path.read_text()) if path.exists() else {}


def keep(path: Path, result: Mapping[str, Any]) -> None:
    """Write a result as JSON, whole or not at all; arrays become lists."""
    text = json.dumps(result, indent=1, default=lambda value: np.asarray(value).tolist())
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n")


def put(
    path: Path, part: str, row: Mapping[str, Any], names: Sequence[str], about: Mapping[str, Any]
) -> None:
    """Keep a row of a part, and what else a result says, in the place of the row that has the same names."""
    result = kept(path)
    others = [one for one in result.get(part, []) if any(one.get(name) != row.get(name) for name in names)]
    keep(path, {**result, part: [*others, row], **about})


def save(figure: Any, path: Path) -> None:
    """Write a figure of matplotlib as PNG."""
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")


def markdown(columns: Mapping[str, str], rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as a Markdown table, with headings for their keys; what is missing or None is a dash."""

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}"
        return "-" if value is None else str(value)

    lines = [list(columns.values()), ["---"] * len(columns)]
    lines += [[cell(row.get(name)) for name in columns] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
