"""Ctrl-C: at once where nothing is lost, after the frames in work where they can be kept."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator

from eslr_jax.cli.console import say

EXIT_CODE = 130  # of a program that Ctrl-C ended
_PATIENCE = 1.0  # [s] in which Python may end by itself


@contextlib.contextmanager
def leave_at_once() -> Iterator[None]:
    """Let Ctrl-C end the program also while it compiles.

    Python handles a signal between two of its own instructions, but a compilation is a single one. A thread
    therefore waits for the signal, and ends the process if Python has not done so within a second. Where a
    function other than Python's own handles Ctrl-C, it leaves the process alone. An interrupt that Python drops,
    since it came while an object was deleted, is not printed: the thread acts on it.
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


class Interruption:
    """Turns Ctrl-C and SIGTERM into a question, from `begin` on; a second signal acts at once."""

    def __init__(self, message: str):
        """Remember what to say when the first signal comes."""
        self._message = message
        self._before: dict[signal.Signals, Callable | int | None] = {}
        self.is_wanted = False

    def begin(self) -> None:
        """Take over the signals."""
        if not self._before and threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._remember)

    def end(self) -> None:
        """Give the signals back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def _remember(self, number: int, frame: object) -> None:
        self.is_wanted = True
        self.end()
        say(self._message)
