"""A scene of this package in Newton's cloth solvers: VBD, Style3D and XPBD (extra `peers`).

Newton is Apache-2.0, https://github.com/newton-physics/newton; read in version 1.8.0. The body is one static mesh
that is moved and refitted before every substep. Cloth meets it by vertices, at the distance that ours keep. There
is no damping. With self-contact, VBD keeps our distance between layers, Style3D its own, XPBD none.

How fabric is carried over (h thickness, mu and lambda Lame, l edge, A the areas of the faces beside it):

- VBD: stable Neo-Hookean with mu h and lambda h, St. Venant-Kirchhoff for small strain. Bending is ours.
- Style3D: Baraff and Witkin's stretch and shear along two axes per triangle. Stretch has the stiffness of a strip
  pulled along one axis, E h, shear has mu h; nothing couples the two axes, so cloth does not narrow when pulled.
  Bending is the quadratic one for a flat rest shape, ours at small angles. Velocities lose 0.2 % a substep.
- XPBD: a spring per edge, E h A / l^2 (Van Gelder 1998, doi 10.1080/10867651.1998.10487490), which is a sheet of
  Poisson's ratio 1/3. Its bending leaves the normal's length out of the gradient; the stiffness makes up for it
  where the constraint is soft.

What can't be carried over: the cubic contact energy becomes a spring, as stiff as ours is on average over the
contact distance (XPBD: rigid), and XPBD takes no friction speed. With several substeps even an exact answer is
not the minimum of our potential, which has one step a frame.
"""

import contextlib
import dataclasses
import io
import math
from types import ModuleType
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from hard_cases import Simulator
from jaxtyping import Float, Int

from eslr_jax.errors import EslrError
from eslr_jax.mesh.topology import undirected_edges
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.report.score import foreign_trajectory
from eslr_jax.terms import Collision, Friction, Gravity
from eslr_jax.terms.contact import keeps_layers
from eslr_jax.terms.term import contact_thickness, vertex_masses
from eslr_jax.types import ClothState, Garment, Material, Scene, Trajectory

LABELS = {"vbd": "VBD", "style3d": "Style3D", "xpbd": "XPBD"}
LAYER_THICKNESS = 3e-3  # [m] that layers keep from each other (ContourCraft)
_REACH = 0.1  # [m] by which cloth and body may approach within a frame and still find each other
_LEAST_GAP = 0.01  # [m]; Newton's default
_FAR = 1e3  # [m], bounds of a mesh that moves: Newton culls by those of its first frame
_JACOBI = 3.0  # XPBD adds up the corrections of about six springs a vertex, without averaging them


@dataclasses.dataclass(frozen=True)
class Setting:
    """A solver of Newton and its effort."""

    solver: Literal["vbd", "style3d", "xpbd"]
    substeps: int | None  # per frame; None: as many as keep XPBD from diverging
    iterations: int  # per substep

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"Newton {LABELS[self.solver]}"


BEST = (Setting("vbd", 5, 20), Setting("style3d", 2, 20), Setting("xpbd", None, 1))
"""In peers.json those of the least gap on their own rollout."""


@dataclasses.dataclass(frozen=True)
class Cloth:
    """The real part of a garment with its fabric as plain numbers: padding is left out."""

    vertices: Int[np.ndarray, " vertices"]  # rows of the padded garment
    rest: Float[np.ndarray, "vertices 3"]  # [m]
    faces: Int[np.ndarray, "faces 3"]
    hinges: Int[np.ndarray, "hinges 4"]  # edge start, edge end, opposite left, opposite right
    masses: Float[np.ndarray, " vertices"]  # [kg]; zero where pinned
    is_pinned: np.ndarray  # [vertices]
    areas: Float[np.ndarray, " faces"]  # [m^2]
    shear: Float[np.ndarray, " faces"]  # mu h [N/m]
    area_stiffness: Float[np.ndarray, " faces"]  # lambda h [N/m]
    bending: Float[np.ndarray, " hinges"]  # energy per squared angle, doubled [J]
    bending_stiffness: Float[np.ndarray, " hinges"]  # [J]
    hinge_areas: Float[np.ndarray, " hinges"]  # of both faces [m^2]


def strip_stiffness(shear: np.ndarray, area_stiffness: np.ndarray) -> np.ndarray:
    """Return E h of plane stress [N/m], the tension per width and strain of a strip that is free across."""
    return 4.0 * shear * (shear + area_stiffness) / (2.0 * shear + area_stiffness)


def prepare_cloth(garment: Garment, material: Material) -> Cloth:
    """Return a garment without its padding, with the fabric's moduli where they act."""
    is_vertex = np.asarray(garment.vertex_mask)
    is_face = np.asarray(garment.rest_areas) > 0
    is_hinge = np.asarray(garment.hinge_rest_areas) > 0
    index = np.cumsum(is_vertex) - 1
    rest = np.asarray(garment.rest_positions, np.float64)
    is_pinned = np.asarray(garment.is_pinned)[is_vertex]
    masses = np.asarray(vertex_masses(garment, material), np.float64)[is_vertex]

    def each(value: Any, is_real: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.asarray(value, np.float64), is_real.shape)[is_real]

    thickness = each(material.thickness, is_face) if np.ndim(material.thickness) else material.thickness
    hinges = np.asarray(garment.hinges)[is_hinge]
    areas = np.asarray(garment.hinge_rest_areas, np.float64)[is_hinge]
    squared = np.sum((rest[hinges[:, 1]] - rest[hinges[:, 0]]) ** 2, axis=1)
    stiffness = each(material.bending_stiffness, is_hinge)
    return Cloth(
        vertices=np.flatnonzero(is_vertex), rest=rest[is_vertex],
        faces=index[np.asarray(garment.faces)[is_face]], hinges=index[hinges],
        masses=np.where(is_pinned, 0.0, masses), is_pinned=is_pinned,
        areas=np.asarray(garment.rest_areas, np.float64)[is_face],
        shear=each(material.lame_mu, is_face) * thickness,
        area_stiffness=each(material.lame_lambda, is_face) * thickness,
        bending=stiffness * squared / (4.0 * areas), bending_stiffness=stiffness, hinge_areas=areas,
    )  # fmt: skip


def springs(cloth: Cloth) -> tuple[Int[np.ndarray, "edges 2"], Float[np.ndarray, " edges"]]:
    """Return the edges and their stiffness as springs [N/m]: the sum of E h A over the faces beside it / l^2."""
    edges, which, _ = undirected_edges(cloth.faces)
    weight = strip_stiffness(cloth.shear, cloth.area_stiffness) * cloth.areas
    total = np.bincount(which, np.repeat(weight, 3), len(edges))
    squared = np.sum((cloth.rest[edges[:, 1]] - cloth.rest[edges[:, 0]]) ** 2, axis=1)
    return edges, total / squared


def stable_substeps(cloth: Cloth, timestep: float) -> int:
    """Return how many substeps XPBD needs: 1 / (k dt^2) >= 3 (1 / m_i + 1 / m_j) on every spring.

    Measured, not proven: with fewer, cloth explodes.
    """
    edges, stiffness = springs(cloth)
    inverse = np.divide(1.0, cloth.masses, out=np.zeros_like(cloth.masses), where=cloth.masses > 0)
    rate = np.max(_JACOBI * stiffness * inverse[edges].sum(axis=1))
    return max(math.ceil(timestep * math.sqrt(rate)), 1)


def bending_cotangents(cloth: Cloth) -> Float[np.ndarray, "hinges 4"]:
    """Return the cotangents of the rest angles at both ends of every hinge: start left, start right, end ..."""

    def cotangent(at: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        a, b = cloth.rest[one] - cloth.rest[at], cloth.rest[other] - cloth.rest[at]
        return np.sum(a * b, axis=1) / np.linalg.norm(np.cross(a, b), axis=1)

    start, end, left, right = cloth.hinges.T
    pairs = ((start, end), (end, start))
    return np.stack([cotangent(*pair, tip) for pair in pairs for tip in (left, right)], axis=1)


def contact_stiffness(scene: Scene) -> float:
    """Return a spring [N/m] as strong as our cubic energy on a vertex pressed through the whole distance.

    3 k a r^2 / r, with the mean vertex area a and the distance r.
    """
    areas = np.asarray(scene.garment.vertex_areas)
    radius = float(contact_thickness(scene.garment, scene.term(Collision).thickness))
    return 3.0 * float(scene.term(Collision).stiffness) * float(areas[areas > 0].mean()) * radius


def require_newton() -> ModuleType:
    """Return Newton, or raise MissingExtraError."""
    return require("newton", extra="peers", purpose="the comparison with other simulators")


class NewtonCloth:
    """A scene in one of Newton's solvers; steps frames from any state."""

    def __init__(self, scene: Scene, setting: Setting) -> None:
        newton = require_newton()
        self._warp = require("warp", extra="peers", purpose="the comparison with other simulators")
        self._warp.config.log_level = self._warp.LOG_WARNING  # it would report every kernel it loads
        friction = scene.term(Friction) or Friction()
        self._cloth = cloth = prepare_cloth(scene.garment, scene.material)
        self._timestep = float(scene.timestep)
        self.substeps = setting.substeps or stable_substeps(cloth, self._timestep)
        self._targets = (
            None if scene.pin_targets is None else np.asarray(scene.pin_targets)[:, cloth.vertices]
        )
        with contextlib.redirect_stdout(io.StringIO()):  # Style3D reports its own times
            builder = _build(newton, scene, setting.solver, cloth)
            self._model = model = builder.finalize()
            model.set_gravity((0.0, -float(scene.term(Gravity).acceleration), 0.0))
            model.soft_contact_ke = contact_stiffness(scene)
            model.soft_contact_kd = 0.0
            model.soft_contact_mu = float(friction.coefficient)
            model.particle_grid, model.particle_max_radius = None, 0.0  # XPBD would keep all vertices apart
            self._solver = _make_solver(newton, model, setting, scene)
        self._body = None
        if scene.body is not None:
            self._body, self._mesh = np.asarray(scene.body.positions), model.shape_source[0].mesh
            model.shape_collision_aabb_lower.fill_(self._warp.vec3(-_FAR, -_FAR, -_FAR))
            model.shape_collision_aabb_upper.fill_(self._warp.vec3(_FAR, _FAR, _FAR))
        gap = max(_REACH / self.substeps, _LEAST_GAP)
        self._pipeline = newton.CollisionPipeline(model, soft_contact_gap=gap)
        self._contacts = self._pipeline.contacts()
        self._now, self._after = model.state(), model.state()
        # The first substep loads kernels and sizes buffers, the second is recorded: replaying it without Python
        # halves the time of frames of 1k vertices.
        self._substep()
        with self._warp.ScopedCapture() as capture:
            self._substep()
        self._graph = capture.graph

    def __call__(self, state: ClothState, frame: int) -> ClothState:
        """Step from a state at `frame` to the next frame; what only our own solver reads stays as it is."""
        rows = self._cloth.vertices
        self._now.particle_q.assign(np.asarray(state.position, np.float32)[rows])
        self._now.particle_qd.assign(np.asarray(state.velocity, np.float32)[rows])
        for substep in range(self.substeps):
            self._move_surroundings(frame, (substep + 1) / self.substeps)
            self._warp.capture_launch(self._graph)
        position, velocity = np.array(state.position), np.array(state.velocity)
        position[rows], velocity[rows] = self._now.particle_q.numpy(), self._now.particle_qd.numpy()
        return state.replace(
            position=jnp.asarray(position), velocity=jnp.asarray(velocity), frame=state.frame + 1
        )

    def _substep(self) -> None:
        """Advance the model's state by one substep."""
        self._now.clear_forces()
        # Contacts of the frame's start would let cloth through: the body may cross it within the frame.
        self._pipeline.collide(self._now, self._contacts)
        self._solver.step(self._now, self._after, None, self._contacts, self._timestep / self.substeps)
        self._warp.copy(self._now.particle_q, self._after.particle_q)
        self._warp.copy(self._now.particle_qd, self._after.particle_qd)

    def _move_surroundings(self, frame: int, share: float) -> None:
        """Put body and pinned vertices where they are after a share of the frame."""
        if self._body is not None:
            before, after = self._body[frame], self._body[frame + 1]
            self._mesh.points.assign(before + share * (after - before))
            self._mesh.velocities.assign((after - before) / self._timestep)
            self._mesh.refit()
        if self._targets is not None:
            before, after = self._targets[frame], self._targets[frame + 1]
            position, is_pinned = self._now.particle_q.numpy(), self._cloth.is_pinned
            position[is_pinned] = (before + share * (after - before))[is_pinned]
            self._now.particle_q.assign(position)


def _build(newton: ModuleType, scene: Scene, solver: str, cloth: Cloth) -> Any:
    """Return a model builder that holds cloth at rest and the body in its first frame."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    radius = float(contact_thickness(scene.garment, scene.term(Collision).thickness))
    count = len(cloth.rest)
    flags = np.where(cloth.masses > 0, int(newton.ParticleFlags.ACTIVE), 0).tolist()
    still = [(0.0, 0.0, 0.0)] * count
    builder.add_particles(cloth.rest.tolist(), still, cloth.masses.tolist(), [radius] * count, flags)
    start, end, left, right = cloth.hinges.T
    length = np.linalg.norm(cloth.rest[end] - cloth.rest[start], axis=1)
    stretch, triangles, hinges = strip_stiffness(cloth.shear, cloth.area_stiffness), None, None
    if solver == "style3d":
        newton.solvers.SolverStyle3D.register_custom_attributes(builder)
        triangles = {"style3d:tri_aniso_ke": np.stack([stretch, stretch, cloth.shear], axis=1).tolist()}
        hinges = {
            "style3d:edge_rest_area": cloth.hinge_areas.tolist(),
            "style3d:edge_bending_cot": bending_cotangents(cloth).tolist(),
        }
    bending = {
        "vbd": cloth.bending / length,  # 1/2 k l theta^2
        "style3d": cloth.bending_stiffness / 12.0,  # 3 k (l theta)^2 / (2 A)
        # The force at a tip is k l theta, where ours is M l / (2 A_f).
        "xpbd": cloth.bending / cloth.hinge_areas,
    }[solver]
    zeros = [0.0] * len(cloth.faces)
    stiffness = {"tri_ke": cloth.shear.tolist(), "tri_ka": cloth.area_stiffness.tolist()}
    stiffness |= dict.fromkeys(("tri_kd", "tri_drag", "tri_lift"), zeros)
    builder.add_triangles(*cloth.faces.T, custom_attributes=triangles, **stiffness)
    zeros = [0.0] * len(start)
    bent = {"rest": zeros, "edge_ke": bending.tolist(), "edge_kd": zeros}  # fabric is flat at rest
    builder.add_edges(left, right, start, end, custom_attributes=hinges, **bent)
    if solver == "xpbd":
        for (i, j), stiffness in zip(*springs(cloth), strict=True):
            builder.add_spring(int(i), int(j), float(stiffness), 0.0, control=0.0)
    if solver == "vbd":
        builder.color(include_bending=True)
    if scene.body is not None:
        contact = {"ke": contact_stiffness(scene), "kd": 0.0, "mu": float(scene.term(Friction).coefficient)}
        config = newton.ModelBuilder.ShapeConfig(density=0.0, **contact)
        faces = np.asarray(scene.body.surface.faces).ravel()
        mesh = newton.Mesh(np.asarray(scene.body.positions[0]), faces, compute_inertia=False)
        builder.add_shape_mesh(-1, mesh=mesh, cfg=config)
    return builder


def _make_solver(newton: ModuleType, model: Any, setting: Setting, scene: Scene) -> Any:
    """Return the solver; layers of cloth pass through each other where the scene does not model them."""
    solvers, iterations = newton.solvers, setting.iterations
    friction_speed = float((scene.term(Friction) or Friction()).speed)
    if setting.solver == "vbd":
        layers = {}
        if keeps_layers(scene):
            distance = float(contact_thickness(scene.garment, LAYER_THICKNESS))
            layers = {
                "particle_enable_self_contact": True,
                "particle_self_contact_margin": distance,
                "particle_self_contact_gap": distance,  # Newton's advice: half to all of the margin
            }
        return solvers.SolverVBD(model, iterations=iterations, friction_epsilon=friction_speed, **layers)
    if setting.solver == "xpbd":
        return solvers.SolverXPBD(model, iterations=iterations)
    solver = solvers.SolverStyle3D(model, config=solvers.SolverStyle3D.Config(iterations=iterations))
    if not keeps_layers(scene):
        solver.collision.stiff_vf = solver.collision.stiff_ee = solver.collision.stiff_ef = 0.0
    solver.collision.friction_epsilon = friction_speed
    return solver


def newton_simulator(setting: Setting) -> Simulator:
    """Return a solver of Newton as a simulator of the hard cases; MissingExtraError where it is not installed."""
    require_newton()

    def run(scene: Scene) -> Trajectory:
        try:
            cloth = NewtonCloth(scene, setting)
            states = [scene.initial_state]
            for frame in range(scene.num_frames - 1):
                states.append(cloth(states[-1], frame))
        except Exception as error:  # Newton names none of its own
            raise EslrError(f"{setting.name} refused the scene: {error}") from error
        positions = np.stack([state.position for state in states])
        velocities = np.stack([state.velocity for state in states])
        iterations = cloth.substeps * setting.iterations
        return foreign_trajectory(positions, scene, velocities=velocities, iterations=iterations)

    effort = f"{setting.substeps}x" if setting.substeps else "as many substeps as needed, "
    return Simulator(f"{setting.name}, {effort}{setting.iterations}", run)
