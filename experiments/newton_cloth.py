"""A scene of this package in Newton's cloth solvers: VBD, Style3D and XPBD (extra `peers`).

Newton is Apache-2.0, https://github.com/newton-physics/newton; read in version 1.8.0. The body is one static
mesh whose points and velocities are set, and whose search tree is refitted, before every substep; cloth meets it
by vertices, at the distance that our vertices keep. There is no damping, and self-contact only in scenes that ask
for it: VBD's at our distance, Style3D's as it comes; XPBD has none for vertices and faces.

How fabric is carried over (h thickness, mu and lambda Lame, l edge, A the areas of the faces beside it):

- VBD: stable Neo-Hookean with mu h and lambda h, St. Venant-Kirchhoff for small strain. Bending is ours.
- Style3D: Baraff and Witkin's stretch and shear along two axes per triangle. Stretch has the stiffness of a strip
  pulled along one axis, E h, shear has mu h; nothing couples the two axes, so cloth does not narrow when pulled.
  Bending is the quadratic one for a flat rest shape, ours at small angles. Velocities lose 0.2 % a substep.
- XPBD: a spring per edge, E h A / l^2 (Van Gelder 1998, doi 10.1080/10867651.1998.10487490), which is a sheet of
  Poisson's ratio 1/3. Its bending leaves the normal's length out of the gradient; the stiffness makes up for it
  where the constraint is soft.

What can't be carried over: the cubic contact energy becomes a spring, as stiff as ours is on average over the
contact distance (XPBD: rigid), and XPBD takes no friction speed. Every substep is a step of implicit Euler of its
own, so with several of them even an exact answer is not the minimum of our potential, which has one step a frame.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float, Int

from eslr_jax.errors import EslrError
from eslr_jax.evaluation.hard_cases import Simulator, StressScene
from eslr_jax.extras import require
from eslr_jax.physics.inertia import vertex_masses
from eslr_jax.physics.problem import PhysicsParameters, contact_thickness
from eslr_jax.simulation.scan import Frames, join_frames
from eslr_jax.types import ClothState, Garment, Material, Scene, Trajectory

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


LABELS = {"vbd": "VBD", "style3d": "Style3D", "xpbd": "XPBD"}


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
    """Return the tension per width and strain of a strip pulled along one axis, free across it [N/m].

    E h = 4 mu (mu + lambda) h / (2 mu + lambda), of plane stress.
    """
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
        vertices=np.flatnonzero(is_vertex),
        rest=rest[is_vertex],
        faces=index[np.asarray(garment.faces)[is_face]],
        hinges=index[hinges],
        masses=np.where(is_pinned, 0.0, masses),
        is_pinned=is_pinned,
        areas=np.asarray(garment.rest_areas, np.float64)[is_face],
        shear=each(material.lame_mu, is_face) * thickness,
        area_stiffness=each(material.lame_lambda, is_face) * thickness,
        bending=stiffness * squared / (4.0 * areas),
        bending_stiffness=stiffness,
        hinge_areas=areas,
    )


def springs(cloth: Cloth) -> tuple[Int[np.ndarray, "edges 2"], Float[np.ndarray, " edges"]]:
    """Return the edges and their stiffness as springs [N/m]: the sum of E h A over the faces beside it / l^2."""
    corners = cloth.faces
    sides = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    edges, which = np.unique(sides, axis=0, return_inverse=True)
    weight = strip_stiffness(cloth.shear, cloth.area_stiffness) * cloth.areas
    total = np.bincount(which.ravel(), np.tile(weight, 3), len(edges))
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
    return np.stack(
        [
            cotangent(start, end, left),
            cotangent(start, end, right),
            cotangent(end, start, left),
            cotangent(end, start, right),
        ],
        axis=1,
    )


def contact_stiffness(scene: Scene, parameters: PhysicsParameters) -> float:
    """Return a spring [N/m] as strong as our cubic energy on a vertex pressed through the whole distance.

    3 k a r^2 / r, with the mean vertex area a and the distance r.
    """
    areas = np.asarray(scene.garment.vertex_areas)
    radius = float(contact_thickness(scene.garment, parameters.collision_thickness))
    return 3.0 * float(parameters.collision_stiffness) * float(areas[areas > 0].mean()) * radius


class NewtonCloth:
    """A scene in one of Newton's solvers; steps frames from any state."""

    def __init__(
        self,
        scene: Scene,
        setting: Setting,
        parameters: PhysicsParameters | None = None,
        *,
        self_contact: bool = False,
    ) -> None:
        """Build the model.

        Args:
            scene: Of `prepare_scene`.
            setting: Solver and effort.
            parameters: Physical constants.
            self_contact: Keep layers apart, where the solver can.

        Raises:
            MissingExtraError: Newton is not installed.
        """
        newton = require("newton", extra="peers", purpose="the comparison with other simulators")
        self._warp = require("warp", extra="peers", purpose="the comparison with other simulators")
        self._warp.config.log_level = self._warp.LOG_WARNING  # it would report every kernel it loads
        parameters = parameters or PhysicsParameters()
        self._cloth = cloth = prepare_cloth(scene.garment, scene.material)
        self._timestep = float(scene.timestep)
        self.substeps = setting.substeps or stable_substeps(cloth, self._timestep)
        self._body = None if scene.body_positions is None else np.asarray(scene.body_positions)
        self._targets = (
            None if scene.pin_targets is None else np.asarray(scene.pin_targets)[:, cloth.vertices]
        )
        with contextlib.redirect_stdout(io.StringIO()):  # Style3D reports its own times
            builder = _build(newton, scene, setting.solver, cloth, parameters)
            self._model = model = builder.finalize()
            model.set_gravity((0.0, -float(parameters.gravity), 0.0))
            model.soft_contact_ke = contact_stiffness(scene, parameters)
            model.soft_contact_kd = 0.0
            model.soft_contact_mu = float(parameters.friction_coefficient)
            model.particle_grid, model.particle_max_radius = None, 0.0  # XPBD would keep all vertices apart
            layer_distance = None
            if self_contact:
                layer_distance = float(contact_thickness(scene.garment, parameters.repulsion_thickness))
            self._solver = _make_solver(
                newton, model, setting, float(parameters.friction_speed), layer_distance
            )
        self._mesh = None
        if self._body is not None:
            self._mesh = model.shape_source[0].mesh
            for bound, sign in (
                (model.shape_collision_aabb_lower, -1),
                (model.shape_collision_aabb_upper, 1),
            ):
                bound.fill_(self._warp.vec3(sign * _FAR, sign * _FAR, sign * _FAR))
        gap = max(_REACH / self.substeps, _LEAST_GAP)
        self._pipeline = newton.CollisionPipeline(model, soft_contact_gap=gap)
        self._contacts = self._pipeline.contacts()
        self._now, self._after = model.state(), model.state()
        # The first substep loads kernels and sizes buffers, the second is recorded: replayed without Python in
        # between, frames of 1k vertices take half the time.
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
        return dataclasses.replace(
            state,
            position=jax.numpy.asarray(position),
            velocity=jax.numpy.asarray(velocity),
            frame=state.frame + 1,
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


def _build(newton: Any, scene: Scene, solver: str, cloth: Cloth, parameters: PhysicsParameters) -> Any:
    """Return a model builder that holds cloth at rest and the body in its first frame."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    radius = float(contact_thickness(scene.garment, parameters.collision_thickness))
    count = len(cloth.rest)
    flags = np.where(cloth.masses > 0, int(newton.ParticleFlags.ACTIVE), 0).tolist()
    builder.add_particles(
        cloth.rest.tolist(), [(0.0, 0.0, 0.0)] * count, cloth.masses.tolist(), [radius] * count, flags
    )
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
        "xpbd": cloth.bending
        / cloth.hinge_areas,  # the force at a tip is k l theta, where ours is M l / (2 A_f)
    }[solver]
    zeros = [0.0] * len(cloth.faces)
    builder.add_triangles(
        *cloth.faces.T,
        tri_ke=cloth.shear.tolist(),
        tri_ka=cloth.area_stiffness.tolist(),
        tri_kd=zeros,
        tri_drag=zeros,
        tri_lift=zeros,
        custom_attributes=triangles,
    )
    builder.add_edges(
        left,
        right,
        start,
        end,
        rest=[0.0] * len(start),  # fabric is flat
        edge_ke=bending.tolist(),
        edge_kd=[0.0] * len(start),
        custom_attributes=hinges,
    )
    if solver == "xpbd":
        for (i, j), stiffness in zip(*springs(cloth), strict=True):
            builder.add_spring(int(i), int(j), float(stiffness), 0.0, control=0.0)
    if solver == "vbd":
        builder.color(include_bending=True)
    if scene.surface is not None:
        friction = float(parameters.friction_coefficient)
        stiffness = contact_stiffness(scene, parameters)
        config = newton.ModelBuilder.ShapeConfig(density=0.0, ke=stiffness, kd=0.0, mu=friction)
        mesh = newton.Mesh(
            np.asarray(scene.body_positions[0]),
            np.asarray(scene.surface.faces).ravel(),
            compute_inertia=False,
        )
        builder.add_shape_mesh(-1, mesh=mesh, cfg=config)
    return builder


def _make_solver(
    newton: Any, model: Any, setting: Setting, friction_speed: float, layer_distance: float | None
) -> Any:
    """Return the solver; layers keep that distance [m], None: they pass through each other."""
    if setting.solver == "vbd":
        layers = {}
        if layer_distance is not None:
            layers = {
                "particle_enable_self_contact": True,
                "particle_self_contact_margin": layer_distance,
                "particle_self_contact_gap": layer_distance,  # Newton's advice: half to all of the margin
            }
        return newton.solvers.SolverVBD(
            model, iterations=setting.iterations, friction_epsilon=friction_speed, **layers
        )
    if setting.solver == "xpbd":
        return newton.solvers.SolverXPBD(model, iterations=setting.iterations)
    solver = newton.solvers.SolverStyle3D(
        model, config=newton.solvers.SolverStyle3D.Config(iterations=setting.iterations)
    )
    if layer_distance is None:
        solver.collision.stiff_vf = solver.collision.stiff_ee = solver.collision.stiff_ef = 0.0
    solver.collision.friction_epsilon = friction_speed
    return solver


def newton_simulator(setting: Setting) -> Simulator:
    """Return a solver of Newton as a simulator of the hard cases.

    Residuals stay zero: Newton reports none, and ours are not its own.

    Args:
        setting: Solver and effort.
    """

    def run(stress: StressScene) -> Trajectory:
        scene = stress.scene
        try:
            cloth = NewtonCloth(scene, setting, stress.parameters, self_contact=stress.self_contact)
            states = [scene.start]
            for frame in range(scene.num_frames - 1):
                states.append(cloth(states[-1], frame))
        except EslrError:
            raise
        except Exception as error:  # of a package that names none
            raise EslrError(f"{setting.name} refused the scene: {error}") from error
        numpy = jax.numpy
        frames = Frames(
            positions=numpy.stack([state.position for state in states[1:]]),
            velocities=numpy.stack([state.velocity for state in states[1:]]),
            residuals=numpy.zeros(len(states) - 1),
            iterations=numpy.full(len(states) - 1, cloth.substeps * setting.iterations),
            needed_capacity=None,
        )
        return join_frames(scene.start, frames, states[-1])

    substeps = "as many" if setting.substeps is None else setting.substeps
    return Simulator(f"{setting.name}, {substeps}x{setting.iterations}", run)
