"""Turn every way in which a file can be broken into one named error."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from eslr_jax.errors import AssetError, EslrError

MAX_FILE_BYTES = 2 << 30  # larger files are refused before they are read


@contextlib.contextmanager
def parsing(
    path: str | Path,
    content: str,
    *,
    max_bytes: int = MAX_FILE_BYTES,
    form: str = "",
    remedy: str = "export it again",
) -> Iterator[Path]:
    """Check that a file exists, and turn whatever its parser raises into one named error; yields its path.

    Args:
        path: Path of the file.
        content: What the file should hold, for messages, e.g. "motion".
        max_bytes: Size of the largest file accepted [bytes].
        form: Format for messages where the suffix does not tell it, e.g. " as a pickle".
        remedy: What the user should do about a damaged file.

    Raises:
        AssetError: The file is missing, too large, or its parser failed.
    """
    file = Path(path)
    if not file.is_file():
        cause = "is a folder" if file.is_dir() else "doesn't exist"
        raise AssetError(f"{content} file {file} {cause}; check the path")
    if file.stat().st_size > max_bytes:
        raise AssetError(f"{content} file {file} is larger than {max_bytes} bytes; cut or reduce it")
    try:
        yield file
    except EslrError:
        raise
    except OSError as error:
        reason = (error.strerror or one_line(error)).lower()
        raise AssetError(f"{content} file {file} can't be read: {reason}; check the path") from error
    except Exception as error:  # a parser may raise anything on a damaged file
        raise AssetError(
            f"{content} file {file} can't be read{form} ({one_line(error)}); {remedy}"
        ) from error


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file without the mark that Windows puts first; what is no UTF-8 is replaced."""
    return path.read_text(encoding="utf-8-sig", errors="replace").splitlines()


def split_name(text: str | Path) -> tuple[str, str]:
    """Split `FILE#NAME` into the file and the name, "" if there is none.

    A folder may have a # in its name. So may a file that exists, and then the name may have a slash.
    """
    text = str(text)
    for place in (place for place, letter in enumerate(text) if letter == "#"):
        if Path(text[:place]).is_file():
            return text[:place], text[place + 1 :]
    start = max(text.rfind("/"), text.rfind("\\")) + 1
    file, _, name = text[start:].partition("#")
    return text[:start] + file, name


def one_line(error: BaseException) -> str:
    """Return the first line of an error's text, cut short, or the error's type if it has no text."""
    lines = str(error).splitlines()
    return lines[0][:200] if lines and lines[0].strip() else type(error).__name__
