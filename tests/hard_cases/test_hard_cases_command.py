"""What the command keeps, draws and refuses."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hard_cases import CASES, run_case
from hard_cases.report import draw_sheet, merge_summaries, summarize
from test_hard_cases import ballistic

FOLDER = Path(__file__).parents[2] / "experiments" / "hard_cases"


@pytest.fixture(scope="module")
def outcome():
    return run_case(CASES["free_fall"], ballistic(drift=0.03))


def command(*arguments, **options):
    done = subprocess.run(
        [sys.executable, str(FOLDER), *arguments], capture_output=True, text=True, check=False, **options
    )
    return done.returncode, done.stderr.strip().splitlines()


def test_summary_keeps_figures_reasons_and_versions(outcome):
    pytest.importorskip("ipctk")
    kept = json.loads(json.dumps(summarize("ballistic", outcome), allow_nan=False))
    assert kept["measures"] == outcome.rows()
    assert kept["passed"] == 0
    assert kept["cases"]["free_fall"]["passed"] is False
    assert kept["cases"]["free_fall"]["reason"] == CASES["free_fall"].reason
    assert {"jax", "ipctk", "python"} <= set(kept["versions"])


def test_merged_summary_replaces_a_case_and_keeps_the_others_in_order():
    def one(name, passed, value):
        return {
            "passed": int(passed),
            "cases": {name: {"passed": passed}},
            "measures": [{"case": name, "value": value}],
        }

    both = merge_summaries(one("slope", True, 1), one("hang", False, 2))
    again = merge_summaries(both, one("hang", True, 3))
    assert list(again["cases"]) == ["hang", "slope"]
    assert [row["value"] for row in again["measures"]] == [3, 1]
    assert (both["passed"], again["passed"]) == (1, 2)


def test_missing_package_is_one_line_and_exit_code_2(tmp_path):
    for module in ("ipctk", "mitsuba"):
        (tmp_path / f"{module}.py").write_text("raise ImportError")
        code, lines = command("physics", "--sheet", "--out", tmp_path, env={"PYTHONPATH": tmp_path})
        assert (code, len(lines)) == (2, 1)
        assert f"needs {module}" in lines[0]
        (tmp_path / f"{module}.py").unlink()
    assert not list(tmp_path.glob("*.json"))


@pytest.mark.slow
def test_command_keeps_a_case_and_refuses_an_unknown_one(tmp_path):
    pytest.importorskip("ipctk")
    code, lines = command("physics", "--case", "freefall", "--out", tmp_path)
    assert (code, len(lines)) == (2, 1)
    assert "free_fall" in lines[0]
    assert not list(tmp_path.iterdir())
    code, _ = command("physics", "--case", "free_fall", "--out", tmp_path)
    kept = json.loads((tmp_path / "hard_cases_physics.json").read_text())
    assert (code, kept["passed"], list(kept["cases"])) == (0, 1, ["free_fall"])


@pytest.mark.slow
def test_sheet_shows_every_case(outcome):
    pytest.importorskip("mitsuba")
    pytest.importorskip("PIL")
    assert draw_sheet([outcome]).std() > 5, "something is to be seen"
    twice = draw_sheet([outcome, outcome])
    assert twice.dtype == np.uint8
    assert twice.shape[1] > 2 * 200


@pytest.mark.parametrize(("words", "option"), [
    (("corrected", "--integrator", "euler", "--substeps", "2"), "--integrator, --substeps"),
    (("physics", "--model", "smooth-small"), "--model"),
])  # fmt: skip
def test_options_of_another_simulator_are_refused(tmp_path, words, option):
    code, lines = command(*words, "--out", tmp_path)
    assert (code, len(lines)) == (2, 1)
    assert option in lines[0]
