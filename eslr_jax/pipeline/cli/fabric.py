"""`eslr fabric`: the numbers of a fabric from what was measured of it."""

from __future__ import annotations

import dataclasses
import json
import math

from eslr_jax.errors import ConfigError
from eslr_jax.pipeline.cli.console import app, use_compile_cache, waiting

_WEIGHTS = {"gsm": 1e-3, "g/m2": 1e-3, "kg/m2": 1.0}  # [kg/m^2]
_LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}  # [m]
_LIGHTEST, _HEAVIEST = 0.01, 2.0  # [kg/m^2]: organza is 0.02, a heavy coating 0.8
_SHORTEST, _LONGEST = 6e-3, 0.1  # [m]: limp chiffon is 0.01, stiff canvas 0.06; finer discs take hours


@app.command(name="fabric")
@dataclasses.dataclass(frozen=True)
class Fabric:
    """Describe a fabric by its weight, bending length and drape coefficient, for `--fabric` of other commands.

    Weight and bending length are met exactly. The drape coefficient is met by the stiffness in shear, which is
    searched for: discs of 30 cm are simulated over a table of 18 cm. Takes a few minutes.
    """

    # Weight per area, such as 150gsm, 150g/m2 or 0.15kg/m2.
    weight: str
    # Bending length of Peirce's cantilever test, half of what overhangs, such as 2.1cm; the mean of both threads.
    bending_length: str
    # Cusick's drape coefficient, such as 0.68 or 68%.
    drape: str
    # Print as JSON.
    json: bool = False

    def __call__(self) -> None:
        """Search, and print the fabric."""
        weight = _quantity("--weight", self.weight, _WEIGHTS, (_LIGHTEST, _HEAVIEST), "150gsm")
        length = _quantity("--bending-length", self.bending_length, _LENGTHS, (_SHORTEST, _LONGEST), "2.1cm")
        drape = _quantity("--drape", self.drape, {"%": 1e-2, "": 1.0}, (0.0, 1.0), "0.68 or 68%")

        from eslr_jax.pipeline.drape import STRETCH, fit_drape

        use_compile_cache()
        with waiting("hanging discs"):
            fitted = fit_drape(drape, weight, length)
        if self.json:
            print(json.dumps(fitted._asdict()))
            return
        print(fitted.fabric)
        low, high = (100 * share for share in fitted.drapes)
        print(f"drape coefficient {100 * fitted.drape:.0f} %; shear alone gives {low:.0f} to {high:.0f} %")
        print(
            f"free: stretch, taken as {STRETCH:g} N/m of woven cotton; the difference of warp and weft, taken as "
            "none; hysteresis, which is not modelled"
        )


def _quantity(
    option: str, text: str, units: dict[str, float], accepted: tuple[float, float], example: str
) -> float:
    """Return a number with its unit in SI.

    Raises:
        ConfigError: It has no such unit, or is out of what fabrics have.
    """
    unit = next((unit for unit in sorted(units, key=len, reverse=True) if text.strip().endswith(unit)), None)
    try:
        value = math.nan if unit is None else float(text.strip().removesuffix(unit)) * units[unit]
    except ValueError:
        value = math.nan
    low, high = accepted
    if not low < value < high:
        names = ", ".join(name for name in units if name) + " or no unit" * ("" in units)
        raise ConfigError(
            f"{option} {text}: write it such as {example}, in {names}, between {low:g} and {high:g} "
            f"{next(name for name, size in units.items() if size == 1.0)}".rstrip()
        )
    return value
