"""Write files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from eslr_jax.errors import AssetError


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; move it onto `path` when the block succeeds.

    The temporary path keeps the suffix of `path`, because many writers choose their format by it. If the block
    raises, the temporary file is removed and `path` is as before. An AssetError says why it can't be written.
    """
    target = Path(path)
    # Hidden, and unique to this call, so that two processes may write the same target.
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(6)}{target.suffix}")
    try:
        if target.is_dir():
            raise AssetError(f"can't write {target}: it is a folder; name a file in it")
        if not target.parent.is_dir():
            raise AssetError(f"can't write {target}: folder {target.parent} doesn't exist; create it first")
        yield temporary
        _flush(temporary)
        os.replace(temporary, target)
        _flush(target.parent)
    except OSError as error:
        raise AssetError(
            f"can't write {target}: {_reason(error)}; free space or choose another folder"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def ensure_output_dir(path: str | Path) -> Path:
    """Create a folder with its parents where it is missing; an AssetError where no file can be written in it."""
    folder = Path(path).expanduser()
    if folder.exists() and not folder.is_dir():
        raise AssetError(f"output folder {folder} is a file; choose another name or remove the file")
    probe = folder / f".{secrets.token_hex(6)}.probe"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A permission bit says nothing to root, on a read-only mount or on a full disk: write one byte.
        probe.write_bytes(b"\0")
        probe.unlink()
    except OSError as error:
        raise AssetError(
            f"output folder {folder} can't be written: {_reason(error)}; choose one that you may write to"
        ) from error
    return folder


def move_files(source: Path, target: Path, *, without: Iterable[str] = ()) -> None:
    """Move the files of a folder that are written and flushed into another on the same disk: all of them or none.

    Files that they replace are set aside until the last one is in its place, and come back if one can't be moved,
    as an AssetError says. `without` names files that `target` shall not have any more.
    """
    new = sorted(file.name for file in source.iterdir())
    aside = Path(tempfile.mkdtemp(prefix=".old-", dir=target))
    moved: list[tuple[Path, Path]] = []
    try:
        for name in (*new, *without):
            moves = [(target / name, aside / name)] if (target / name).is_file() else []
            moves += [(source / name, target / name)] if name in new else []
            for here, there in moves:
                try:
                    os.replace(here, there)
                except OSError as error:
                    raise AssetError(
                        f"can't write {target / name}: {_reason(error)}; free the name or choose another folder"
                    ) from error
                moved.append((here, there))
    except BaseException:
        for here, there in reversed(moved):
            os.replace(there, here)
        aside.rmdir()
        raise
    _flush(target)
    shutil.rmtree(aside)


def _flush(path: Path) -> None:
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:
        if path.is_dir():  # a folder can't be opened on Windows; its entries need no flush there
            return
        raise
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _reason(error: OSError) -> str:
    """Return the operating system's words without the path, which the caller names."""
    return (error.strerror or str(error)).lower()
