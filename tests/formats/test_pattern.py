"""Sewing patterns: what is read, and what is refused in one line."""

import copy
import json
import math
from pathlib import Path

import numpy as np
import pytest
from broken import read
from commands import eslr_here, refused

PATTERNS = Path(__file__).parents[2] / "data" / "patterns"
SKIRT = json.loads((PATTERNS / "skirt.json").read_text())


def changed(*path, to):
    """Return the skirt with one entry in another place."""
    whole = copy.deepcopy(SKIRT)
    at = whole
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = to
    return whole


def front(*path, to):
    return changed("pattern", "panels", "front", *path, to=to)


def arc(*params):
    return front("edges", 0, "curvature", to={"type": "circle", "params": list(params)})


STITCH = {"panel": "front", "edge": 1}
DAMAGED = {
    "no JSON": ("{", "can't be read"),
    "another JSON": ([1, 2], "has no pattern"),
    "no panels": (changed("pattern", "panels", to={}), "has no panels"),
    "no properties": ({"pattern": SKIRT["pattern"]}, "has no properties"),
    "no unit": (changed("properties", to={}), "has no units_in_meter"),
    "unit of zero": (changed("properties", "units_in_meter", to=0), "units_in_meter = 0"),
    "unit too small": (changed("properties", "units_in_meter", to=1000), "1000 units in a metre"),
    "inches": (changed("properties", "units_in_meter", to=39.37), "away from the body"),
    "absolute curves": (changed("properties", "curvature_coords", to="absolute"), "not relative"),
    "no translation": (front("translation", to=None), "has no translation"),
    "NaN": (front("vertices", 0, to=[math.nan, 1]), "finite numbers"),
    "rotation of two": (front("rotation", to=[0, 1]), "3 finite numbers"),
    "shear": (front("rotation", to=[[1, 1, 0], [0, 1, 0], [0, 0, 1]]), "no rotation"),
    "vertex that is missing": (front("edges", 0, "endpoints", to=[0, 9]), "joins the vertices [0, 9]"),
    "open loop": (front("edges", 1, "endpoints", to=[1, 3]), "is open: edge 1 ends"),
    "no length": (front("vertices", 1, to=[-32, 52]), "edge 0 has no length"),
    "no area": (front("edges", to=[{"endpoints": [0, 1]}, {"endpoints": [1, 0]}]), "no area"),
    "crossing outline": (front("vertices", 2, to=[-40, 102]), "cross"),
    "outline that touches itself": (front("vertices", 2, to=[-32, 52]), "touches itself"),
    "unknown curve": (front("edges", 0, "curvature", "type", to="spline"), "curvature 'spline'"),
    "control point of three": (front("edges", 0, "curvature", "params", to=[[0, 1, 2]]), "1 x 2 finite"),
    "arc too small": (arc(20, 0, 0), "can't span"),
    "unknown panel": (changed("pattern", "stitches", 0, 0, "panel", to="x"), "names the panel x"),
    "unknown edge": (changed("pattern", "stitches", 0, 0, "edge", to=7), "names edge 7"),
    "edge of text": (changed("pattern", "stitches", 0, 0, "edge", to="1"), "has no edge"),
    "edge sewn twice": (changed("pattern", "stitches", 1, 0, to=STITCH), "sews front edge 1 again"),
    "half a stitch": (changed("pattern", "stitches", 0, to=[STITCH]), "is not two edges"),
    "no stitches": (changed("pattern", "stitches", to=[]), "is sewn to nothing"),
    "panel far away": (front("translation", to=[0, 0, 150]), "away from the body"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_pattern_is_refused_and_leaves_nothing(tmp_path, monkeypatch, case):
    whole, cause = DAMAGED[case]
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "pattern.json"
    path.write_text(whole if isinstance(whole, str) else json.dumps(whole))
    refused(eslr_here("sew", "pattern.json", "--out", "out/skirt.npz", "--no-picture"), "pattern.json", cause)
    assert list(tmp_path.iterdir()) == [path]


def edge_length(edge):
    return np.linalg.norm(np.diff(edge, axis=0), axis=1).sum()


def signed_area(outline):
    """Return Gauss's area of a polygon, positive where it runs counter-clockwise."""
    x, y = outline.T
    return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))


def test_lengths_are_metres(tmp_path):
    pattern = read("pattern", PATTERNS / "skirt.json")
    front, back = pattern.panels.values()
    np.testing.assert_allclose(front.edges[1], [[0.32, 0.52], [0.2, 1.02]])
    assert signed_area(front.outline) > 0 > signed_area(back.outline)  # both turned outwards
    np.testing.assert_allclose(back.placed(back.edges[0])[0], [-0.2, 1.02, -0.2])
    for seam in pattern.seams:
        first, second = (pattern.panels[side.panel].edges[side.edge] for side in seam.sides)
        assert edge_length(first) == pytest.approx(edge_length(second))


@pytest.mark.parametrize(("is_right", "height"), [(1, 0.52 - 0.16), (0, 0.52 + 0.16)])
def test_arcs(tmp_path, is_right, height):
    """To the right of an edge along x is below it; a chord of 64 of a circle of 40 is 24 from the middle."""
    path = tmp_path / "pattern.json"
    path.write_text(json.dumps(arc(40, 0, is_right)))
    edge = read("pattern", path).panels["front"].edges[0]
    np.testing.assert_allclose(edge[len(edge) // 2], [0, height], atol=1e-9)
    assert edge_length(edge) == pytest.approx(0.8 * math.asin(0.8), rel=1e-3)


def test_large_and_small_arc(tmp_path):
    """The large arc to the right and the small one are one circle's, which bulges deeper."""
    path, depths = tmp_path / "pattern.json", []
    for is_large in (0, 1):
        path.write_text(json.dumps(arc(40, is_large, 1)))
        depths.append(0.52 - read("pattern", path).panels["front"].edges[0][:, 1].min())
    np.testing.assert_allclose(depths, [0.4 - 0.24, 0.4 + 0.24], atol=1e-6)  # 24, 32, 40


def test_rotations(tmp_path):
    """Degrees about x, then y, then z; a matrix says the same."""
    path, placed = tmp_path / "pattern.json", []
    for rotation in ([90, 0, 90], [[0, 0, 1], [1, 0, 0], [0, 1, 0]]):
        path.write_text(json.dumps(front("rotation", to=rotation)))
        panel = read("pattern", path).panels["front"]
        placed.append(panel.placed(np.eye(2)) - panel.translation)
    np.testing.assert_allclose(placed[0], [[0, 1, 0], [0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(placed[1], placed[0], atol=1e-9)
