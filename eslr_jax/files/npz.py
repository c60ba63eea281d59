"""Write arrays to NumPy archives, and read archives without trusting what they say about themselves."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError, EslrError
from eslr_jax.files.atomic import atomic_write
from eslr_jax.files.parsing import parsing

MAX_BYTES = 16 << 30  # unpacked
_KINDS = {"f": "floats", "iu": "integers", "biu": "flags", "biuf": "flags", "fiu": "numbers", "U": "text"}


def write_arrays(path: str | Path, arrays: Mapping[str, np.ndarray], *, is_compressed: bool = False) -> None:
    """Write named arrays as an npz archive, atomically, or raise an AssetError; compressing takes much longer."""
    save = np.savez_compressed if is_compressed else np.savez
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        save(stream, **{name: np.asarray(array) for name, array in arrays.items()})  # pyright: ignore[reportArgumentType]


def read_arrays(
    path: str | Path, *, content: str, names: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """Read arrays of an npz archive, all or those of `names`; `content` is what messages call it: "trajectory".

    Nothing is unpickled, and headers are checked before memory is taken.

    Raises:
        AssetError: The file is missing, truncated, damaged, larger than `MAX_BYTES`, or no npz archive.
    """
    with parsing(path, content, form=" as an npz archive", remedy="write it again") as file:
        if not zipfile.is_zipfile(file):
            raise AssetError(f"{content} file {path} is not an npz archive or is truncated; write it again")
        with zipfile.ZipFile(file) as archive:
            members = {member.removesuffix(".npy"): member for member in archive.namelist()}
            if names is not None:
                members = {name: member for name, member in members.items() if name in names}
            total = sum(archive.getinfo(member).file_size for member in members.values())
            if total > MAX_BYTES:
                raise AssetError(
                    f"{content} file {path} unpacks to {total} bytes, more than {MAX_BYTES}; check the file"
                )
            return {name: _read_member(archive, member) for name, member in members.items()}


def _read_member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Read one array after checking that its header agrees with its size."""
    size = archive.getinfo(name).file_size
    with archive.open(name) as stream:
        is_old = np.lib.format.read_magic(stream) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if is_old else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(stream)
        expected = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or expected > size:
            raise ValueError(f"array {name} has an impossible header")
    with archive.open(name) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def check_layout(
    arrays: Mapping[str, np.ndarray],
    layout: Mapping[str, tuple[str, ...]],
    *,
    what: str,
    remedy: str,
    error: type[EslrError] = AssetError,
) -> None:
    """Raise an `error` unless arrays have the types and shapes of a layout; absent ones are not checked.

    `layout` has for every name the kinds of dtype accepted, the dimensions, and for arrays of indices the
    dimension that they index, e.g. `{"faces": ("iu", "faces 3", "vertices")}`. A word is one length throughout.
    `what` is what messages call the file, and `remedy` what the user should do about it.
    """
    lengths: dict[str, int] = {}
    for name in (name for name in layout if name in arrays):
        kinds, dimensions, *indexed = layout[name]
        array, words = arrays[name], dimensions.split()
        wanted = [word if word.isdigit() or word not in lengths else f"{lengths[word]}" for word in words]
        fits = array.dtype.kind in kinds and array.ndim == len(words)
        for word, size in zip(words, array.shape, strict=False):
            fits &= size == (int(word) if word.isdigit() else lengths.setdefault(word, size))
        if not fits:
            raise error(
                f"{what}: {name} is {array.dtype} {array.shape}; expected {_KINDS[kinds]} [{', '.join(wanted)}]; "
                f"{remedy}"
            )
        for word in indexed:
            count = lengths.get(word, 0)
            if array.size and not (array.min() >= 0 and array.max() < count):
                worst = array.min() if array.min() < 0 else array.max()
                raise error(f"{what}: {name} names {worst} of {count} {word}; {remedy}")
