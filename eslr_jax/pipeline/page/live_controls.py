"""The controls of `eslr play`, and what they ask for."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from eslr_jax.fabric.materials import fabric_material, fabric_names
from eslr_jax.pipeline.assets import asset_names
from eslr_jax.types import Material

_NOTHING = "nothing"  # no garment over the others
_FACTORS = (0.1, 10.0)  # of a fabric's constants
_MOST_BETAS = 2.5  # [standard deviations], of the sliders unless more is asked for
_STRONGEST = 12.0  # [m/s], of the wind
_TOLERANCES = (0.1, 10.0)  # [%]
# What the first shapes of the bundled body change, in words; it has more, which change little.
_BUNDLED_SHAPES = ("stature", "hips (+), shoulders (-)", "waist, slim (+)", "weight")


@dataclasses.dataclass(frozen=True)
class Choice:
    """What is on stage."""

    garments: tuple[str, ...]  # the innermost first
    vertices: str
    motion: str
    body: str = "anny"
    betas: tuple[float, ...] = ()


def add_controls(gui: Any, choice: Choice, num_shapes: int) -> dict[str, Any]:
    """Add the controls of a page, which say `choice` at first; return them by name.

    `betas` and `garments` are lists; `gui` is viser's, `num_shapes` the body's.
    """
    controls: dict[str, Any] = {"status": gui.add_markdown("loading")}
    controls["playing"] = gui.add_checkbox("play", True, hint="pause and go on")
    controls["single"] = gui.add_button("one frame", visible=False, hint="simulate one frame while paused")
    controls["restart"] = gui.add_button("restart", hint="put the garments on again at the first frame")
    controls["record"] = gui.add_checkbox("record", False, hint="untick to write a run and get its GLB")
    controls["let_go"] = gui.add_button("let go of the cloth", visible=False)
    with gui.add_folder("fabric"):
        controls["fabric"] = gui.add_dropdown("fabric", fabric_names(), initial_value="cotton")
        for name, label in (("density", "weight x"), ("stretch", "stretch x"), ("bending", "bending x")):
            hint = "times the fabric's own"
            controls[name] = gui.add_slider(label, *_FACTORS, 0.1, 1.0, hint=hint)
        controls["constants"] = gui.add_markdown("")
    with gui.add_folder("wind"):
        controls["wind"] = gui.add_slider("speed, m/s", 0.0, _STRONGEST, 0.1, 0.0)
        hint = "0 blows towards the front, 90 to the body's left"
        controls["direction"] = gui.add_slider("towards, deg", -180.0, 180.0, 5.0, 0.0, hint=hint)
    with gui.add_folder("garments"):
        names = sorted({name.rpartition("_")[0] for name in asset_names("garment")})
        controls["garments"] = [_garment(gui, k, names, choice) for k in range(max(len(choice.garments), 2))]
        controls["vertices"] = gui.add_dropdown(
            "vertices", ("1k", "4k", "10k"), initial_value=choice.vertices, hint="of each bundled garment"
        )
    with gui.add_folder("body", expand_by_default=bool(choice.betas)):
        clips = _with(sorted(asset_names("motion")), choice.motion)
        controls["motion"] = gui.add_dropdown("motion", clips, initial_value=choice.motion)
        count = min(num_shapes, max(len(_BUNDLED_SHAPES), len(choice.betas)))
        controls["betas"] = [_shape(gui, k, choice) for k in range(count)]
    with gui.add_folder("speed"):
        hint = "a frame ends where its gap is below this share of the gap that it began with"
        controls["tolerance"] = gui.add_slider("tolerance, %", *_TOLERANCES, 0.1, 1.0, hint=hint)
        hint = "a frame gets as many iterations as there is time for; else each ends within the tolerance"
        controls["keep_up"] = gui.add_checkbox("keep up with real time", True, hint=hint)
    return controls


def read_choice(controls: dict[str, Any], body: str) -> Choice:
    """Return what the controls put on stage."""
    garments = tuple(control.value for control in controls["garments"] if control.value != _NOTHING)
    betas = tuple(round(float(control.value), 2) for control in controls["betas"])
    betas = betas if any(betas) else ()
    return Choice(garments, controls["vertices"].value, controls["motion"].value, body, betas)


def read_fabric(controls: dict[str, Any]) -> Material:
    """Return the fabric that the controls ask for."""
    fabric = fabric_material(controls["fabric"].value)
    density, stretch, bending = (float(controls[name].value) for name in ("density", "stretch", "bending"))
    return fabric.replace(
        density=np.float32(fabric.density * density),
        lame_mu=np.float32(fabric.lame_mu * stretch),
        lame_lambda=np.float32(fabric.lame_lambda * stretch),
        bending_stiffness=np.float32(fabric.bending_stiffness * bending),
        thickness=np.float32(fabric.thickness),
    )


def describe_fabric(fabric: Material) -> str:
    """Return a fabric's constants as text."""
    return (
        f"{1e3 * float(fabric.density):.0f} g/m², shear {1e-3 * float(fabric.lame_mu):.3g} kPa, "
        f"bending {1e6 * float(fabric.bending_stiffness):.3g} µJ"
    )


def read_wind(controls: dict[str, Any]) -> tuple[float, float, float]:
    """Return the wind that the controls ask for [m/s]; at zero degrees it blows along z."""
    angle, speed = np.deg2rad(controls["direction"].value), controls["wind"].value
    return float(speed * np.sin(angle)), 0.0, float(speed * np.cos(angle))


def _garment(gui: Any, number: int, names: Sequence[str], choice: Choice) -> Any:
    """Add the choice of one garment of an outfit."""
    given = choice.garments[number : number + 1]
    options = _with(names, *given) if number == 0 else (_NOTHING, *_with(names, *given))
    return gui.add_dropdown("over it" if number else "garment", options, initial_value=(*given, _NOTHING)[0])


def _shape(gui: Any, number: int, choice: Choice) -> Any:
    """Add the slider of one shape of the body."""
    is_named = choice.body == "anny" and number < len(_BUNDLED_SHAPES)
    label = _BUNDLED_SHAPES[number] if is_named else f"shape {number + 1}"
    value = float((*choice.betas[number : number + 1], 0.0)[0])
    most = max(_MOST_BETAS, abs(value))
    hint = "standard deviations; the garments are cut anew"
    return gui.add_slider(label, -most, most, 0.25, value, hint=hint)


def _with(names: Sequence[str], *more: str) -> tuple[str, ...]:
    """Return names with others in front, such as a file's, that are not among them."""
    return (*(name for name in more if name not in names), *names)
