"""A simulation that goes on frame by frame while a person watches and changes it."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax.config import SimConfig
from eslr_jax.numerics import Vector3
from eslr_jax.simulation.frame import FrameInput, frame_inputs, without_tracks
from eslr_jax.simulation.plan import prepare_scene
from eslr_jax.simulation.program import find_program
from eslr_jax.simulation.rollout import step_frame
from eslr_jax.simulation.simulate import enlarge_buffers, share_programs
from eslr_jax.simulation.stepper import FrameReport, make_stepper
from eslr_jax.terms import Air, Elements, Term, scene_terms
from eslr_jax.terms.term import FrameProblem
from eslr_jax.types import BodyMotion, ClothState, Garment, Material, Scene

MOST_ITERATIONS = 100
_CONFIG = SimConfig(iterations=MOST_ITERATIONS)
_HOLD = 20.0  # [N/m], of the spring to a hand: at half a metre it pulls with a kilogram's weight


@struct.dataclass
class Hand(Term):
    """What holds the cloth: a spring from a vertex to a place."""

    name = "hand"

    vertex: Int[Array, ""]
    place: Float[Array, " 3"]  # [m]
    stiffness: Float[Array, ""]  # [N/m]; zero where nothing is held

    def elements(self, x: Vector3, problem: FrameProblem, data: None) -> tuple[Elements, ...]:
        """Return the energy of the spring [J]."""
        squared = sum((part[self.vertex] - place) ** 2 for part, place in zip(x, self.place, strict=True))
        return (Elements(0.5 * self.stiffness * squared[None], self.vertex[None, None]),)


class Stage(NamedTuple):
    """A scene that can be stepped forth and back along its motion."""

    scene: Scene  # with tracks
    constant: Scene  # without
    inputs: FrameInput  # from every frame to the next
    back: FrameInput  # from every frame to the one before


def no_hand() -> Hand:
    """Return a hand that holds nothing."""
    return Hand(jnp.int32(0), jnp.zeros(3), jnp.float32(0.0))


def grasp(vertex: int, place: Any) -> Hand:
    """Return a hand that pulls a vertex to a place [m]."""
    return Hand(jnp.int32(vertex), jnp.asarray(place, jnp.float32), jnp.float32(_HOLD))


def set_stage(garment: Garment, poses: BodyMotion, material: Material) -> Stage:
    """Return a garment on a moving body, with all that one can change while it moves.

    It is stepped by BDF2 in air. Changes of fabric, wind, hand and tolerance do not compile anew.

    Raises:
        MotionError: The motion has fewer than two frames.
    """
    terms = scene_terms(Air((0.0, 0.0, 0.0)), no_hand())

    def first_step(scene: Scene) -> tuple:
        stage = _staged(scene, material)
        frame = jax.tree.map(lambda leaf: leaf[0], stage.inputs)
        return stage.constant, scene.initial_state, frame, jnp.int32(0), jnp.float32(0.0)

    def begin(scene: Scene) -> None:
        find_program(_step, jax.eval_shape(first_step, share_programs(scene)), config=_CONFIG).begin()

    scene = prepare_scene(garment, poses, material=material, terms=terms, integrator="bdf2", on_shapes=begin)
    return _staged(share_programs(scene), material)


def _staged(scene: Scene, material: Material) -> Stage:
    back = inputs = frame_inputs(scene)
    if (body := inputs.body) is not None:
        back = back._replace(body=body._replace(start=body.end, end=body.start))
    if scene.pin_targets is not None:
        back = back._replace(pin_targets=scene.pin_targets[:-1])
    constant = jax.device_put(without_tracks(scene)).replace(num_frames=2)
    # Changed to what it is, so that it has the types of all that it will be changed to.
    return changed(Stage(scene, constant, inputs, back), material, (0.0, 0.0, 0.0), no_hand())


def changed(stage: Stage, material: Material, wind: Any, hand: Hand) -> Stage:
    """Return a stage with another fabric, wind [m/s] and hand."""
    air, hand = jax.tree.map(jnp.asarray, (Air(jnp.asarray(wind, jnp.float32)), hand))
    material = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), material, stage.constant.material)
    constant = stage.constant.replace(material=material).with_term(air).with_term(hand)
    return stage._replace(constant=constant)


def advance(
    stage: Stage, state: ClothState, frames: tuple[int, int], iterations: int, tolerance: float
) -> tuple[ClothState, FrameReport]:
    """Step the cloth while the body moves from the first of two neighbouring frames to the other.

    The frame may end at a tolerance: a share of its initial gap.
    """
    now, then = frames
    inputs = stage.inputs if then > now else stage.back
    row = min(now, then)
    frame = jax.tree.map(lambda leaf: leaf[row], inputs)
    arguments = (stage.constant, state, frame, jnp.int32(iterations), jnp.float32(tolerance))
    return find_program(_step, arguments, config=_CONFIG).wait()(*arguments)


def enlarged(stage: Stage, report: FrameReport) -> Stage | None:
    """Return the stage with larger buffers where a frame had too little room in one, else None."""
    scene, constant = (enlarge_buffers(one, report.demands) for one in (stage.scene, stage.constant))
    if scene is None or constant is None:
        return None
    return stage._replace(scene=scene, constant=constant)


def _step(
    scene: Scene,
    state: ClothState,
    frame: FrameInput,
    iterations: Int[Array, ""],
    tolerance: Float[Array, ""],
    *,
    config: SimConfig,
) -> tuple[ClothState, FrameReport]:
    return step_frame(make_stepper(None, config, iterations, tolerance), scene, state, frame)


def nearest_vertex(positions: Float[np.ndarray, "vertices 3"], origin: Any, direction: Any) -> int:
    """Return the vertex [m] that a ray from an origin [m] along a direction of unit length points at.

    It is the first vertex along the ray, among those that are at most a centimetre farther from the ray than the
    nearest one.
    """
    offset = positions - np.asarray(origin)
    along = offset @ np.asarray(direction)
    aside = np.linalg.norm(offset - along[:, None] * np.asarray(direction), axis=1)
    aside = np.where(along > 0, aside, np.inf)
    is_close = aside <= aside.min() + 0.01
    return int(np.flatnonzero(is_close)[np.argmin(along[is_close])])
