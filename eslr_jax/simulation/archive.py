"""A scene as a file: its arrays as an npz archive, and around them its types as JSON."""

from __future__ import annotations

import dataclasses
import importlib
import json
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jax.tree_util import Partial

from eslr_jax.errors import AssetError, ConfigError
from eslr_jax.files.npz import read_arrays, write_arrays
from eslr_jax.terms.term import find_term
from eslr_jax.types import Scene

_OWN = "eslr_jax."  # package whose types and functions a file may name
_TREE = "tree"  # the archive's entry that holds the JSON
Kind = TypeVar("Kind")


def save_scene(path: str | Path, scene: Scene) -> None:
    """Write a scene, whole: whoever loads it simulates, scores or resumes the same scene.

    Args:
        path: Path of the npz archive.
        scene: Of `prepare_scene`.

    Raises:
        ConfigError: The scene holds a function that no file can name, such as a wind of one's own.
        AssetError: The file can't be written.
    """
    write_tree(path, scene, content="scene")


def load_scene(path: str | Path) -> Scene:
    """Read a scene that `save_scene` wrote.

    The module of a term of one's own is imported.

    Raises:
        AssetError: The file is missing, damaged, or of another version, or a term's module can't be imported.
    """
    return read_tree(path, Scene, content="scene", remedy="write it again with save_scene")


def write_tree(path: str | Path, value: Any, *, content: str) -> None:
    """Write a scene, or a tuple with one; `content` is what messages call it. Raises as `save_scene` does."""
    arrays: dict[str, np.ndarray] = {}
    tree = _describe(value, content, arrays)
    write_arrays(path, {_TREE: np.array(json.dumps(tree)), **arrays})


def read_tree(path: str | Path, kind: type[Kind], *, content: str, remedy: str) -> Kind:
    """Read what `write_tree` wrote, with NumPy arrays.

    Args:
        path: Path of the npz archive.
        kind: Its type.
        content: What messages call it.
        remedy: What the user should do where the file holds nothing of this version.

    Raises:
        AssetError: As of `load_scene`.
    """
    arrays = read_arrays(path, content=content)
    try:
        value = _build(json.loads(str(arrays[_TREE])), arrays)
    except (KeyError, TypeError, ValueError, AttributeError, ImportError) as error:
        raise AssetError(f"{path} holds no {content} of this version; {remedy}") from error
    if not isinstance(value, kind):
        raise AssetError(f"{path} holds no {content}; {remedy}")
    return value


def _describe(value: Any, place: str, arrays: dict[str, np.ndarray]) -> Any:
    """Return a part of a scene as values of JSON; its arrays go to `arrays`, by their place in the scene."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        arrays[place] = np.asarray(value)
        return {"array": place}
    if isinstance(value, Partial):
        function = value.func
        if not function.__module__.startswith(_OWN) or value.keywords:
            raise ConfigError(
                f"{place} is a function of your own, which no file can hold; write it as a term, see the guide"
            )
        values = [_describe(part, f"{place}.{row}", arrays) for row, part in enumerate(value.args)]
        return {"partial": f"{function.__module__}:{function.__qualname__}", "arguments": values}
    if dataclasses.is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif isinstance(value, tuple):
        parts = getattr(value, "_asdict", lambda: dict(enumerate(value)))()  # type: ignore[attr-defined]
    elif isinstance(value, dict):
        parts = value
    else:
        raise ConfigError(f"{place} is a {type(value).__name__}, which no file of a scene can hold")
    kind = type(value)
    name = kind.__name__ if kind in (tuple, dict) else f"{kind.__module__}:{kind.__qualname__}"
    return {"type": name, "parts": {k: _describe(v, f"{place}.{k}", arrays) for k, v in parts.items()}}


def _build(tree: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return the part of a scene that `_describe` described."""
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "partial" in tree:
        return Partial(_find(tree["partial"]), *(_build(part, arrays) for part in tree["arguments"]))
    parts = {name: _build(part, arrays) for name, part in tree["parts"].items()}
    if tree["type"] == "dict":
        return parts
    return tuple(parts.values()) if tree["type"] == "tuple" else _find(tree["type"])(**parts)


def _find(name: str) -> Any:
    """Return a type or a function of this package by its name, or a term of anybody's."""
    module, _, qualified = name.partition(":")
    if module.startswith(_OWN):
        found = getattr(importlib.import_module(module), qualified)
        if getattr(found, "__module__", "") == module:
            return found
    try:
        return find_term(name)
    except ConfigError as error:
        raise AssetError(f"the scene has a {error}") from error
