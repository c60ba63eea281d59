"""The command line: `eslr simulate`, `eslr export`, `eslr joints`, `eslr assets`, ...

Results go to stdout (as JSON with `--json`), progress and messages to stderr. Exit codes: 0 done, 1 a bug, 2
something that the user can put right. A command is a frozen dataclass: the comments above its fields are the help
of its options, and calling it does what it says.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
import warnings

from eslr_jax.errors import ConfigError, EslrError
from eslr_jax.pipeline.cli import assets, batch, fabric, foreign, measure, runs, simulate, train
from eslr_jax.pipeline.cli.console import EXIT_CODE, app, leave_at_once, say

COMMANDS = (simulate, batch, foreign, runs, assets, fabric, train, measure)  # each has registered its own

_BROKEN_PIPE = 128 + 13  # as a shell reports the signal SIGPIPE
_REPEATABLE = {  # and the commands that collect its values
    "--set": ("train",),
    "--garment": ("simulate", "play", "score"),
    "--term": ("simulate",),
}

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line."""
    # Tracing makes many small objects that stay: looking at them after every 700 takes an eighth of its time.
    gc.set_threshold(50_000)
    atexit.register(gc.freeze)  # else Python looks through all of them once more before it ends
    # XLA asks whoever compiles for two minutes to file a bug. Its errors become exceptions; its log says no more.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # JAX, which reads it, is not imported yet
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    warnings.filterwarnings("always", category=UserWarning, module="eslr_jax")
    warnings.showwarning = lambda message, category, *_: say(str(message))  # one line on stderr
    sys.path.append(os.getcwd())  # last: where one's own networks and terms are found
    try:
        arguments = sys.argv[1:]  # of an option that is given twice, the second value would silently win
        options = [text.partition("=")[0] for text in arguments if text.startswith("--")]
        for option in options:
            if options.count(option) > 1 and arguments[0] not in _REPEATABLE.get(option, ()):
                raise ConfigError(f"{option} is given twice; give it once")
        try:
            with leave_at_once():
                app.cli(prog="eslr")()
        finally:
            sys.stdout.flush()  # here, where a broken pipe is still caught
    except BrokenPipeError:
        # Who reads the output, such as `head`, has enough of it. Python flushes once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(_BROKEN_PIPE)
    except EslrError as error:
        say(f"eslr: {error}")
        sys.exit(2)
    except KeyboardInterrupt:
        say("eslr: interrupted")
        sys.exit(EXIT_CODE)
