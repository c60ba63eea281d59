"""Drape coefficients of the named fabrics, and the bands that fabrics of their kind have."""

from __future__ import annotations

from typing import NamedTuple


class Band(NamedTuple):
    """Cusick's drape coefficients of a kind of fabric [%], discs of 30 cm over 18 cm."""

    low: float
    high: float
    source: str


_COTTON = Band(
    60, 76, "Gan, Ly, Steven 1991, doi:10.1080/00405009108658741, measured 68.4; the band is a class"
)
_SILK = Band(20, 40, "class: light silk")
_SUITING = Band(40, 70, "class: worsted wool suiting")
_DENIM = Band(70, 90, "class: heavy cotton twill")

BANDS = {
    "cotton": _COTTON,
    "cotton-woven": _COTTON,
    "silk": _SILK,
    "silk-woven": _SILK,
    "satin": _SILK,
    "satin-woven": _SILK,
    "suiting": _SUITING,
    "suiting-woven": _SUITING,
    "wool-woven": _SUITING,
    "denim": _DENIM,
    "denim-woven": _DENIM,
    "raw-denim-woven": _DENIM,
    "leather": Band(47, 70, "Memon et al. 2021, doi:10.3390/ma14164553: sheep leather of 0.64 to 0.96 mm"),
}

DRAPES = {
    "cotton": 0.52,
    "jersey": 0.43,
    "rib-knit": 0.51,
    "sweatshirt": 0.54,
    "ponte": 0.43,
    "swimwear": 0.69,
    "satin": 0.53,
    "brocade": 0.79,
    "denim": 0.7,
    "crepe": 0.87,
    "suiting": 0.88,
    "silk": 0.47,
    "jersey-woven": 0.35,
    "rib-knit-woven": 0.44,
    "sweatshirt-woven": 0.5,
    "ponte-woven": 0.41,
    "swimwear-woven": 0.63,
    "satin-woven": 0.46,
    "brocade-woven": 0.67,
    "denim-woven": 0.61,
    "crepe-woven": 0.72,
    "suiting-woven": 0.82,
    "silk-woven": 0.27,
    "cotton-woven": 0.72,
    "wool-woven": 0.63,
    "raw-denim-woven": 0.82,
    "leather": 0.61,
}
"""Share of the rim's shadow that is left in `pipeline.drape.hang`: medians of starts, edges of 10 mm, and of
5 mm for `silk-woven`; of experiments/results/known_answers.json."""
