"""The house: a room imports only rooms above it, and third parties have one door each."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "eslr_jax"

# From the top of the house down; a room may import itself and what stands before it.
ROOMS = [
    "errors", "extras", "types", "config", "numerics", "io", "geometry", "body", "fit", "assets", "contact",
    "physics", "graph", "models", "fabric", "scene", "simulate", "rollout", "training", "render",
    "evaluation", "viewer", "cli",
]  # fmt: skip
KERNELS = {"numerics", "contact", "graph", "models", "physics", "simulate"}
HOST = {"io", "geometry", "fit", "assets", "fabric", "scene", "rollout", "render", "viewer", "cli"}
DOORS = {
    "jraph": {"graph", "models"},
    "orbax": {"training"},
    "mitsuba": {"render"},
    "viser": {"viewer"},
    "flax.linen": {"models"},
}


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


FILES = [path for path in sorted(PACKAGE.rglob("*.py")) if room_of(path) != "__init__"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_room_imports_only_rooms_above(path):
    room = room_of(path)
    assert room in ROOMS, f"a new room: give {room} its place in this list"
    for name in imports(path):
        if name.startswith("eslr_jax."):
            other = name.split(".")[1]
            assert ROOMS.index(other) <= ROOMS.index(room), f"{room} imports {other}, which stands below it"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_kernel_imports_no_host_room(path):
    if room_of(path) in KERNELS and path.name != "surface.py":  # search tables are built on the host
        others = {name.split(".")[1] for name in imports(path) if name.startswith("eslr_jax.")}
        assert not others & HOST


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_third_parties_have_one_door(path):
    for name in imports(path):
        for library, rooms in DOORS.items():
            if name == library or name.startswith(library + "."):
                assert room_of(path) in rooms


def test_import_of_the_package_is_light():
    import subprocess
    import sys

    code = "import sys, eslr_jax; assert 'jax' not in sys.modules; eslr_jax.SimConfig"
    subprocess.run([sys.executable, "-c", code], check=True)
