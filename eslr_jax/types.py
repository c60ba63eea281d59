"""Pytrees that travel through the simulator. SI units, Y up, right-handed.

Padding: arrays are padded to a bucket. The last vertex of a padded garment is a real row with zero area; padded
faces, hinges and edges point at it and carry zero area, so every sum over them is exactly zero. An index is
never out of range.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int


@struct.dataclass
class CoarseEdges:
    """One coarse level of a garment's edges, see `mesh.coarse`."""

    senders: Int[Array, " coarse_edges"]  # directed, both directions
    receivers: Int[Array, " coarse_edges"]  # sorted ascending
    reverse_edges: Int[Array, " coarse_edges"]  # index of the opposite directed edge
    edge_mask: Bool[Array, " coarse_edges"]
    is_kept: Bool[Array, " vertices"]  # vertices that these edges join


@struct.dataclass
class Garment:
    """A garment's rest mesh, its topology tables and its skinning; constant during a rollout."""

    rest_positions: Float[Array, "vertices 3"]  # [m], in the body's rest pose
    # [m], on which lengths, areas and angles are measured; they differ where the garment was posed or cut anew
    sewn_positions: Float[Array, "vertices 3"]
    faces: Int[Array, "faces 3"]  # counter-clockwise seen from outside
    rest_areas: Float[Array, " faces"]  # [m^2], zero where padded
    inverse_rest_frames: Float[Array, "faces 2 2"]  # inverse of D_m [1/m]
    hinges: Int[Array, "hinges 4"]  # edge start, edge end, opposite vertex left, opposite vertex right
    hinge_rest_areas: Float[Array, " hinges"]  # sum of the two rest areas [m^2], zero where padded
    hinge_rest_lengths: Float[Array, " hinges"]  # of the edge [m], zero where padded
    vertex_areas: Float[Array, " vertices"]  # a third of the incident rest areas [m^2], zero where padded
    senders: Int[Array, " edges"]  # directed mesh edges, both directions
    receivers: Int[Array, " edges"]  # sorted ascending
    reverse_edges: Int[Array, " edges"]  # index of the opposite directed edge
    neighbors: Int[Array, "vertices degree"]  # padded with the vertex itself
    neighbor_mask: Bool[Array, "vertices degree"]
    face_incidence: Int[Array, "vertices face_degree"]  # see numerics.gather_corners
    hinge_incidence: Int[Array, "vertices hinge_degree"]
    vertex_blocks: Int[Array, "vertex_blocks block"]  # compact groups of all vertices; some may be repeated
    face_blocks: Int[Array, "face_blocks face_block"]  # likewise of all faces
    edges: Int[Array, "pairs 2"]  # every mesh edge once
    edge_blocks: Int[Array, "edge_blocks edge_block"]  # compact groups of them
    edge_mask: Bool[Array, " edges"]
    vertex_mask: Bool[Array, " vertices"]
    geodesic_embedding: Float[Array, "vertices embedding"]  # [m]
    skin_weights: Float[Array, "vertices influences"]  # rows sum to one
    skin_indices: Int[Array, "vertices influences"]
    is_pinned: Bool[Array, " vertices"]  # follows its skinned position
    coarse: tuple[CoarseEdges, ...] | None = None  # finest first; only hierarchical networks read them
    material: Material | None = None  # of its file's fabrics; None: cotton. A scene has it beside it
    # Made by `with_rest_positions`: what the host prepared for the former shape, such as a `Plate`, is refused.
    is_recut: bool = struct.field(pytree_node=False, default=False)

    @property
    def mean_vertex_area(self) -> Float[Array, ""]:
        """Area of cloth that a vertex stands for in the mean [m^2]."""
        return jnp.sum(self.vertex_areas) / jnp.sum(self.vertex_mask, dtype=self.vertex_areas.dtype)


@struct.dataclass
class Plate:
    """Bending of a thin plate on one garment's mesh, see `mesh.plate`.

    The energy is half the sum of squares of `rows` times the angles of the nine hinges around every face.
    """

    hinges: Int[Array, "faces 9"]  # of the face and its neighbours; zero where there is none
    incidence: Int[Array, "hinges 6"]  # see numerics.gather_values
    rows: Float[Array, "3 9 faces"]  # [sqrt(J)] by radian; zero where there is no hinge


@struct.dataclass
class Threads:
    """Stretch of a fabric with warp and weft on one garment's faces, see `terms.stretch`."""

    warp: Float[Array, "faces 2"]  # unit vectors in the rest faces' own frames, see `mesh.plate`
    stiffness: Float[Array, "4 faces"]  # [N/m] along warp, along weft, coupling of both, shear
    limits: Float[Array, "2 faces"] | None = None  # Green strain where they begin to stiffen


@struct.dataclass
class Material:
    """Fabric of a garment; scalars, or one value per face (stretch), hinge (bending) or vertex (density).

    Without `plate` and `threads`, the cloth is an isotropic sheet with HOOD's bending. Networks always read the
    numbers of such a sheet. With `plate` or `threads`, these numbers describe the nearest isotropic sheet.
    """

    density: Float[Array, ...]  # [kg/m^2]
    lame_mu: Float[Array, ...]  # [Pa]
    lame_lambda: Float[Array, ...]  # [Pa]
    bending_stiffness: Float[Array, ...]  # [J], see `terms.bending.hinge_stiffnesses`
    thickness: Float[Array, ...]  # [m]
    plate: Plate | None = None  # bending by flexural rigidity, in the place of `bending_stiffness`
    threads: Threads | None = None  # stretch and shear, in the place of the Lame parameters


MIN_DEVIATION = 1e-8  # floor of a feature's standard deviation (HOOD)


@struct.dataclass
class Normalizer:
    """Mean and spread of a set of features over every row seen so far; see `networks.normalizer`."""

    count: Float[Array, ""]  # rows seen
    mean: Float[Array, " features"]
    squared_deviations: Float[Array, " features"]  # sum over rows of (x - mean)^2
    num_updates: Int[Array, ""]  # graphs seen


@struct.dataclass
class Body:
    """A rigged body in its rest pose."""

    rest_positions: Float[Array, "body_vertices 3"]  # [m]
    shape_directions: Float[Array, "body_vertices 3 shapes"]  # [m] per standard deviation
    joint_rest_positions: Float[Array, "joints 3"]  # [m]
    joint_shape_directions: Float[Array, "joints 3 shapes"]
    skin_weights: Float[Array, "body_vertices influences"]
    skin_indices: Int[Array, "body_vertices influences"]
    faces: Int[Array, "body_faces 3"]
    is_obstacle: Bool[Array, " body_faces"]  # faces that cloth may touch
    parents: tuple[int, ...] = struct.field(pytree_node=False)  # -1 is the root
    joint_names: tuple[str, ...] = struct.field(pytree_node=False)
    # [m] per entry of R - I of every joint but the root; None: the model has no pose blend shapes
    pose_directions: Float[Array, "body_vertices 3 entries"] | None = None


@struct.dataclass
class BodySurface:
    """Part of a body that cloth can touch, with a two-level search structure.

    Vertices are grouped into patches that stay together when the body bends. The nearest patches lead to the
    nearest vertices, and these to the faces around them.
    """

    vertex_ids: Int[Array, " surface_vertices"]  # of the whole body's vertices
    faces: Int[Array, "surface_faces 3"]  # into `vertex_ids`
    face_incidence: Int[Array, "surface_vertices degree"]  # see numerics.gather_corners
    patch_vertices: Int[Array, "patches members"]  # compact groups of all vertices; the last may repeat one
    face_blocks: Int[Array, "face_blocks face_block"]  # likewise of all faces
    edges: Int[Array, "surface_edges 2"]  # every edge once
    edge_blocks: Int[Array, "edge_blocks edge_block"]  # likewise of all edges
    is_boundary: Bool[Array, " surface_vertices"]  # where the faces end
    vertex_areas: Float[Array, " surface_vertices"]  # a third of the incident areas at rest [m^2]


@struct.dataclass
class BodyMotion:
    """A body in motion: what a rollout reads, frame by frame."""

    positions: Float[Array, "frames body_vertices 3"]  # [m]
    joint_transforms: Float[Array, "frames joints 3 4"]  # rest point -> posed point
    faces: Int[Array, "body_faces 3"]
    is_obstacle: Bool[Array, " body_faces"]
    timestep: Float[Array, ""]  # seconds between frames
    rest_positions: Float[Array, "body_vertices 3"]  # in the rest pose that garments are made for [m]
    surface: BodySurface  # all obstacle faces; a scene may search fewer, see `simulation.plan.plan_scene`


class PastState(NamedTuple):
    """The cloth one frame ago."""

    position: Float[Array, "vertices 3"]  # [m]
    velocity: Float[Array, "vertices 3"]  # [m/s]
    timestep: Float[Array, ""]  # from there to now [s]
    is_known: Bool[Array, ""]  # False before the first frame: that one is stepped by implicit Euler


@struct.dataclass
class ClothState:
    """What changes from frame to frame."""

    position: Float[Array, "vertices 3"]  # [m]
    velocity: Float[Array, "vertices 3"]  # [m/s]
    friction_load: Float[Array, " vertices"]  # normal force carried into the next frame's friction [N]
    frame: Int[Array, ""]  # index of this frame
    status: Int[Array, ""]  # errors.Status bits
    first_bad_frame: Int[Array, ""]  # -1 while status is OK
    past: PastState | None = None  # at t - 1, for BDF2; None: implicit Euler


@struct.dataclass
class Contacts:
    """One body point for every garment vertex, at both ends of a frame."""

    points: Float[Array, "vertices 3"]  # on the body at frame t [m]
    next_points: Float[Array, "vertices 3"]  # the same material points at t + 1 [m]
    normals: Float[Array, "vertices 3"]  # outward unit normals at t
    next_normals: Float[Array, "vertices 3"]  # at t + 1
    distances: Float[Array, " vertices"]  # signed, of the vertex at t or on its path, positive outside [m]
    is_near: Bool[Array, " vertices"]  # close enough for the tangent plane to stand for the body
    faces: Int[Array, " vertices"]  # of the body surface, that hold the points; zero on the ground


@struct.dataclass
class Obstacle:
    """The body of a scene, as far as cloth can reach it."""

    surface: BodySurface
    positions: Float[Array, "frames surface_vertices 3"]  # [m], in the order of the surface


@struct.dataclass
class Scene:
    """All that a rollout reads. A part that is None is not modelled: the compiled step does not hold it."""

    garment: Garment
    material: Material
    # `terms.term.Term`s, whose sum each frame minimises: what is modelled, see `simulation.scene.scene_terms`.
    terms: tuple[Any, ...]
    timestep: Float[Array, ""]  # [s]
    initial_state: ClothState
    body: Obstacle | None
    pin_targets: Float[Array, "frames vertices 3"] | None  # positions of pinned vertices [m]
    num_frames: int = struct.field(pytree_node=False)
    substeps: int = struct.field(pytree_node=False, default=1)  # in which a frame is simulated

    def term(self, kind: type) -> Any:
        """Return the first term of a type; None without one."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def with_term(self, changed: Any) -> Scene:
        """Return the scene with a term in the place of the first one of its type."""
        kinds = [type(term) for term in self.terms]
        place = kinds.index(type(changed))
        return self.replace(terms=(*self.terms[:place], changed, *self.terms[place + 1 :]))


@struct.dataclass
class Trajectory:
    """A simulated garment. Frame 0 is the initial state; it has zero energies, residual and iterations."""

    positions: Float[Array, "frames vertices 3"]  # [m]
    velocities: Float[Array, "frames vertices 3"]  # [m/s]
    friction_loads: Float[Array, "frames vertices"]  # normal forces that load the next frame's friction [N]
    energies: dict[str, Float[Array, " frames"]]  # that each frame ended with [J], by the names of the terms
    residuals: Float[Array, " frames"]  # force norm over weight at the end of each frame
    # Share of the initial gap that the solver left at most; inf without one.
    gap_bounds: Float[Array, " frames"]
    iterations: Int[Array, " frames"]  # of the solver; with substeps, the most that one of them took
    status: Int[Array, ""]  # errors.Status bits
    first_bad_frame: Int[Array, ""]  # row of the first frame with a status; -1 while status is OK
    # Rows that frames asked the terms' buffers for, by their names.
    demands: dict[str, Int[Array, " frames"]] = struct.field(default_factory=dict)
    # Frames in which something may have passed through cloth; None where no term watches that.
    is_passed: Bool[Array, " frames"] | None = None
    # Equal parts in which each frame was simulated, see `simulate`; None: as many as the scene says.
    substeps: Int[Array, " frames"] | None = None

    @property
    def num_frames(self) -> int:
        """Number of frames, frame 0 included."""
        return self.positions.shape[0]

    def to_dict(self) -> dict[str, np.ndarray]:
        """Return plain NumPy arrays by name, for `numpy.savez` or xarray; energies are `stretch_energy`, ... [J].

        Their axes are frames, vertices and xyz, as many as an array has. What was not modelled is left out.
        """
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for kind, tracks in (("energy", values.pop("energies")), ("demand", values.pop("demands"))):
            values |= {f"{name}_{kind}": track for name, track in tracks.items()}
        return {name: np.asarray(value) for name, value in values.items() if value is not None}


def tree_cast(tree: object, dtype) -> object:
    """Cast the floating-point arrays of a pytree, for float64 references; Python numbers stay as they are."""

    def cast(leaf):
        is_array = hasattr(leaf, "dtype") and jax.numpy.issubdtype(leaf.dtype, jax.numpy.floating)
        return leaf.astype(dtype) if is_array else leaf

    return jax.tree.map(cast, tree)
