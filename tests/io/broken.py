"""What every reader owes a broken file: one line that names it, and nothing else."""

import os

import pytest

from eslr_jax.errors import EslrError


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
