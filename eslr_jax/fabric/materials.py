"""Named fabrics."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from eslr_jax.terms.bending import RIGIDITY_PER_STIFFNESS
from eslr_jax.terms.gravity import Gravity
from eslr_jax.terms.stretch import stretch_stiffness
from eslr_jax.types import Material

COTTON: Any = Material(
    density=np.float32(0.20022),  # [kg/m^2] = 426 kg/m^3 x 0.47 mm
    lame_mu=np.float32(23600.0),  # [Pa]
    lame_lambda=np.float32(44400.0),  # [Pa]
    bending_stiffness=np.float32(3.9625778e-5),  # [J] = 50 (lambda + 2 mu) h^3 / 12
    thickness=np.float32(4.7e-4),  # [m]
)
"""The fabric of SNUG (Santesteban et al. 2022) with which HOOD and the paper evaluate."""

_WANG = "Wang, O'Brien, Ramamoorthi 2011, doi:10.1145/2010324.1964966, data of ARCSim"
_POISSON = 0.3  # of woven and knitted cloth along its threads; Wang et al. measure 0.1 to 0.6


@dataclasses.dataclass(frozen=True)
class Fabric:
    """What is measured of a fabric, as one isotropic sheet."""

    density: float  # [kg/m^2]
    stretch_stiffness: float  # [N/m] tension per width and strain, at the start, along the stiffer thread
    bending_stiffness: float  # [J] at small curvature, along the warp; ARCSim's convention is HOOD's
    what: str
    source: str


def _measured(density: float, stretch: float, bending: float, what: str, name: str) -> Fabric:
    return Fabric(density, stretch, bending, what, f"{_WANG}: {name}")


FABRICS: dict[str, Fabric] = {
    "jersey": _measured(
        0.187, 68.95, 2.3192e-5, "T-shirt knit, 60 % cotton 40 % polyester", "gray interlock"
    ),
    "rib-knit": _measured(0.276, 130.3, 4.6242e-5, "95 % cotton 5 % spandex", "ivory rib knit"),
    "sweatshirt": _measured(0.224, 24.98, 5.9467e-5, "96 % polyester 4 % spandex", "navy sparkle sweat"),
    "ponte": _measured(0.284, 88.06, 3.6349e-5, "double knit, 60 % polyester 40 % rayon", "camel ponte roma"),
    "swimwear": _measured(0.204, 209.2, 6.0243e-5, "87 % nylon 13 % spandex", "white swim solid"),
    "satin": _measured(0.113, 342.8, 1.4289e-5, "100 % polyester", "tango red jet set"),
    "brocade": _measured(0.228, 489.7, 1.1710e-4, "100 % polyester", "pink ribbon brown"),
    "denim": _measured(0.324, 2027.8, 6.4198e-5, "11 oz, 99 % cotton 1 % spandex", "11oz black denim"),
    "crepe": _measured(0.128, 4055.0, 5.1707e-5, "100 % polyester", "white dots on black"),
    "suiting": _measured(0.220, 4070.0, 1.2545e-4, "65 % cotton 35 % polyester", "royal target"),
    "silk": Fabric(
        0.0694,
        342.8,
        3e-6,
        "crepe de chine of 16 momme",
        "class: 1 momme = 4.340 g/m^2; a bending length of 1 cm; stretch as the satin's",
    ),
}
"""Fabrics besides cotton. Measured sheets are anisotropic and stiffen: these are their values at small strain,
of stretch along the stiffer thread, of bending along the warp."""


@dataclasses.dataclass(frozen=True)
class Weave:
    """What a fabric with warp and weft resists with; a part that is None is an isotropic sheet's."""

    # [N/m] tension per width and strain along warp, along weft, of one by the strain of the other, and of shear
    stiffness: tuple[float, float, float, float] | None = None
    rigidity: tuple[float, float] | None = None  # flexural, along warp and weft [N m]
    limits: tuple[float, float] | None = None  # strain along warp and weft beyond which they stiffen


@dataclasses.dataclass(frozen=True)
class Woven:
    """A fabric as it was measured along its threads."""

    density: float  # [kg/m^2]
    weave: Weave
    what: str
    source: str


def _woven(name: str, stretch: tuple[float, float, float, float], bending: tuple[float, float]) -> Woven:
    """Return a fabric of the ten that were measured by threads, one of `FABRICS`.

    The stretch is the four numbers of the data's first row, c11, c12, c22 and c33 [N/m]: the energy per area is
    c11 G_uu^2 + 2 c12 G_uu G_vv + c22 G_vv^2 + c33 G_uv^2, with v along the warp. A negative coupling is taken as
    zero, as by ARCSim. The bending is that at small curvature, of edges along u and along v [J].
    """
    fabric, (weft, coupling, warp, shear) = FABRICS[name], stretch
    stiffness = (2.0 * warp, 2.0 * weft, 2.0 * max(coupling, 0.0), 0.5 * shear)
    along, across = (RIGIDITY_PER_STIFFNESS * number for number in bending)
    return Woven(fabric.density, Weave(stiffness, (along, across)), fabric.what, fabric.source)


def rigidity_of(bending_length: float, density: float) -> float:
    """Return the flexural rigidity [N m] of a bending length c [m]: D = w c^3, with w the weight per area.

    Peirce's bending length is half of the overhang whose end lies 41.5 degrees below its edge.

    Source: Peirce 1930, doi 10.1080/19447023008661529.
    """
    return density * Gravity.acceleration * bending_length**3


def _class(density: float, bending_length: float, stretch: float, shear: float, what: str) -> Woven:
    """Return a fabric that is like its class, alike along warp and weft; see `rigidity_of`."""
    rigidity = rigidity_of(bending_length, density)
    weave = Weave((stretch, stretch, 0.0, shear), (rigidity, rigidity))
    return Woven(density, weave, what, "class: no measurement has all its numbers")


WOVEN: dict[str, Woven] = {
    "jersey-woven": _woven("jersey", (16.594, -14.696, 34.477, 36.860), (23.192e-6, 14.268e-6)),
    "rib-knit-woven": _woven("rib-knit", (42.871, -0.2346, 65.166, 83.176), (46.238e-6, 32.244e-6)),
    "sweatshirt-woven": _woven("sweatshirt", (12.486, -19.875, 3.2724, 17.616), (59.470e-6, 45.625e-6)),
    "ponte-woven": _woven("ponte", (31.146, -12.803, 44.029, 31.896), (36.348e-6, 37.158e-6)),
    "swimwear-woven": _woven("swimwear", (47.971, 6.8345, 104.62, 60.774), (60.238e-6, 51.019e-6)),
    "satin-woven": _woven("satin", (43.068, 54.373, 171.42, 14.315), (14.294e-6, 20.346e-6)),
    "brocade-woven": _woven("brocade", (151.50, 106.03, 244.83, 30.250), (117.07e-6, 59.774e-6)),
    "denim-woven": _woven("denim", (205.35, 10.234, 1013.9, 53.387), (64.196e-6, 96.952e-6)),
    "crepe-woven": _woven("crepe", (2002.1, 0.3456, 2027.5, 19.189), (51.714e-6, 31.283e-6)),
    "suiting-woven": _woven("suiting", (2016.6, 9.1705, 2035.0, 104.76), (125.41e-6, 125.41e-6)),
    "silk-woven": _class(0.0694, 0.0100, 300.0, 15.0, "crepe de chine of 16 momme"),
    "cotton-woven": _class(0.120, 0.0200, 1000.0, 30.0, "plain shirting"),
    "wool-woven": _class(0.200, 0.0185, 500.0, 30.0, "worsted suiting"),
    "raw-denim-woven": _class(0.407, 0.0250, 2000.0, 80.0, "12 oz, not washed"),
    "leather": _class(0.500, 0.0160, 3000.0, 1000.0, "sheep, 0.8 mm"),
}
"""Fabrics along their threads, at small strain. The last five are not measured: a class says what they are
like, and their drape coefficients lie in the bands of their kinds."""


def along_threads(fabric: Fabric | Woven) -> tuple[tuple[float, float, float, float], tuple[float, float]]:
    """Return the stiffness [N/m] and the flexural rigidity [N m] of a fabric, as a `Weave` has them.

    An isotropic sheet has the same along both threads. Its rigidity is that of equilateral triangles with HOOD's
    bending stiffness.
    """
    if isinstance(fabric, Woven):
        return fabric.weave.stiffness, fabric.weave.rigidity  # type: ignore[return-value]: named ones have both
    stretch, rigidity = fabric.stretch_stiffness, RIGIDITY_PER_STIFFNESS * fabric.bending_stiffness
    return (stretch, stretch, _POISSON * stretch, stretch / (2.0 * (1.0 + _POISSON))), (rigidity, rigidity)


def bending_lengths(fabric: Fabric | Woven) -> tuple[float, float]:
    """Return the bending length c along warp and weft [m]: (D / w)^(1/3), see `rigidity_of`."""
    warp, weft = (rigidity / (fabric.density * Gravity.acceleration) for rigidity in along_threads(fabric)[1])
    return warp ** (1 / 3), weft ** (1 / 3)


def isotropic_nearest(weave: Weave, base: Material) -> Material:
    """Return the isotropic sheet that is nearest to a weave, with the density and thickness of another material.

    Networks read its numbers. The geometric mean of warp and weft stands for both.
    """
    changes: dict[str, Any] = {}
    if weave.stiffness is not None:
        stretch = np.sqrt(weave.stiffness[0] * weave.stiffness[1])
        changes |= _lame(stretch, np.asarray(base.thickness))
    if weave.rigidity is not None:
        mean = np.sqrt(weave.rigidity[0] * weave.rigidity[1])
        changes["bending_stiffness"] = np.float32(mean / RIGIDITY_PER_STIFFNESS)
    return base.replace(**changes)


def _lame(stretch: float, thickness: Any) -> dict[str, Any]:
    """Return the Lame parameters [Pa] of a sheet by its stretch stiffness [N/m], in plane stress."""
    return {
        "lame_mu": np.float32(stretch / (2.0 * (1.0 + _POISSON)) / thickness),
        "lame_lambda": np.float32(stretch * _POISSON / (1.0 - _POISSON**2) / thickness),
    }


def all_fabrics() -> dict[str, Fabric | Woven]:
    """Return every named fabric: cotton, those of one stiffness, those by threads."""
    cotton = Fabric(
        float(COTTON.density),
        float(stretch_stiffness(COTTON)),
        float(COTTON.bending_stiffness),
        "the fabric of SNUG, HOOD and the paper",
        "Santesteban et al. 2022 (SNUG)",
    )
    return {"cotton": cotton, **FABRICS, **WOVEN}


def fabric_names() -> tuple[str, ...]:
    """Return the names that `fabric_material` knows."""
    return ("cotton", *FABRICS)


def fabric_material(name: str) -> Material:
    """Return a named fabric; KeyError if there is no such name.

    With E the stretch stiffness and nu = 0.3, mu h = E / (2 (1 + nu)) and lambda h = E nu / (1 - nu^2), those of
    plane stress. The thickness h is cotton's: only products with it enter the energies, and the network reads
    the Lame constants on the scale of a sheet of that thickness.
    """
    if name == "cotton":
        return COTTON
    fabric = FABRICS[name]
    return COTTON.replace(
        density=np.float32(fabric.density),
        bending_stiffness=np.float32(fabric.bending_stiffness),
        **_lame(fabric.stretch_stiffness, COTTON.thickness),
    )
