"""Air: drag and lift of every face, as a dissipation potential.

A face of area A moves against the air with velocity u: u_n along its normal n, u_t in its plane. It feels the
force -rho A / 2 (C_n |u_n| u_n n + C_t |u_t| u_t). C_n is the larger, so a tilted face is also pushed across the
wind: lift. With u from the positions at t + 1 and the normal at t, the force is the negative gradient of

    h rho A / 2 (C_n |u_n|^3 + C_t |u_t|^3) / 3,

which is convex: however light the cloth and strong the wind, the step stays stable.

Source: Hoerner 1965, Fluid-Dynamic Drag, chapter 3 (plates across and along a flow).
"""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.tree_util import Partial
from jaxtyping import Array, Float

from eslr_jax.errors import ConfigError
from eslr_jax.numerics import Vector3, as_partial, cross3, dot3, gather_corners, safe_normalize, sub3
from eslr_jax.ranges import Range, check_range
from eslr_jax.terms.term import Elements, FrameProblem, Term
from eslr_jax.terms.worn import Worn
from eslr_jax.types import Garment

_NUM_WAVES = 8  # of a gust, in each direction
_LONGEST, _SHORTEST = 4.0, 0.5  # [s], periods of a gust's waves


class AirFlow(NamedTuple):
    """The air around every face during a frame."""

    areas: Float[Array, " faces"]  # at t [m^2], zero where padded
    normals: Float[Array, "faces 3"]  # at t, unit length; zero where padded
    wind: Float[Array, "faces 3"]  # at t + 1 [m/s]


@struct.dataclass
class Air(Term):
    """Air that cloth moves through."""

    name = "air"
    ranges = MappingProxyType(
        {
            "density": Range(0.0, 1e3, "kg/m^3"),  # up to water
            "normal_drag": Range(0.0, 10.0),
            "tangential_drag": Range(0.0, 10.0),
        }
    )

    # Velocity [m/s], shape [3]; or a function of points [m], shape [points, 3], and the time since the first
    # frame [s] to velocities, shape [points, 3] or [3], such as `gusts`.
    wind: Float[Array, " 3"] | tuple[float, float, float] | Partial
    density: Float[Array, ""] | float = 1.2  # [kg/m^3], at 20 degrees and sea level
    normal_drag: Float[Array, ""] | float = 1.17  # of a square plate across the flow (Hoerner 1965, 3-15)
    # Of a rough plate along the flow, both sides (Hoerner 1965, 2-6).
    tangential_drag: Float[Array, ""] | float = 0.02

    def check(self) -> None:
        """Check its constants and its wind (host)."""
        super().check()
        if callable(self.wind):
            return
        if check_range("wind", self.wind, Range(-100.0, 100.0, "m/s")).shape != (3,):
            raise ConfigError(
                f"wind = {self.wind!r} is no velocity; give three numbers in m/s, such as 3, 0, 0"
            )

    def plan(self, worn: Worn, others: Sequence[Term]) -> Air:
        """Return air whose wind is an array, or a function that a compiled program can take."""
        if callable(self.wind):
            return self.replace(wind=as_partial(self.wind))
        return self.replace(wind=np.asarray(self.wind, np.float32))

    def prepare(self, problem: FrameProblem) -> AirFlow:
        """Return the air around the faces of the cloth."""
        position, garment = problem.position, problem.garment
        a, b, c = gather_corners(position, garment.faces, garment.face_incidence)
        doubled = jnp.stack(cross3(sub3(b, a), sub3(c, a)), axis=-1)
        normals = safe_normalize(doubled)
        if callable(self.wind):
            wind = self.wind(jnp.stack(_mean((a, b, c)), axis=-1), problem.time)
        else:
            wind = jnp.asarray(self.wind, position.dtype)
        return AirFlow(
            areas=0.5 * jnp.sum(doubled * normals, axis=-1),
            normals=normals,
            wind=jnp.broadcast_to(wind, normals.shape).astype(position.dtype),
        )

    def elements(self, x: Vector3, problem: FrameProblem, data: AirFlow) -> tuple[Elements, ...]:
        """Return the dissipation potential of every face [J]."""
        garment, timestep = problem.garment, problem.inertial_timestep
        now, before = (
            _mean(gather_corners(places, garment.faces, garment.face_incidence))
            for places in (x, problem.origin)
        )
        normals, wind = tuple(data.normals.T), tuple(data.wind.T)
        x, y, z = (part / timestep - air for part, air in zip(sub3(now, before), wind, strict=True))
        through = x, y, z
        across = dot3(through, normals)
        along = dot3(through, through) - across * across
        is_still = along <= 0  # the root has no gradient there
        along = jnp.where(is_still, 0.0, along)
        cubed = along * jnp.sqrt(jnp.where(is_still, 1.0, along))
        scale = timestep * self.density * data.areas / 6.0
        drag = self.normal_drag * jnp.abs(across) * across * across + self.tangential_drag * cubed
        return (Elements(scale * drag, garment.faces),)

    def describe(self, garment: Garment) -> str:
        """Return its speed."""
        if callable(self.wind):
            return "a wind that changes"
        return f"{np.linalg.norm(np.asarray(self.wind)):.1f} m/s"


def blowing(wind: Sequence[float] | None, gust: float = 0.0) -> Air | None:
    """Return air with a wind of a mean velocity [m/s], steady or in `gusts` of a strength; None without a wind.

    Raises:
        ConfigError: There are gusts without a wind, or their strength is negative.
    """
    if not gust:
        return None if wind is None else Air(tuple(wind))  # type: ignore[arg-type]: of any length, until checked
    if wind is None or not gust > 0:
        raise ConfigError(
            f"gusts of {gust:g} need a wind, and a strength above 0; give both, such as 3 0 0 and 0.3"
        )
    return Air(gusts(wind, gust))


def gusts(mean: Sequence[float], strength: float, seed: int = 0) -> Partial:
    """Return a wind that blows in gusts, for `Air.wind`; the same seed gives the same gusts.

    Eight sines of random phase with periods from half a second to four seconds, along every axis. The whole air
    moves alike.

    Args:
        mean: Mean velocity [m/s].
        strength: Root mean square of the gusts in each direction, as a share of the mean speed.
        seed: Of the phases.
    """
    random = np.random.default_rng(seed)
    rates = 2.0 * np.pi / np.geomspace(_LONGEST, _SHORTEST, _NUM_WAVES)
    phases = random.uniform(0.0, 2.0 * np.pi, (_NUM_WAVES, 3))
    height = strength * float(np.linalg.norm(mean)) * np.sqrt(2.0 / _NUM_WAVES)
    return Partial(_gusty, *(jnp.asarray(part, jnp.float32) for part in (mean, height, rates, phases)))


def _gusty(mean: Array, height: Array, rates: Array, phases: Array, points: Array, time: Array) -> Array:
    return mean + height * jnp.sum(jnp.sin(rates[:, None] * time + phases), axis=0)


def _mean(corners: tuple[Vector3, ...]) -> Vector3:
    a, b, c = corners
    third = 1.0 / 3.0
    return (third * (a[0] + b[0] + c[0]), third * (a[1] + b[1] + c[1]), third * (a[2] + b[2] + c[2]))
