"""What the documentation says can be run, is run."""

import contextlib
import io
import re
import shlex
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from formats import write_walker
from garment_files import scanned_tshirt

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Commands of ```bash blocks are run as they stand, apart from what would only take time:
SHORTER = {
    "train": ["--set", "iterations=1"],
    "evaluate": ["--gap-frames", "3", "--every", "1", "--rollout-frames", "4", "--garments", "tshirt"],
    "simulate": ["--frames", "3"],
}
# ```console blocks need what a test has not (a network, minutes of an idle machine, several machines): their
# options are checked, and `eslr view` is opened and closed.


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.S | re.M)


def commands(page, *languages):
    """Return the eslr commands of a page's blocks, as lists of words."""
    lines = [
        line for language in languages for block in blocks(page, language) for line in block.splitlines()
    ]
    parts = [part for line in lines for part in line.partition("#")[0].split("&&")]
    return [shlex.split(part) for part in parts if part.split()[:1] == ["eslr"]]


EVERY = [(page, words) for page in PAGES for words in commands(page, "bash", "console")]
RUN = [(page, words) for page in PAGES for words in commands(page, "bash")]
VIEWS = [(page, words) for page in PAGES for words in commands(page, "console") if words[1] == "view"]


def name(value):
    return value.stem if isinstance(value, Path) else "_".join(value[1:4])


@pytest.fixture(scope="module")
def help_of():
    from eslr_jax.cli import app

    texts = {}

    def show(command):
        if command not in texts:
            stream = io.StringIO()
            with contextlib.redirect_stdout(stream), contextlib.suppress(SystemExit):
                app.cli(prog="eslr", args=[command, "--help"])
            texts[command] = stream.getvalue()
        return texts[command]

    return show


def test_the_guides_hold_commands():
    assert len(RUN) > 15
    assert {words[1] for _, words in EVERY} >= {
        "simulate",
        "fit",
        "view",
        "render",
        "train",
        "evaluate",
        "assets",
    }


@pytest.mark.parametrize(("page", "words"), EVERY, ids=name)
def test_documented_options_exist(help_of, page, words):
    text = help_of(words[1])
    assert "usage" in text.lower(), words[1]
    for word in words[2:]:
        if word.startswith("--"):
            assert re.search(rf"{word}\b", text), f"{page.name}: {word}"


def test_links_between_pages_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page}: {target}"


@pytest.fixture(scope="module")
def workplace(tmp_path_factory, body):
    """A folder with what the guides presuppose: a user's shirt, clip, character with a garment, and recipes."""
    folder = tmp_path_factory.mktemp("docs")
    scanned_tshirt(folder / "shirt.obj", body)
    shutil.copy(ROOT / "tests" / "fixtures" / "cmu_01_01.bvh", folder / "walk.bvh")
    write_walker(folder / "character.glb", folder / "jacket.obj", body)
    shutil.copy(ROOT / "experiments" / "configs" / "eslr-small.toml", folder / "recipe.toml")
    (folder / "experiments").symlink_to(ROOT / "experiments")
    return folder


@pytest.mark.slow
@pytest.mark.example
@pytest.mark.parametrize(("page", "words"), RUN, ids=name)
def test_documented_commands_run(workplace, page, words):
    added = [] if {"--help", "--resume"} & set(words) else SHORTER.get(words[1], [])
    command = [sys.executable, "-m", "eslr_jax.cli", *words[1:], *added]
    result = subprocess.run(command, cwd=workplace, capture_output=True, text=True, timeout=900, check=False)
    assert result.returncode == 0, f"{page.name}: {' '.join(words)}\n{result.stderr}"


@pytest.mark.slow
@pytest.mark.example
@pytest.mark.parametrize(("page", "words"), VIEWS, ids=name)
def test_documented_views_serve_a_page(workplace, page, words):
    pytest.importorskip("viser")
    for run in words[2:]:  # whatever was simulated before this test
        if not (workplace / run).exists():
            simulate = [sys.executable, "-m", "eslr_jax.cli", "simulate", "--frames", "3", "--no-pictures"]
            subprocess.run(
                [*simulate, "--out", run], cwd=workplace, capture_output=True, timeout=900, check=True
            )
    command = [sys.executable, "-m", "eslr_jax.cli", *words[1:]]
    with subprocess.Popen(command, cwd=workplace, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            address = next(
                line.strip() for line in server.stdout if line.startswith("http")
            )  # under viser's own
            with urllib.request.urlopen(address, timeout=60) as answer:
                assert answer.status == 200
        finally:
            server.terminate()


@pytest.mark.slow
@pytest.mark.example
@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.stem
)
def test_documented_python_runs(page):
    code = "\n".join(blocks(page, "python"))
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=False
    )
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.example
def test_site_builds_strictly(tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings_handlers.python")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert result.returncode == 0, result.stderr
    assert "fit_garment" in (tmp_path / "site" / "api" / "reference" / "index.html").read_text()


@pytest.mark.slow
@pytest.mark.example
def test_notebook_runs_top_to_bottom(tmp_path):
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(ROOT / "notebooks" / "tour.ipynb", as_version=4)
    client = nbclient.NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    text = "".join(out.get("text", "") for cell in notebook.cells for out in cell.get("outputs", []))
    factor = float(re.search(r"recovered factor ([\d.]+)", text)[1])
    assert factor == pytest.approx(1.0, abs=0.02)
