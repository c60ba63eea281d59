"""Import optional packages where they are used."""

from __future__ import annotations

import importlib
from types import ModuleType

from eslr_jax.errors import MissingExtraError


def require(module: str, *, extra: str = "render", purpose: str = "this") -> ModuleType:
    """Import an optional package of this project's `extra`; `purpose` begins the message where it is missing.

    Raises:
        MissingExtraError: The package is not installed; the message names the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingExtraError(
            f'{purpose} needs {package}, which is not installed: pip install "eslr-jax[{extra}]"'
        ) from error
