"""python experiments/inverse SCRIPT: its scripts are the modules of this folder that have a `main`."""

import importlib
import sys
from pathlib import Path

if __name__ == "__main__":
    # Python puts this folder there, but its modules belong to a package.
    sys.path[0] = str(Path(__file__).resolve().parents[1])
    importlib.import_module("harness").run_script("inverse")
