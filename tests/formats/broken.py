"""What every reader owes a broken file: one line that names it, and nothing else."""

import json
import os

import pytest

from eslr_jax import EslrError
from eslr_jax.pipeline.formats.registry import find_reader


def read(kind, path, *options):
    """Read a file of a kind by its suffix."""
    return find_reader(kind, path)(path, *options)


def reader_of(kind):
    """Return the reader of files of a kind."""
    return lambda path: read(kind, path)


def refuses(read, path, *words):
    """Check that reading fails with one named line, and that no file appears."""
    before = sorted(os.listdir(path.parent))
    with pytest.raises(EslrError) as caught:
        read(path)
    text = str(caught.value)
    assert "\n" not in text
    assert path.name in text or path.stem in text
    for word in words:
        assert word in text
    assert sorted(os.listdir(path.parent)) == before


def tables_of(data):
    """The JSON tables and the binary chunk of a GLB."""
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def pack(tables, blob):
    """A GLB of JSON tables and a binary chunk."""
    text = json.dumps(tables).encode()
    text += b" " * (-len(text) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text
    chunks += len(blob).to_bytes(4, "little") + b"BIN\0" + blob
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks
