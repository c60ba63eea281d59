"""What all commands share: the application, progress on stderr, the compile cache, Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from typing import Any

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

app = tyro.extras.SubcommandApp()
stderr = Console(stderr=True)
EXIT_CODE = 130  # of a program that Ctrl-C ended
_PATIENCE = 1.0  # [s] in which Python may end by itself


def say(text: str) -> None:
    """Print a line on stderr as it is."""
    stderr.print(text, markup=False, highlight=False, soft_wrap=True)


def open_browser(url: str) -> bool:
    """Open a page in the browser where a person sits at a screen; return whether it was tried.

    Without a screen Python would start a browser of the terminal, which takes the terminal over.
    """
    is_linux = sys.platform.startswith("linux")
    has_screen = not is_linux or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    )
    is_person = sys.stdout.isatty()
    return is_person and has_screen and webbrowser.open(url)


@contextlib.contextmanager
def progress(label: str, total: int) -> Iterator[Any]:
    """Show a progress bar on stderr; yields a function of (done, total), and of a new label if there is one."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=stderr, transient=False) as bars:
        task = bars.add_task(label, total=total)

        def advance(done: int, total: int, now: str = label) -> None:
            bars.update(task, completed=done, total=total, description=now)

        yield advance


@contextlib.contextmanager
def waiting(text: str) -> Iterator[None]:
    """Show on stderr what is done and for how long already, where a person sits at a terminal."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=stderr, transient=True, disable=not stderr.is_interactive) as bars:
        bars.add_task(text, total=None)
        yield


def use_compile_cache() -> None:
    """Keep compiled programs between runs: the second run of the same command starts at once.

    A cache that the user has set (JAX_COMPILATION_CACHE_DIR) is kept.
    """
    import jax

    if jax.config.jax_compilation_cache_dir is not None:
        return

    from eslr_jax.pipeline.assets.cache import compiled_folder, trim_folder

    cache = compiled_folder()
    with contextlib.suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
        trim_folder(cache)
        jax.config.update("jax_compilation_cache_dir", str(cache))
        # The sixty small programs of a start take a second together.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


@contextlib.contextmanager
def leave_at_once() -> Iterator[None]:
    """Let Ctrl-C end the program also while it compiles.

    Python handles a signal between two of its own instructions, and a compilation is a single instruction. So a
    thread waits for the signal, and ends the process if Python has not ended it within a second. While another
    handler than Python's own is set for Ctrl-C, the thread does nothing. If Ctrl-C comes while Python deletes an
    object, Python drops the interrupt with a message; the message is suppressed, because the thread acts on it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    is_over = threading.Event()

    def watch() -> None:
        with receiver:
            while (number := receiver.recv(1)) and not is_over.is_set():
                handler = signal.getsignal(signal.SIGINT)
                if number[0] != signal.SIGINT or handler != signal.default_int_handler:
                    continue
                if not is_over.wait(_PATIENCE):
                    say("eslr: interrupted")
                    os._exit(EXIT_CODE)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    before = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    report = sys.unraisablehook
    sys.unraisablehook = lambda lost: None if lost.exc_type is KeyboardInterrupt else report(lost)
    try:
        yield
    finally:
        sys.unraisablehook = report
        is_over.set()
        signal.set_wakeup_fd(before)
        sender.close()
        watcher.join()


def print_report(report: dict[str, Any], more: dict[str, str]) -> None:
    """Print what a person wants to know of a trajectory first: words, then figures, `more` of them last.

    The report is that of `trajectory_report`, and of `wear_report` where the body is known, see
    `describe_report`.
    """
    from eslr_jax.pipeline.report.report import describe_report

    if "slide_m" in report:  # else the body is not known whole
        words = describe_report(report)
        for word, color, texts in (("good", "green", words.good), ("warning", "yellow", words.warnings)):
            for text in texts:
                line = Text.assemble((f"{word}: ", f"bold {color}"), (text, color))
                Console().print(line, soft_wrap=True)
    terms = ", ".join(f"{name} {value:.4f}" for name, value in report["terms"].items() if value)
    rows = {
        "frames": f"{report['num_frames']} of {report['num_vertices']} vertices",
        "energy": f"{report['total']:.4f} J a frame ({terms})",
        "stretch": f"{report['p99_principal_stretch']:.3f} (99 %), {report['max_principal_stretch']:.3f} at most",
    }
    if report["penetration_max_mm"] is not None:
        rows["penetration"] = (
            f"{report['penetration_p999_mm']:.2f} mm (99.9 %), {report['penetration_max_mm']:.2f} mm at most, "
            f"{report['penetrating_share'] * 100:.2f} % of vertices"
        )
    table = Table(show_header=False, box=None)
    for label, text in (rows | more).items():
        table.add_row(label, text)
    Console().print(table, markup=False, highlight=False)
    if garments := report["garments"]:
        formats: dict[str, tuple[str, Callable[[Any], str]]] = {
            "num_vertices": ("vertices", str),
            "p99_principal_stretch": ("stretch", "{:.3f}".format),
            "max_principal_stretch": ("at most", "{:.3f}".format),
            "penetration_max_mm": ("inside [mm]", "{:.2f}".format),
            "penetrating_share": ("share", "{:.2%}".format),
            "intersections_cloth": ("pairs", str),
            "intersections_body": ("with the body", str),
        }
        measured = next(iter(garments.values()))
        shown = {name: entry for name, entry in formats.items() if measured.get(name) is not None}
        table = Table("garment", *(title for title, _ in shown.values()), box=None)
        for name, row in garments.items():
            table.add_row(name, *(write(row[key]) for key, (_, write) in shown.items()))
        Console().print(table, markup=False, highlight=False)
