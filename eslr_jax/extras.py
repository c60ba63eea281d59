"""Optional packages, imported where they are used."""

from __future__ import annotations

import importlib
from types import ModuleType

from eslr_jax.errors import MissingExtraError


def require(module: str, *, extra: str = "render", purpose: str = "this") -> ModuleType:
    """Import an optional package.

    Args:
        module: Module name, e.g. "mitsuba".
        extra: The extra of this project that installs it.
        purpose: What it is for, as the message begins.

    Returns:
        The module.

    Raises:
        MissingExtraError: If it can't be imported; the message names the command that helps.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingExtraError(
            f'{purpose} needs {package}, which is not installed: pip install "eslr-jax[{extra}]"'
        ) from error
