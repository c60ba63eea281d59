"""Tables of the paper that grow row by row."""

import json

from paper.rollouts import Setting
from paper.tables import rows_of_setting

SETTING = Setting(("tshirt", "dress"), ("cmu_016_32",), 100, "1k")
ROW = {"stretch": 0.1}
TABLE = {
    **SETTING._asdict(),
    "mean": {"mgn-5": ROW},
    "seeds": {},
    "garments": {"mgn-5": {"tshirt": ROW, "dress": ROW}},
}


def test_rows_of_the_same_setting_are_kept():
    kept = rows_of_setting(json.loads(json.dumps(TABLE)), SETTING)
    assert kept == {name: TABLE[name] for name in ("mean", "seeds", "garments")}


def test_rows_of_another_setting_are_dropped():
    for other in (
        SETTING._replace(garments=("tshirt",)),
        SETTING._replace(clips=("cmu_016_29",)),
        SETTING._replace(frames=50),
    ):
        assert not any(rows_of_setting(json.loads(json.dumps(TABLE)), other).values())
