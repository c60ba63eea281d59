"""The catalogue of bundled files, with licence and checksum; names of assets, and paths in their place."""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

from eslr_jax.errors import AssetError, ConfigError


@dataclasses.dataclass(frozen=True)
class Asset:
    """A bundled body, garment, motion or model."""

    kind: str  # body, garment, motion or model
    name: str
    file: str  # relative to the data folder
    bytes: int
    sha256: str
    licence: str
    source: str
    description: str


@cache
def data_folder() -> Path:
    """Return the folder of the bundled data: inside the installed package, or beside it in a checkout.

    Raises:
        AssetError: Neither exists.
    """
    package = Path(__file__).resolve().parents[2]
    for folder in (package / "data", package.parent / "data"):
        if (folder / "manifest.json").is_file():
            return folder
    raise AssetError("the bundled data is missing; install the package again")


@cache
def list_assets() -> tuple[Asset, ...]:
    """Return all bundled assets, in the order of the manifest."""
    entries = json.loads((data_folder() / "manifest.json").read_text())["assets"]
    return tuple(Asset(**entry) for entry in entries)


def asset_names(kind: str) -> tuple[str, ...]:
    """Return the names of one kind, in the order of the manifest."""
    return tuple(dict.fromkeys(asset.name for asset in list_assets() if asset.kind == kind))


def find_asset(kind: str, name: str) -> Path:
    """Return the file of a named asset.

    Raises:
        AssetError: There is no such name. The message lists the names.
    """
    for asset in list_assets():
        if asset.kind == kind and asset.name == name:
            return data_folder() / asset.file
    names = asset_names(kind)
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    raise AssetError(
        f"no {kind} named {name!r}: {hint}there are {', '.join(names)}; a path to a file works too"
    )


def is_intact(asset: Asset) -> bool:
    """Tell whether a bundled file is there and has its checksum."""
    path = data_folder() / asset.file
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == asset.sha256


def split_clips(split: str) -> tuple[str, ...]:
    """Return the names of a split's clips.

    Raises:
        ConfigError: There is no such split, or it is empty.
    """
    motions = load_splits()["motions"]
    if not motions.get(split):
        known = ", ".join(name for name in motions if motions[name])
        raise ConfigError(f"no clips in split {split!r}; there are {known}")
    return tuple(motions[split])


@cache
def load_splits() -> dict[str, Any]:
    """Return the split of clips and garments into train, validation, test and unseen."""
    return json.loads((data_folder() / "splits.json").read_text())


def is_path(name: str) -> bool:
    """Tell a path from a name: it has a separator or a suffix, or is a file.

    A folder is none, such as the one of a run that has the name of its garment.
    """
    return "/" in name or "\\" in name or Path(name).suffix != "" or Path(name).is_file()
