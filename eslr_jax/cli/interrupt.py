"""End at once on Ctrl-C; `simulation.interrupt` handles Ctrl-C where finished frames would be lost."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator

from eslr_jax.cli.console import say

EXIT_CODE = 130  # of a program that Ctrl-C ended
_PATIENCE = 1.0  # [s] in which Python may end by itself


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
