"""The command line: `eslr simulate`, `eslr export`, `eslr joints`, `eslr assets`, ...

Results go to stdout (as JSON with `--json`), progress and messages to stderr. Exit codes: 0 done, 1 a bug, 2
something that the user can put right.
"""

from __future__ import annotations

import sys
import warnings

from eslr_jax.cli import assets, bodies, budget, evaluate, garments, runs, simulate, train
from eslr_jax.cli.console import app, stderr
from eslr_jax.errors import EslrError

COMMANDS = (simulate, garments, bodies, runs, assets, train, evaluate, budget)  # each has registered its own

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line."""
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    try:
        app.cli(prog="eslr")
    except EslrError as error:
        stderr.print(f"eslr: {error}", markup=False, highlight=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        stderr.print("eslr: interrupted", markup=False)
        sys.exit(130)
