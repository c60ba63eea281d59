"""Stop on Ctrl-C after the work in progress, so that its results are kept (host)."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable


class Interruption:
    """Turns Ctrl-C and SIGTERM into a question, from `begin` on; a second signal acts at once.

    A context: at its end, or from `end` on, the signals act as before.
    """

    def __init__(self, on_wanted: Callable[[], None] = lambda: None):
        """Remember what to call when the first signal comes."""
        self._on_wanted = on_wanted
        self._before: dict[signal.Signals, Callable | int | None] = {}
        self._wakeup = -1
        self.is_wanted = False

    def __enter__(self) -> Interruption:
        """Return itself; nothing is taken over yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """Give the signals back."""
        self.end()

    def begin(self) -> None:
        """Take over the signals, unless one came; outside the main thread they are left alone, as Python asks."""
        if not self.is_wanted and not self._before and threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._remember)
            # Nobody else is told of the first signal: a thread that looked after it had been handled would find
            # the handler of before, and act.
            self._wakeup = signal.set_wakeup_fd(-1)

    def end(self) -> None:
        """Give the signals back."""
        if self._before:
            for number, handler in self._before.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(self._wakeup, warn_on_full_buffer=False)
        self._before = {}

    def _remember(self, number: int, frame: object) -> None:
        self.is_wanted = True
        self.end()
        self._on_wanted()
