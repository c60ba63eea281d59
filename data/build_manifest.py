"""Write `manifest.json`: every bundled file with its size, checksum, licence and source."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

DATA = Path(__file__).parent

SOURCES = {
    "body": ("Apache-2.0 (code), CC0 (assets)", "Anny 0.6.2, rig cmu_mb, topology notoes"),
    "garment": ("Apache-2.0", "built around the body by build_garments.py"),
    "cmu": (
        "CMU mocap terms; packaging Apache-2.0",
        "CMU Graphics Lab motion capture, via envpool-assets 0.4.1",
    ),
    "deepmimic": ("MIT", "DeepMimic reference motions, via pybullet 3.2.7"),
    "model": ("Apache-2.0", "trained by this project"),
}
GARMENT_ORDER = (
    "tshirt", "tank", "longsleeve", "shorts", "pants", "dress", "kneepants", "shortsleeve", "tightdress",
)  # fmt: skip


def entry(kind: str, name: str, file: Path, source: str, description: str) -> dict:
    """Return one line of the manifest."""
    content = file.read_bytes()
    licence, origin = SOURCES[source]
    return {
        "kind": kind,
        "name": name,
        "file": file.relative_to(DATA).as_posix(),
        "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
        "licence": licence,
        "source": origin,
        "description": description,
    }


def bodies() -> list[dict]:
    """Return the bundled bodies."""
    file = DATA / "body" / "anny_cmu.npz"
    count = len(np.load(file)["rest_positions"])
    return [entry("body", "anny", file, "body", f"adult, {count} vertices, CMU rig")]


def garments() -> list[dict]:
    """Return the bundled garments at every resolution."""
    entries = []
    for name in GARMENT_ORDER:
        for resolution in ("1k", "4k", "10k"):
            file = DATA / "garments" / f"{name}_{resolution}.npz"
            if file.exists():
                count = len(np.load(file)["rest_positions"])
                entries.append(entry("garment", file.stem, file, "garment", f"{count} vertices"))
    return entries


def motions() -> list[dict]:
    """Return every clip of the bundled motion archives."""
    entries = []
    for source in ("cmu", "deepmimic"):
        file = DATA / "motions" / f"{source}.npz"
        if not file.exists():
            continue
        with np.load(file) as archive:
            for key in sorted(archive.files):
                if key.endswith("/translations"):
                    name = key.removesuffix("/translations")
                    frames, fps = len(archive[key]), float(archive[f"{name}/fps"])
                    entries.append(
                        entry("motion", name, file, source, f"{frames} frames, {frames / fps:.1f} s")
                    )
    return entries


def models() -> list[dict]:
    """Return the bundled networks; the first is the default."""
    entries = []
    for file in sorted((DATA / "models").glob("*.npz"), key=lambda file: file.stem):
        training = json.loads(file.with_suffix(".json").read_text())["training"]
        where = f"at {' and '.join(training['vertices'])}"
        if "stages" in training:
            where = f"({'; '.join(stage.partition(':')[0] for stage in training['stages'])})"
        description = f"{training['steps']} steps {where}"
        entries.append(entry("model", file.stem, file, "model", description))
    return entries


def main() -> None:
    """Write the manifest."""
    assets = bodies() + garments() + motions() + models()
    (DATA / "manifest.json").write_text(json.dumps({"assets": assets}, indent=1) + "\n")
    print(f"{len(assets)} assets")


if __name__ == "__main__":
    main()
