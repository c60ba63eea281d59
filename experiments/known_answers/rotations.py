"""Large rotations: strips that bend far under their weight or a load at their end, and a plane that turns.

A strip is a beam, because the plate has no Poisson's ratio, and hardly stretches. Its equilibrium on a mesh is
found in float64 by Newton's method, as the minimum of our energies: in float32, rounding moves a strip of 80
edges by as much as the bars. Sources: Bickley 1934, doi 10.1080/14786443409462419 (a strip under its weight);
Bisshopp and Drucker 1945, doi 10.1090/qam/13360 (a load at the end); Love 1927, A Treatise on the Mathematical
Theory of Elasticity, section 263 (a column).
"""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from hard_cases import Simulator
from hard_cases.build import make_cloth, make_scene, plane, sheet
from scipy.integrate import cumulative_trapezoid, solve_bvp
from scipy.special import ellipe, ellipk

from eslr_jax.fabric.materials import COTTON, stretch_stiffness
from eslr_jax.terms.bending import bending_energy
from eslr_jax.terms.stretch import stretch_energy
from eslr_jax.types import Garment
from known_answers.cases import GRAVITY, OURS, Answer, with_rigidity
from known_answers.sheets import grid, irregular, triangulate

LENGTH = 0.4  # of the strip that is free, about [m]
EDGES_ACROSS = 3  # free edges of irregular meshes are too stiff; six take eight times as long
WEIGHTS = (1.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # rho g L^3 / D
LOADS = (1.0, 2.0, 4.0, 10.0)  # P L^2 / D
TILTS = (60.0, 120.0)  # of a column's end [degrees]
_STRAIN = 1e-4  # of the strip where its load hangs on it straight; the elastica has none
_AT_REST = 1e-6  # of the load: the largest force on a vertex
_MOST_STEPS = 60

Curve = Callable[[np.ndarray], np.ndarray]  # places along and up by arc, in lengths


def elastica(weight: float, load: float, along: float = 0.0) -> Curve:
    """Return the shape of a clamped beam: places along and up by the arc from its clamp, in lengths.

    With t the angle above the level and s the arc: t'' = (G (1 - s) + a) cos t + b sin t. G is the weight per
    length times L^3 over the rigidity, a a load downwards at the end times L^2 over the rigidity, and b such a
    load along x; a column has a negative one.
    """
    arc = np.linspace(0, 1, 201)
    state = np.stack([0.5 * np.pi * arc, np.full(201, 0.5 * np.pi)]) if along else np.zeros((2, 201))
    # From the level on, so that it converges.
    for share in np.linspace(0, 1, 2 + int((weight + load) / 5))[1:]:

        def slopes(s, t, share=share):
            down = share * (weight * (1 - s) + load)
            return np.stack([t[1], down * np.cos(t[0]) + along * np.sin(t[0])])

        found = solve_bvp(slopes, lambda a, b: np.array([a[0], b[1]]), arc, state, tol=1e-8, max_nodes=20_000)
        arc, state = found.x, found.y
    arc = np.linspace(0, 1, 20_001)
    angle = found.sol(arc)[0]
    places = cumulative_trapezoid(np.stack([np.cos(angle), np.sin(angle)]), arc, initial=0)
    return lambda s: np.stack([np.interp(s, arc, place) for place in places])


def column(tilt: float) -> tuple[float, float, float]:
    """Return the load P L^2 / D that tilts the end of a column [rad], and how far along and aside it then is.

    With k = sin(tilt / 2) and K, E the complete elliptic integrals: K^2, 2 E / K - 1 and 2 k / K, in lengths. It
    begins to buckle at pi^2 / 4.
    """
    k = np.sin(tilt / 2)
    bent = ellipk(k * k)
    return float(bent**2), float(2 * ellipe(k * k) / bent - 1), float(2 * k / bent)


def strip(mesh: str, spacing: float) -> tuple[Garment, float, np.ndarray]:
    """Return a strip along x that is clamped at x = 0, its length [m], and each vertex's share of its end.

    A mesh bends over half an edge behind its last held vertices. So a clamp in the middle of edges holds the
    beam where it begins.
    """
    length, width = (round(LENGTH / spacing) - 0.5) * spacing, EDGES_ACROSS * spacing
    if mesh == "grid":
        positions, faces = grid(length + spacing / 2, width, spacing)
        positions = positions - [spacing / 2, 0, 0]
    else:
        free = irregular(length - spacing / 2, width, spacing)[0] + [spacing / 2, 0, 0]
        wall = free[free[:, 0] < spacing / 2 + 1e-9] * [-1, 1, 1]
        positions, faces = triangulate(np.concatenate([wall, free])[:, [0, 2]], 1e-3 * spacing**2)
    x, z = positions[:, 0], positions[:, 2]
    end = np.flatnonzero(x > length - 1e-6)
    end = end[np.argsort(z[end])]
    share = np.zeros(len(z))
    share[end] = np.convolve(np.diff(z[end]), [0.5, 0.5]) / width  # half of the edge on either side
    return make_cloth((positions, faces), {}, is_pinned=x < spacing / 2 + 1e-6), length, share


def bend(mesh: str, spacing: float, curve: Curve, *, weight: float = 0.0, load=(0.0, 0.0)) -> np.ndarray:
    """Return where the end of a `strip` is at rest, along and up, in lengths; the search starts from a curve.

    The weight is rho g L^3 / D, the load P L^2 / D along x and up.
    """
    garment, length, share = strip(mesh, spacing)
    width = EDGES_ACROSS * spacing
    total = _STRAIN * float(stretch_stiffness(COTTON)) * width  # [N]
    rigidity = total / width * length**2 / max(weight, np.hypot(*load))
    material = with_rigidity(garment, (rigidity, rigidity))
    areas = np.asarray(garment.vertex_areas, np.float64)
    force = np.outer(share, [*load, 0.0]) * rigidity * width / length**2
    force[:, 1] -= areas * weight * rigidity / length**3
    rest = np.asarray(garment.rest_positions, np.float64)
    held = np.asarray(garment.is_pinned)
    bent = np.column_stack([length * curve(rest[:, 0] / length).T, rest[:, 2]])
    start = np.where(held[:, None], rest, bent)
    with jax.enable_x64(True):
        end = _minimum(start, np.flatnonzero(np.repeat(~held, 3)), total, (force, garment, material))
    return (share @ end)[:2] / length


def _energy(moved, free, start, load) -> jax.Array:
    """Return the energy [J] of a strip whose free coordinates have moved [m]."""
    force, garment, material = load
    x = start.ravel().at[free].add(moved).reshape(-1, 3)
    elastic = bending_energy(x, garment, material) + stretch_energy(x, garment, material)
    return elastic - jnp.sum(force * (x - start))


_value, _slope = jax.jit(_energy), jax.jit(jax.grad(_energy))


@jax.jit
def _curvature(moved, *rest) -> jax.Array:
    def column_of(axis):
        return jax.jvp(lambda at: _slope(at, *rest), (moved,), (axis,))[1]

    return jax.lax.map(column_of, jnp.eye(len(moved)), batch_size=64)


def _minimum(start: np.ndarray, free: np.ndarray, total: float, load: tuple) -> np.ndarray:
    """Return the positions [m] of least energy, by Newton's method; the load is that of `_energy`, in all [N]."""
    rest = jax.tree.map(jnp.asarray, (free, start, jax.tree.map(_doubled, load)))
    moved, shift = jnp.zeros(len(free)), 0.0
    for _ in range(_MOST_STEPS):
        gradient = np.asarray(_slope(moved, *rest))
        matrix = np.asarray(_curvature(moved, *rest))
        stiffness = np.abs(np.diag(matrix)).mean()
        try:
            factor = scipy.linalg.cho_factor(matrix + shift * stiffness * np.eye(len(free)))
        except np.linalg.LinAlgError:  # no minimum near here: a shorter step
            shift = max(10 * shift, 1e-9)
            continue
        if shift == 0 and np.abs(gradient).max() < _AT_REST * total:
            return start + np.bincount(free, np.asarray(moved), start.size).reshape(-1, 3)
        step = -scipy.linalg.cho_solve(factor, gradient)
        reach, now = 1.0, float(_value(moved, *rest))
        while float(_value(moved + reach * step, *rest)) > now + 1e-4 * reach * (gradient @ step):
            reach /= 2
        moved, shift = moved + reach * step, shift / 10 if shift > 1e-9 else 0.0
    raise RuntimeError("Newton's method has not come to rest")


def _doubled(leaf):
    """Return numbers in float64, others as they are."""
    leaf = np.asarray(leaf)
    return leaf.astype(np.float64) if np.issubdtype(leaf.dtype, np.floating) else leaf


def turned(is_smoke: bool) -> Iterator[Answer]:
    """Yield what is found of strips and, by our simulator, of the plane."""
    yield from strips(is_smoke)
    if not is_smoke:
        for simulator in OURS:
            yield from stick_slip(simulator)


def strips(is_smoke: bool) -> Iterator[Answer]:
    """Yield where strips end that bend far: under their weight, a load at their end, and as buckled columns."""
    end = np.ones(1)
    for spacing in (0.02,) if is_smoke else (0.02, 0.01, 0.005, 0.003):
        for mesh in ("grid", "irregular"):
            setting, bar = f"{mesh}, {1e3 * spacing:g} mm", 0.04
            if mesh == "grid":
                bar = 0.01 if spacing == 0.005 else 0.02
            for weight in WEIGHTS[1:2] if is_smoke else WEIGHTS:
                curve = elastica(weight, 0.0)
                (x, y), (reach, drop) = bend(mesh, spacing, curve, weight=weight), curve(end)[:, 0]
                yield Answer(f"heavy elastica, {weight:g}", setting, "drop/reach", -y / x, -drop / reach, bar)
            for load in LOADS[:1] if is_smoke else LOADS:
                curve = elastica(0.0, load)
                (x, y), (reach, drop) = bend(mesh, spacing, curve, load=(0.0, -load)), curve(end)[:, 0]
                yield Answer(f"end load, {load:g}", setting, "drop/L", -y, -drop, bar)
                yield Answer(f"end load, {load:g}", setting, "shortening/L", 1 - x, 1 - reach, bar)
            for tilt in TILTS[:1] if is_smoke else TILTS:
                load, along, aside = column(np.radians(tilt))
                x, y = bend(mesh, spacing, elastica(0.0, 0.0, -load), load=(-load, 0.0))
                yield Answer(f"column, {tilt:g} degrees", setting, "aside/L", abs(y), aside, bar)
                yield Answer(f"column, {tilt:g} degrees", setting, "shortening/L", 1 - x, 1 - along, bar)


def stick_slip(simulator: Simulator) -> list[Answer]:
    """A sheet on a plane that turns up and down twice: it sticks, slides, sticks and slides again.

    Known by Coulomb's law for a point on the plane, in steps of 0.1 ms. With r the distance from the axis and t
    the tilt: r'' = r t'^2 - g sin t +- mu (g cos t + 2 r' t' + r t'').
    """
    friction, period, timestep = 0.3, 2.0, 1 / 60
    low, rise = np.radians([5.0, 17.0])

    def tilt(time):
        return low + rise * (1 - np.cos(2 * np.pi * time / period)) / 2

    frames = round(2 * period / timestep) + 1
    angles = tilt(np.arange(frames) * timestep)
    mesh = sheet(7, 7, (0.2, 0.2))
    planes = np.stack([plane(4.0, 21, angle)[0] for angle in angles])
    start = mesh[0] @ _turned(angles[0]) + 2.2e-3 * _turned(angles[0])[1]
    scene = make_scene(
        make_cloth(mesh, {}), start, frames, timestep=timestep, friction=friction,
        body=(planes[0], plane(4.0, 21, 0.0)[1]), body_positions=planes,
    )  # fmt: skip
    middle = np.asarray(simulator.simulate(simulator.prepare(scene)).positions).mean(axis=1)
    path = np.array([-place @ _turned(angle)[0] for place, angle in zip(middle, angles, strict=True)])
    times = np.arange(0, 2 * period, 1e-4)
    angle = tilt(times)
    speed, change = np.gradient(angle, 1e-4), np.gradient(np.gradient(angle, 1e-4), 1e-4)
    place = velocity = 0.0
    known = []
    for t, turning, turned in zip(angle, speed, change, strict=True):
        velocity += 1e-4 * (place * turning**2 - GRAVITY * np.sin(t))
        normal = GRAVITY * np.cos(t) + 2 * velocity * turning + place * turned
        velocity = np.sign(velocity) * max(abs(velocity) - 1e-4 * friction * normal, 0.0)
        place += 1e-4 * velocity
        known.append(-place)
    known = np.array(known)
    rows = []
    for way, at in ((path, np.arange(frames) * timestep), (known, times)):
        way = way - way[0]
        once = len(way) // 2
        again = way[once:] - way[once]
        begun = np.argmax(again > 5e-3) + 1
        angle = np.degrees(tilt(np.interp(1e-3, again[:begun], at[once:][:begun])))
        rows.append((angle, 1e3 * way[once], 1e3 * again[-1]))
    names = (("angle where it has slid 1 mm again", "degrees"), ("first slide", "mm"), ("second slide", "mm"))
    return [
        Answer(f"turning plane: {name}", simulator.name, unit, found, right, 0.03)
        for (name, unit), found, right in zip(names, *rows, strict=True)
    ]


def _turned(angle: float) -> np.ndarray:
    """Return x, y and z of a plane that rises towards +x by an angle [rad], as rows."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
