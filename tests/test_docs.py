"""The commands, snippets and links of the documentation work."""

import ast
import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import jax
import pytest
from commands import eslr_here
from foreign_files import write_walker
from garment_files import scanned_tshirt

ROOT = Path(__file__).parents[1]
ESLR = [sys.executable, "-m", "eslr_jax.pipeline.cli"]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Commands of ```bash blocks are run as written, with these options to save time:
SHORTER = {
    "train": ["--set", "steps=1"],
    "evaluate": ["--gap-frames", "3", "--every", "1", "--rollout-frames", "4", "--garments", "tshirt"],
    "simulate": ["--frames", "3"],
}
# ```console blocks need a package index, an idle machine for minutes, or several machines. Only their options are
# checked, but `eslr view` is opened and closed.


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.S | re.M)


def commands(page, *languages):
    """Return the eslr commands of a page's blocks, as lists of words."""
    lines = [
        line for language in languages for block in blocks(page, language) for line in block.splitlines()
    ]
    parts = [part for line in lines for part in line.partition("#")[0].split("&&")]
    return [shlex.split(part) for part in parts if part.split()[:1] == ["eslr"]]


def shorter(words):
    """Return a command with the options that save time, in the place of its own."""
    added = [] if {"--help", "--resume"} & set(words) else SHORTER.get(words[1], [])
    kept = list(words)
    for option in [word for word in added if word.startswith("--") and word != "--set"]:
        if option in kept:
            del kept[kept.index(option) : kept.index(option) + 2]  # each has one value
    return kept + added


EVERY = [(page, words) for page in PAGES for words in commands(page, "bash", "console")]
RUN = [(page, words) for page in PAGES for words in commands(page, "bash")]
VIEWS = [(page, words) for page in PAGES for words in commands(page, "console") if words[1] == "view"]


def name(value):
    return value.stem if isinstance(value, Path) else "_".join(value[1:4])


def help_text(*command):
    """Return what `eslr COMMAND --help` prints, in one line."""
    return " ".join(eslr_here(*command, "--help").stdout.split())


def test_guides_show_every_command():
    commands = re.search(r"\{([a-z, -]+)\}", help_text())[1].replace(" ", "").split(",")
    assert {words[1] for _, words in EVERY} == set(commands)


def test_documented_options_exist():
    texts = {command: help_text(command) for command in {words[1] for _, words in EVERY}}
    options = {
        (page.name, words[1], word) for page, words in EVERY for word in words if word.startswith("--")
    }
    missing = [
        (page, command, word)
        for page, command, word in options
        if not re.search(rf"{re.escape(word)}(?![\w-])", texts[command])
    ]
    assert not missing


def anchors(page):
    """Return the anchors of a page's headings, as mkdocs makes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M)  # where # begins a comment
    headings = re.findall(r"^#+ (.+)$", text, flags=re.M)
    words = [re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in headings]
    return {re.sub(r"[\s-]+", "-", heading) for heading in words}


def test_links_between_pages_lead_somewhere():
    pages = [*PAGES, *sorted((ROOT / "experiments").glob("*.md"))]
    links = [
        (page, link, anchor)
        for page in pages
        for link, anchor in re.findall(r"\]\((?!http)([^)#]*)#?([^)]*)\)", page.read_text())
    ]
    assert len(links) > len(pages)
    assert [(page, link) for page, link, _ in links if not (page.parent / link).exists()] == []
    anchored = [
        (page, page.parent / link if link else page, anchor) for page, link, anchor in links if anchor
    ]
    assert anchored
    assert [entry for entry in anchored if entry[2] not in anchors(entry[1])] == []


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "guides").glob("*.md")), ids=name)
def test_every_guide_has_one_picture_and_ends_in_what_can_go_wrong(page):
    text = page.read_text()
    (picture,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert (page.parent / picture).exists()
    assert re.findall(r"^## (.+)$", text, flags=re.M)[-1] == "What can go wrong"


@pytest.fixture(scope="module")
def workplace(tmp_path_factory, body):
    """A folder with the files of the guides: a shirt, a clip, a character with a jacket, and recipes."""
    folder = tmp_path_factory.mktemp("docs")
    scanned_tshirt(folder / "shirt.obj", body)
    shutil.copy(ROOT / "tests" / "fixtures" / "cmu_01_01.bvh", folder / "walk.bvh")
    write_walker(folder / "character.glb", folder / "jacket.obj", body)
    shutil.copy(ROOT / "experiments" / "configs" / "eslr-small.toml", folder / "recipe.toml")
    shutil.copy(ROOT / "data" / "patterns" / "tshirt.json", folder)
    for page in PAGES:  # a snippet whose first line is a comment with a file's name is that file
        for code in blocks(page, "python"):
            if named := re.match(r"# (\w+\.py)\n", code):
                (folder / named[1]).write_text(code)
    (folder / "experiments").symlink_to(ROOT / "experiments")
    return folder


@pytest.mark.slow
@pytest.mark.example
@pytest.mark.parametrize(("page", "words"), RUN, ids=name)
def test_documented_commands_run(workplace, page, words):
    command = [*ESLR, *shorter(words)[1:]]
    result = subprocess.run(command, cwd=workplace, capture_output=True, text=True, timeout=900, check=False)
    assert result.returncode == 0, f"{page.name}: {' '.join(words)}\n{result.stderr}"


def simulate_missing(folder, runs):
    """Simulate the runs that a snippet reads, whatever was simulated before it."""
    for run in runs:
        if not (folder / run).exists():
            command = [*ESLR, "simulate", "--frames", "3", "--no-pictures", "--out", run]
            subprocess.run(command, cwd=folder, capture_output=True, timeout=900, check=True)


@pytest.mark.slow
@pytest.mark.example
@pytest.mark.parametrize(("page", "words"), VIEWS, ids=name)
def test_documented_views_serve_a_page(workplace, page, words):
    pytest.importorskip("viser")
    simulate_missing(workplace, words[2:])
    with subprocess.Popen([*ESLR, *words[1:]], cwd=workplace, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            # Under viser's own.
            address = next(line.strip() for line in server.stdout if line.startswith("http"))
            with urllib.request.urlopen(address, timeout=60) as reply:
                assert reply.status == 200
        finally:
            server.terminate()


PYTHON = {page: "\n".join(blocks(page, "python")) for page in PAGES if blocks(page, "python")}
NOTEBOOK = ROOT / "notebooks" / "tour.ipynb"


def cells(notebook):
    """Return the code of a notebook."""
    every = json.loads(notebook.read_text())["cells"]
    return "\n".join("".join(cell["source"]) for cell in every if cell["cell_type"] == "code")


CHECKED = {**PYTHON, NOTEBOOK: cells(NOTEBOOK)}


@pytest.fixture(scope="module")
def complaints(tmp_path_factory):
    """Return what a type checker says of every page's Python, page by page."""
    folder = tmp_path_factory.mktemp("documented")
    for page, code in CHECKED.items():
        (folder / f"{page.stem}.py").write_text(code)
    # Calls and names alone: what flax adds to a class, a type checker does not see.
    rules = {"typeCheckingMode": "off", "reportCallIssue": "error", "reportUndefinedVariable": "error"}
    (folder / "pyrightconfig.json").write_text(json.dumps(rules))
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable]
    result = subprocess.run([*command, "-p", str(folder)], capture_output=True, text=True, check=False)
    report = json.loads(result.stdout[result.stdout.index("{") :])  # the first run may say what it installs
    assert report["summary"]["filesAnalyzed"] == len(CHECKED)
    return {
        page: [one["message"] for one in report["generalDiagnostics"] if Path(one["file"]).stem == page.stem]
        for page in CHECKED
    }


@pytest.mark.parametrize("page", CHECKED, ids=lambda page: page.stem)
def test_documented_python_calls_what_exists(page, complaints):
    # `.ci/run` runs it by the test below; this one finds at once an argument or a name that is gone.
    assert complaints[page] == []
    for statement in ast.walk(ast.parse(CHECKED[page])):
        if isinstance(statement, ast.ImportFrom):
            module = importlib.import_module(statement.module)
            assert all(hasattr(module, one.name) for one in statement.names)


@pytest.mark.slow
@pytest.mark.example
@pytest.mark.documented
@pytest.mark.parametrize("page", CHECKED, ids=lambda page: page.stem)
def test_documented_python_runs(page, tmp_path):
    code = CHECKED[page]
    simulate_missing(tmp_path, sorted(set(re.findall(r"\bout/\w+", code))))
    # What one page compiled, another takes from the cache.
    environment = {"JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir, **os.environ}
    command = [sys.executable, "-c", code]
    result = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    assert result.returncode == 0, result.stderr
    if page == NOTEBOOK:
        factor = float(re.search(r"recovered factor ([\d.]+)", result.stdout)[1])
        assert factor == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
@pytest.mark.example
def test_site_builds_strictly(tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings_handlers.python")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert result.returncode == 0, result.stderr
    assert "fit_garment" in (tmp_path / "site" / "api" / "reference" / "index.html").read_text()
