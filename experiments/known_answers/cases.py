"""The known answers: each case returns what was found beside what is known."""

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import newton_cloth
import numpy as np
from blender_cloth import BEST, blender_simulator
from flax import struct
from hard_cases import Simulator
from hard_cases.build import icosphere, make_cloth, make_scene, plane, sheet
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from eslr_jax import Material, SimConfig, Trajectory, rollout_scene
from eslr_jax.errors import MissingExtraError
from eslr_jax.fabric.materials import COTTON, Weave, stretch_stiffness
from eslr_jax.mesh.plate import warp_directions
from eslr_jax.numerics import components, dot3, sub3
from eslr_jax.pipeline.fabrics import Described, on_threads
from eslr_jax.terms import Air, Term
from eslr_jax.terms.bending import bending_energy, dihedral_angles, plate_curvatures
from eslr_jax.terms.stretch import stretch_energy
from eslr_jax.types import Garment, Scene
from known_answers.sheets import cantilever_rigidity, grid, irregular, tube
from known_answers.strip import LENGTH, kept_in, strip

GRAVITY = 9.81  # [m/s^2]
RIGIDITY = 2e-5  # [N m]


class Answer(NamedTuple):
    """A figure that was found, and what is known of it."""

    case: str
    setting: str
    unit: str
    found: float
    known: float
    bar: float | None = None  # largest relative error; None: told, not judged

    @property
    def is_within(self) -> bool | None:
        """Whether the error is within the bar; None without one."""
        return None if self.bar is None else bool(abs(self.found - self.known) <= self.bar * abs(self.known))

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        numbers = {"found": float(self.found), "known": float(self.known), "is_within": self.is_within}
        return {**self._asdict(), **numbers}


def with_rigidity(garment: Garment, rigidity: tuple[float, float]) -> Material:
    """Return cotton with a flexural rigidity along z and along x [N m], of a level sheet."""
    warp = warp_directions(garment, direction=(0.0, 0.0, 1.0))
    every = np.ones(len(warp), bool)
    return on_threads(COTTON, garment, warp, [(every, Described(COTTON, Weave(rigidity=rigidity)))])


def free_fall(simulator: Simulator) -> list[Answer]:
    """A strip that falls for a second in a vacuum: g t^2 / 2."""
    scene = strip("euler", frames=31, is_pinned=False)
    end = _simulate(simulator, scene).positions[-1]
    fallen = float(jnp.mean(scene.initial_state.position[:, 1] - end[:, 1]))
    return [Answer("free fall, 1 s", simulator.name, "m", fallen, GRAVITY / 2, 0.04)]


def terminal_velocity(simulator: Simulator) -> list[Answer]:
    """A level strip that falls in air until its weight is its drag."""
    air = Air(jnp.zeros(3))
    known = float(np.sqrt(2 * float(COTTON.density) * GRAVITY / (air.density * air.normal_drag)))
    scene = strip("euler", air, frames=40, is_pinned=False, tilt=np.pi / 2)
    fall = -float(_simulate(simulator, scene).velocities[-1, :, 1].mean())
    return [Answer("terminal velocity", simulator.name, "m/s", fall, known, 0.005)]


def swing(simulator: Simulator) -> list[Answer]:
    """A strip that swings in a vacuum keeps its energy."""
    scene = strip("euler", frames=100, is_pinned=True)
    kept = kept_in(np.asarray(_simulate(simulator, scene).positions))
    return [Answer("energy kept per period", f"{simulator.name}, 1/30 s", "", kept, 1.0)]


def hanging_strip(simulator: Simulator) -> list[Answer]:
    """A strip that hangs: the tension T at a point is the weight below it.

    With Y the tension per width and Green strain of plane stress and s the stretch, Y (s^2 - 1) / 2 s = T.
    """
    scene = strip("euler", frames=61, is_pinned=True, timestep=0.1, tilt=0.0)
    lowest = np.asarray(_simulate(simulator, scene).positions)[:, :, 1].min(axis=1)
    below = float(COTTON.density) * GRAVITY * (np.arange(200) + 0.5) / 200 * LENGTH
    stiffness = float(stretch_stiffness(COTTON))
    stretches = [brentq(lambda s, t=t: stiffness * (s * s - 1) / 2 * s - t, 1.0, 2.0) for t in below]
    # A mean over the second half: some simulators keep it bobbing.
    longer, known = -lowest[30:].mean() - LENGTH, LENGTH * (np.mean(stretches) - 1)
    return [Answer("elongation of a hanging strip", simulator.name, "mm", 1e3 * longer, 1e3 * known, 0.05)]


def buckling(simulator: Simulator) -> list[Answer]:
    """A sheet whose ends are brought together by a twentieth: Euler's elastica between two hinges.

    With K and E the complete elliptic integrals of modulus k: ends 2 E / K - 1 lengths apart, load 4 K^2 D / L^2
    per width (pi^2 D / L^2 where it begins to buckle), rise k L / K. The plate has no Poisson's ratio, so a sheet
    bends as a beam does.

    Source: Love 1927, A Treatise on the Mathematical Theory of Elasticity, section 263.
    """
    length, width, shortening = 0.2, 0.05, 0.05
    k = brentq(lambda k: 2 - 2 * ellipe(k * k) / ellipk(k * k) - shortening, 1e-3, 0.9)
    positions, faces = grid(length, width, 0.01)
    is_end = np.isin(positions[:, 0], [0.0, length])
    garment = make_cloth((positions, faces), {}, is_pinned=is_end)
    material = with_rigidity(garment, (RIGIDITY, RIGIDITY))
    start = positions * [1 - shortening, 1, 1]
    start[:, 1] += 0.02 * np.sin(np.pi * positions[:, 0] / length)
    scene = make_scene(garment, start, 121, timestep=0.1, material=material, gravity=1e-3)
    end = _simulate(simulator, scene.replace(terms=(*scene.terms, Brake(2.0)))).positions[-1]

    def elastic(position):
        return bending_energy(position, garment, material) + stretch_energy(position, garment, material)

    force = np.asarray(jax.grad(elastic)(end))[:, 0]
    pull = (force[positions[:, 0] == length].sum() - force[positions[:, 0] == 0].sum()) / 2
    rise = float(end[:, 1].max() - end[is_end, 1].mean())
    bent = ellipk(k * k)
    load, known = -1e3 * pull / width, 4e3 * bent**2 * RIGIDITY / length**2
    return [
        Answer("load of a buckled sheet", simulator.name, "mN/m", load, known, 0.05),
        Answer("rise of a buckled sheet", simulator.name, "mm", 1e3 * rise, 1e3 * k * length / bent, 0.05),
    ]


def rigidity(is_smoke: bool) -> list[Answer]:
    """A cantilever of small deflection, and a sheet rolled to a tube, of a rigidity and by HOOD's number."""
    answers = []
    for spacing in (0.02,) if is_smoke else (0.02, 0.01, 0.005, 0.003):
        for name, mesh in (("grid", grid), ("irregular", irregular)):
            positions, faces = mesh(0.25, 0.1, spacing)
            garment = make_cloth((positions, faces), {})
            setting = f"{name}, {1e3 * spacing:g} mm"
            material = with_rigidity(garment, (RIGIDITY, RIGIDITY))
            found = cantilever_rigidity(garment, material.plate)
            answers.append(Answer("rigidity of a cantilever", setting, "N m", found, RIGIDITY, 0.05))
            angles = dihedral_angles(jnp.asarray(tube(positions, 0.12, 0.4), jnp.float32), garment)
            energies = 0.5 * np.sum(np.asarray(plate_curvatures(angles, material.plate)) ** 2, axis=0)
            # Free edges may unbend: faces in the middle tell the rigidity.
            middle = positions[faces].mean(axis=1)
            is_inner = np.all(np.abs(middle[:, [0, 2]] / [0.25, 0.1] - 0.5) < 0.5 - spacing / 0.07, axis=1)
            if is_inner.any():
                area = np.asarray(garment.rest_areas)[is_inner].sum()
                found = float(energies[is_inner].sum() * 2 * 0.12**2 / area)
                answers.append(Answer("rigidity of a cylinder", setting, "N m", found, RIGIDITY, 0.05))
    return answers


def twisted_sheet(is_smoke: bool) -> list[Answer]:
    """A strip twisted to a helicoid w = t x z of small twist t: the plate's energy is D t^2 per area."""
    answers, twist = [], 0.5  # [rad/m]
    for name, mesh in (("grid", grid), ("irregular", irregular)):
        positions, faces = mesh(0.3, 0.1, 0.01)
        garment = make_cloth((positions, faces), {})
        x, z = positions[:, 0] - 0.15, positions[:, 2] - 0.05
        twisted = positions + np.outer(twist * x * z, [0.0, 1.0, 0.0])
        material = with_rigidity(garment, (RIGIDITY, RIGIDITY))
        found = float(bending_energy(jnp.asarray(twisted, jnp.float32), garment, material))
        # At free edges the mixed curvature stays: nothing there can turn it away.
        known = RIGIDITY * twist**2 * float(np.sum(garment.rest_areas))
        case = "bending energy of a twisted sheet"
        answers.append(Answer(case, name, "uJ", 1e6 * found, 1e6 * known, 0.05))
    return answers


def slope(simulator: Simulator, angles: tuple[float, ...] = (25.0, 35.0, 45.0, 60.0)) -> list[Answer]:
    """A sheet that slides down a slope: g (sin a - mu cos a) t^2 / 2 over 0.4 s from when it lies."""
    answers, friction = [], 0.3
    for degrees in angles:
        tilt = np.radians(degrees)
        mesh = sheet(7, 7, (0.2, 0.2))
        garment = make_cloth(mesh, {})
        along = np.array([np.cos(tilt), np.sin(tilt), 0.0])
        normal = np.array([-np.sin(tilt), np.cos(tilt), 0.0])
        start = np.outer(mesh[0][:, 0], along) + mesh[0] * [0, 0, 1] + 2.2e-3 * normal
        body, start = plane(8.0, 41, tilt), start + 0.8 * along
        scene = make_scene(garment, start, 49, timestep=1 / 60, body=body, friction=friction)
        path = np.asarray(_simulate(simulator, scene).positions).mean(axis=1) @ -along
        # From the second differences, which do not know when it began to slide.
        found = float(np.polyfit(np.arange(24) / 60, path[25:], 2)[0] * 2)
        known = GRAVITY * (np.sin(tilt) - friction * np.cos(tilt))
        setting = f"{simulator.name}, {degrees:g} degrees"
        answers.append(Answer("acceleration down a slope", setting, "m/s2", found, known, 0.03))
    return answers


def sphere(simulator: Simulator) -> list[Answer]:
    """A sheet at rest on a ball: what the ball presses with bears its weight, but for friction's part."""
    count = 17
    mesh = sheet(count, count, (0.4, 0.4))
    garment, ball = make_cloth(mesh, {}), icosphere(3, 0.1)
    scene = make_scene(garment, mesh[0] + [0, 0.105, 0], 121, body=ball, friction=0.1)
    trajectory = _simulate(simulator, scene.replace(terms=(*scene.terms, Brake(2.0))))
    last, loads = np.asarray(trajectory.positions[-1]), np.asarray(trajectory.friction_loads[-1])
    upward = last[:, 1] / np.linalg.norm(last, axis=1)
    weight = float(COTTON.density) * GRAVITY * 0.16
    found = float(np.sum(loads * upward))
    return [Answer("weight on a ball", f"{simulator.name}, friction 0.1", "N", found, weight, 0.05)]


def _simulate(simulator: Simulator, scene: Scene) -> Trajectory:
    return simulator.simulate(simulator.prepare(scene))


@struct.dataclass
class Brake(Term):
    """Slows every vertex down, so that a sheet comes to rest."""

    name = "brake"
    on = "vertices"

    rate: float  # [1/s]

    def corner_energies(self, corners, problem, data):
        """Return the energy of every vertex [J]."""
        moved = sub3(corners[0], components(problem.position))
        return 0.5 * self.rate / problem.timestep * problem.masses * dot3(moved, moved)


_SOLVE = partial(rollout_scene, None, config=SimConfig(iterations=60))
OURS = tuple(Simulator(name, _SOLVE, integrator=name) for name in ("euler", "bdf2"))
STATIC: tuple[Callable[[bool], list[Answer]], ...] = (rigidity, twisted_sheet)
MOVING: tuple[Callable[[Simulator], list[Answer]], ...] = (
    free_fall, terminal_velocity, swing, hanging_strip, buckling, slope, sphere,
)  # fmt: skip
FOR_PEERS = (free_fall, swing, hanging_strip, slope)  # the others have air, a brake or our energies
_SLOPES = (35.0, 60.0)  # [degrees], of the peers


def answer(is_smoke: bool) -> Iterator[Answer]:
    """Yield what our own simulator and its energies find."""
    for case in STATIC:
        yield from case(is_smoke)
    for case in MOVING:
        for simulator in OURS[:1] if is_smoke else OURS:  # the others run the same code
            yield from case(simulator)


def peers() -> Iterator[Simulator]:
    for setting in newton_cloth.BEST:
        effort = f" {setting.substeps}x{setting.iterations}" if setting.substeps else ""
        try:
            yield dataclasses.replace(newton_cloth.newton_simulator(setting), name=setting.name + effort)
        except MissingExtraError as error:
            print(f"left out: {error}")
            break
    try:
        yield dataclasses.replace(blender_simulator(BEST), name="Blender {}x{}".format(*BEST))
    except MissingExtraError as error:
        print(f"left out: {error}")


def compare(is_smoke: bool) -> Iterator[Answer]:
    for simulator in peers():
        for case in FOR_PEERS[:1] if is_smoke else FOR_PEERS:
            yield from slope(simulator, _SLOPES) if case is slope else case(simulator)
