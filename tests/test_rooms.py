"""The house: a room imports only rooms above it, kernels stay pure, and third parties have one door each."""

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import eslr_jax

PACKAGE = Path(__file__).parents[1] / "eslr_jax"

# From the top of the house down; a room may import itself and what stands before it.
CORE = [
    "errors", "ranges", "types", "config", "numerics", "files", "mesh", "pose", "contact", "terms", "fabric",
    "solver", "networks", "simulation", "training",
]  # fmt: skip
PIPELINE = [
    "extras", "formats", "rigs", "dressing", "fabrics", "drape", "assets", "pictures", "report", "page", "cli",
]  # fmt: skip
ROOMS = [*CORE, *(f"pipeline.{room}" for room in PIPELINE)]
KERNELS = {
    "numerics", "pose.lbs", "contact", "networks", "terms", "solver", "simulation.scene", "simulation.frame",
    "simulation.stepper", "simulation.rollout", "fabric.materials",
}  # fmt: skip
HOST_FILES = {"terms.worn", "networks.registry"}  # inside kernel rooms
SHARED = {"errors", "ranges", "types", "config"}  # what kernels and host both read
DOORS = {
    "jraph": {"networks"},
    "orbax": {"training"},
    "mitsuba": {"pipeline.pictures"},
    "viser": {"pipeline.page"},
    "flax.linen": {"networks"},
}


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


def is_in(module: str, rooms: set[str]) -> bool:
    """Return whether a module is one of some rooms or stands in one."""
    parts = module.split(".")
    return any(".".join(parts[:count]) in rooms for count in range(1, len(parts) + 1))


def imports(tree: ast.AST):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno} imports from a relative place, where nobody looks"
            assert node.module
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


TREES = {module_of(path): ast.parse(path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))}
MODULES = [module for module in TREES if module != "__init__"]
KERNEL_MODULES = [module for module in MODULES if is_in(module, KERNELS) and not is_in(module, HOST_FILES)]
every_module = pytest.mark.parametrize("module", MODULES)
every_kernel = pytest.mark.parametrize("module", KERNEL_MODULES)


def own_imports(module: str) -> set[str]:
    """Return the modules of the package that one imports, or takes names from."""
    names = {
        name.removeprefix("eslr_jax.") for name in imports(TREES[module]) if name.startswith("eslr_jax.")
    }
    modules = {name if name in TREES else name.rpartition(".")[0] for name in names}
    # `from eslr_jax.pose import lbs` takes nothing of the package itself.
    return {name for name in modules if name and not any(other.startswith(name + ".") for other in modules)}


@pytest.mark.parametrize("name", sorted(KERNELS | HOST_FILES))
def test_listed_name_is_of_a_module(name):
    """A kernel that is renamed does not escape."""
    assert any(is_in(module, {name}) for module in MODULES)


def room_of(module: str) -> str:
    first, *rest = module.split(".")
    return f"pipeline.{rest[0]}" if first == "pipeline" and rest else first


@every_module
def test_room_imports_only_rooms_above(module):
    """So the core does not know of the pipeline."""
    room = room_of(module)
    assert room in [*ROOMS, "pipeline"], f"a new room: give {room} its place in this list"
    for other in own_imports(module):
        name = room_of(other)
        assert ROOMS.index(name) <= ROOMS.index(room), f"{room} imports {name}, which stands below it"


@every_kernel
def test_kernel_imports_no_host_room(module):
    for other in own_imports(module):
        is_asked = other == "terms.worn"  # by what a term plans on the host
        assert other in KERNEL_MODULES or other in SHARED or is_asked, f"{module} imports {other}"


@every_kernel
def test_kernel_asserts_no_part_to_be_there(module):
    """A part is whole or absent, and a branch says which: `assert x is not None` would hide a third case."""
    for node in ast.walk(TREES[module]):
        assert not isinstance(node, ast.Assert), f"{module}, line {node.lineno}"


@every_module
def test_third_parties_have_one_door(module):
    for name in imports(TREES[module]):
        for library, rooms in DOORS.items():
            if name == library or name.startswith(library + "."):
                assert room_of(module) in rooms


def test_import_of_the_package_is_light():
    code = "import sys, eslr_jax; assert 'jax' not in sys.modules; eslr_jax.SimConfig"
    subprocess.run([sys.executable, "-c", code], check=True)


def own_names(module: str) -> Iterator[str]:
    """Yield the names that a module gives to something, imports apart."""
    for node in TREES[module.removeprefix("eslr_jax.")].body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (target.id for target in targets if isinstance(target, ast.Name))


def documented_names() -> set[str]:
    """Return the names of the package and of its Python reference: what a change has to keep, or say."""
    names = {f"eslr_jax.{name}" for name in eslr_jax.__all__}
    pages = (PACKAGE.parent / "docs" / "api" / "reference.md").read_text()
    for module, options in re.findall(r"^::: (\S+)\n((?: .*\n)*)", pages, re.MULTILINE):
        members = re.search(r"members: \[(.*)\]", options)
        if members:
            names |= {f"{module}.{name}" for name in members[1].split(", ")}
        else:
            names |= {module, *(f"{module}.{name}" for name in own_names(module) if not name.startswith("_"))}
    for module in ("eslr_jax.terms", "eslr_jax.pipeline.assets"):
        names |= {f"{module}.{name}" for name in importlib.import_module(module).__all__}
    return names


def test_documented_names_are_there():
    for name in documented_names():
        module, _, attribute = name.rpartition(".")
        is_module = name.removeprefix("eslr_jax.") in TREES
        assert is_module or hasattr(importlib.import_module(module), attribute), f"{name} is no longer there"


def test_most_tests_import_documented_names_only():
    """The others test what stands behind: formats, pages and commands have their own files and outputs."""
    documented, files = documented_names(), sorted(Path(__file__).parent.rglob("test_*.py"))

    def is_public(path: Path) -> bool:
        taken = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        own = [node for node in taken if node.module and node.module.startswith("eslr_jax")]
        return all(f"{node.module}.{alias.name}" in documented for node in own for alias in node.names)

    public = [path for path in files if is_public(path)]
    assert len(public) >= 0.7 * len(files), f"{len(public)} of {len(files)}"
