"""The command's work: running cases, keeping figures, drawing pictures."""

import json

import numpy as np
import pytest
from test_hard_cases import ballistic

from eslr_jax.evaluation.stress import rows, stress, summary, write_pictures

pytest.importorskip("ipctk")


@pytest.fixture(scope="module")
def outcomes():
    return stress(ballistic(drift=0.03), ["free_fall"])


def test_cases_are_run_by_name_and_reported():
    seen = []
    stress(ballistic(), ["free_fall"], on_case=lambda name, outcome, seconds: seen.append((name, outcome)))
    assert [name for name, _ in seen] == ["free_fall"]
    assert seen[0][1].is_passed


def test_summary_keeps_figures_reasons_and_versions(outcomes):
    kept = json.loads(json.dumps(summary(ballistic(), outcomes), allow_nan=False))
    assert kept["measures"] == rows(outcomes)
    assert kept["passed"] == 0
    assert kept["cases"]["free_fall"]["passed"] is False
    assert kept["cases"]["free_fall"]["reason"]
    assert {"jax", "ipctk", "python"} <= set(kept["versions"])


def test_pictures_show_each_case_and_all(outcomes, tmp_path):
    pytest.importorskip("mitsuba")
    image = pytest.importorskip("PIL.Image")
    write_pictures(outcomes, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"free_fall.png", "sheet.png"}
    picture = np.asarray(image.open(tmp_path / "free_fall.png"))
    assert picture.std() > 5, "something is to be seen"
