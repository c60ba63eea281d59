"""What all commands share: the application, progress on stderr, the compile cache."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
)

app = tyro.extras.SubcommandApp()
stderr = Console(stderr=True)


def say(text: str) -> None:
    """Print a line on stderr as it is."""
    stderr.print(text, markup=False, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def progress(label: str, total: int) -> Iterator[Any]:
    """Show a progress bar on stderr; yields a function of (done, total)."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=stderr, transient=False) as bars:
        task = bars.add_task(label, total=total)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def use_compile_cache() -> None:
    """Keep compiled programs between runs: the second run of the same command starts at once."""
    import jax

    from eslr_jax.assets.cache import user_cache

    cache = user_cache() / "compiled"
    with contextlib.suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
