"""Formats by what their files hold: a new format is one file of this folder, marked by `@reader` and `@writer`.

It is found by its suffix, and named in messages and help texts. A format from elsewhere is there once its module
is imported. Kinds of readers, each with its arguments after the path:

- "mesh": `like`, the same mesh in another shape, or None; returns a `MeshFile`;
- "garment": the name of one of several; returns a `MeshFile` with its name. Every mesh is a garment, too;
- "pattern": nothing; returns a `Pattern`;
- "body": the names of its meshes; returns a `RiggedMesh`, or a `Body`;
- "motion": the name of a clip; returns a `SkeletonMotion`;
- "mesh sequence": the name of a mesh, and a frame rate or None; returns a list of `MeshSequence`.

A writer gets the path, the `AnimatedMesh`es and the timestep [s]. Files of "scene" hold several meshes, those of
"animation" one, those of "point cache" one without its faces; "frames" is a folder with a mesh file a frame.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar

from eslr_jax.errors import AssetError
from eslr_jax.files.parsing import parsing
from eslr_jax.pipeline.formats.animated import AnimatedMesh, check_meshes

_SCENES = (".fbx", ".usd", ".usda", ".usdc", ".usdz", ".abc", ".dae", ".blend")  # of other programs
WRITERS = ("scene", "animation", "point cache", "frames")
_P = ParamSpec("_P")
_R = TypeVar("_R")
_Writer = Callable[[Path, Sequence[AnimatedMesh], float], None]


class _Format(NamedTuple):
    kind: str
    suffixes: tuple[str, ...]
    function: Callable[..., Any]
    accepts: Callable[[Path], bool] | None


_formats: list[_Format] = []


def reader(
    kind: str, suffixes: Sequence[str], *, accepts: Callable[[Path], bool] | None = None
) -> Callable[[Callable[Concatenate[Path, _P], _R]], Callable[Concatenate[str | Path, _P], _R]]:
    """Make a function the reader of a format; what it raises on a damaged file becomes one named line.

    Args:
        kind: What the files hold; see the module.
        suffixes: Their suffixes, with the dot.
        accepts: Tells the files of the format from others with the same suffix.
    """

    def register(function: Callable[Concatenate[Path, _P], _R]) -> Callable[Concatenate[str | Path, _P], _R]:
        @functools.wraps(function)
        def read(path: str | Path, *args: _P.args, **kwargs: _P.kwargs) -> _R:
            with parsing(path, kind) as file:
                return function(file, *args, **kwargs)

        _formats.append(_Format(kind, tuple(suffixes), read, accepts))
        return read

    return register


def writer(kind: str, suffixes: Sequence[str]) -> Callable[[_Writer], _Writer]:
    """Make a function the writer of a format, which gets sound meshes alone; see `check_meshes`."""

    def register(function: _Writer) -> _Writer:
        @functools.wraps(function)
        def write(path: str | Path, meshes: Sequence[AnimatedMesh], timestep: float) -> None:
            check_meshes(meshes, timestep)
            function(Path(path), meshes, timestep)

        _formats.append(_Format(kind, tuple(suffixes), write, None))
        return write

    return register


def find_reader(kind: str, path: str | Path) -> Callable[..., Any]:
    """Return the reader of a file.

    Raises:
        AssetError: There is none for its suffix.
    """
    suffix = Path(path).suffix.lower()
    found = [form for form in _all(kind) if suffix in form.suffixes]
    for form in sorted(found, key=lambda form: form.accepts is None):
        if form.accepts is None or form.accepts(Path(path)):
            return form.function
    hint = "export it as glTF (in Blender: File > Export > glTF 2.0), or " if suffix in _SCENES else ""
    known = ", ".join(suffixes_of(kind))
    raise AssetError(f"{kind} file {path} has the unknown suffix {suffix!r}; {hint}give one of {known}")


def find_writer(name: str) -> tuple[str, Callable[..., None]] | None:
    """Return the kind and the function of a format that is written, such as "glb"; None if there is none."""
    found = [(form.kind, form.function) for form in _all(*WRITERS) if f".{name}" in form.suffixes]
    return found[0] if found else None


def suffixes_of(*kinds: str) -> tuple[str, ...]:
    """Return the suffixes of all formats of some kinds."""
    return tuple(dict.fromkeys(suffix for form in _all(*kinds) for suffix in form.suffixes))


def names_of(*kinds: str) -> str:
    """Return the names of the formats of some kinds, for messages and help texts."""
    return ", ".join(suffix[1:] for suffix in suffixes_of(*kinds))


def _all(*kinds: str) -> list[_Format]:
    """Return the formats of some kinds, in the order of the kinds."""
    _import_formats()
    return [form for kind in kinds for form in _formats if form.kind == kind]


@functools.cache
def _import_formats() -> None:
    """Import all files of this folder, which registers their formats."""
    for module in pkgutil.iter_modules([str(Path(__file__).parent)]):
        importlib.import_module(f"{__package__}.{module.name}")
