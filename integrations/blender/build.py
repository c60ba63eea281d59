# SPDX-License-Identifier: GPL-3.0-or-later
"""Pack the Blender add-on: `python integrations/blender/build.py FOLDER` writes a zip with its version there."""

import sys
import tomllib
import zipfile
from pathlib import Path

SOURCE = Path(__file__).parent / "eslr_garments"


def build(folder: Path) -> Path:
    """Write the add-on's zip into a folder, with fixed times, so that equal sources make equal files."""
    version = tomllib.loads((SOURCE / "blender_manifest.toml").read_text())["version"]
    path = folder / f"{SOURCE.name}-{version}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(SOURCE.iterdir()):
            if file.is_file():
                archive.writestr(zipfile.ZipInfo(file.name), file.read_bytes(), zipfile.ZIP_DEFLATED)
    return path


if __name__ == "__main__":
    print(build(Path(sys.argv[1] if len(sys.argv) > 1 else ".")))
