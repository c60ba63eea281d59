"""The cuts of the nine bundled garments.

Lengths are in metres, Y is up, the body faces +Z and its left is +X. Heights are measured from the hips.
"""

from dataclasses import dataclass

LEVELS = {"1k": 1000, "4k": 4000, "10k": 10000}  # vertices


@dataclass(frozen=True)
class Neck:
    """A round neck: half an ellipse seen from the front, deeper in front than behind."""

    height: float  # height of the ellipse's centre, where the collar crosses the shoulders [m]
    width: float  # half width, or the distance of the inner edge of the straps from the middle [m]
    front: float  # depth below the centre in front [m]
    back: float  # depth below the centre behind [m]


@dataclass(frozen=True)
class Armhole:
    """The outer edge of the straps at `width`, bending outwards below `height` to pass under the arm."""

    width: float = 0.138  # half distance between the two outer strap edges [m]
    height: float = 0.520  # where the edge starts to bend [m]
    bend: float = 1.3  # curvature of the bend [1/m]


@dataclass(frozen=True)
class Sleeve:
    """A tube around the arm from the shoulder to `length`."""

    length: float  # in upper arms; 1 is the elbow and 2 the wrist
    ease: tuple[float, ...]  # cloth minus arm radius [m], evenly spaced from the shoulder to the cuff


@dataclass(frozen=True)
class Trouser:
    """Two leg tubes down to `hem`."""

    hem: float  # height of the hem [m]
    waist: float  # height of the waistband's upper edge [m]
    ease: tuple[float, ...]  # cloth minus leg radius [m], evenly spaced from the crotch to the hem


@dataclass(frozen=True)
class Drape:
    """A tube around torso and legs that hangs from its widest section so far, as cloth does."""

    top: float  # height where the tube starts [m]
    hem: float  # height of the hem [m]
    ease: float  # distance between tube and hull of the body [m]
    flare: float = 0.0  # widening per metre of fall
    fade: float = 0.12  # fall over which the ease grows [m]
    hang: bool = True  # keep the widest section; otherwise follow the body's hull


@dataclass(frozen=True)
class GarmentSpec:
    """Cut of one garment."""

    offset: float  # thickness between body and cloth where the cloth rests on it [m]
    closing: float  # radius of the closing that bridges armpit, chest and crotch [m]
    neck: Neck | None = None
    armhole: Armhole | None = None
    sleeve: Sleeve | None = None
    trouser: Trouser | None = None
    drapes: tuple[Drape, ...] = ()
    skirt_smoothing: float = 0.0  # diffusion length of the skin weights below the hips [m]
    leg_follow: float = 1.0  # share of the legs' skin weights that is kept; the rest goes to the hips
    pin_depth: float = 0.0  # vertices within this distance below the top edge are pinned [m]


CREW = Neck(0.575, 0.099, 0.070, 0.022)
SCOOP = Neck(0.575, 0.088, 0.135, 0.075)
SPECS = {
    "tshirt": GarmentSpec(
        0.010, 0.030, leg_follow=0.7, neck=CREW, sleeve=Sleeve(0.66, (0.012, 0.020, 0.024)),
        drapes=(Drape(0.46, -0.10, 0.022, flare=0.02),),
    ),
    "tank": GarmentSpec(
        0.010, 0.030, leg_follow=0.7, pin_depth=0.025, neck=SCOOP, armhole=Armhole(),
        drapes=(Drape(0.46, -0.10, 0.012, flare=0.02),),
    ),
    "longsleeve": GarmentSpec(
        0.010, 0.025, leg_follow=0.7, neck=CREW, sleeve=Sleeve(1.90, (0.012, 0.018, 0.018, 0.016, 0.014)),
        drapes=(Drape(0.46, -0.12, 0.018),),
    ),
    "shorts": GarmentSpec(0.010, 0.006, trouser=Trouser(-0.27, 0.13, (0.016, 0.022, 0.028)), pin_depth=0.04),
    "pants": GarmentSpec(
        0.010, 0.006, trouser=Trouser(-0.875, 0.13, (0.014, 0.020, 0.024, 0.022, 0.028)), pin_depth=0.04
    ),
    "dress": GarmentSpec(
        0.010, 0.030, neck=SCOOP, armhole=Armhole(), skirt_smoothing=0.12, pin_depth=0.12,
        drapes=(Drape(0.24, -0.52, 0.012, flare=0.20),),
    ),
    "kneepants": GarmentSpec(
        0.010, 0.006, trouser=Trouser(-0.50, 0.13, (0.014, 0.022, 0.026)), pin_depth=0.04
    ),
    "shortsleeve": GarmentSpec(
        0.009, 0.025, leg_follow=0.7, neck=Neck(0.570, 0.108, 0.082, 0.032),
        sleeve=Sleeve(0.50, (0.010, 0.016)),
        drapes=(Drape(0.46, -0.04, 0.012),),
    ),
    "tightdress": GarmentSpec(
        0.009, 0.030, neck=SCOOP, armhole=Armhole(), skirt_smoothing=0.05, pin_depth=0.025,
        drapes=(Drape(0.20, -0.36, 0.008),),
    ),
}  # fmt: skip
