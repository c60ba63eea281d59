"""HOOD's measures of a whole trajectory, against its losses frame by frame."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_sheet
from paper.hood_metrics import hood_metrics

from eslr_jax import prepare_garment
from eslr_jax.fabric.materials import COTTON
from eslr_jax.mesh.surface import prepare_surface
from eslr_jax.simulation.scene import initial_state
from eslr_jax.terms.hood import METRIC_PARAMETERS, BodyFrames, HoodProblem, hood_terms
from eslr_jax.terms.problem import vertex_masses
from eslr_jax.types import Obstacle, Scene

TIMESTEP = 1 / 30
FRAMES = 4


@pytest.fixture(scope="module")
def worn():
    """A crumpled sheet that slides over a floor which moves too: its positions and its scene."""
    random = np.random.default_rng(0)
    rest, faces = make_sheet(5, 5, 0.05, jitter=0)
    ones = np.ones((len(rest), 1))
    garment = prepare_garment(rest, faces, skin_weights=ones, skin_indices=np.zeros_like(ones, int))
    floor, floor_faces = make_sheet(7, 7, 0.06, jitter=0)
    surface = prepare_surface(floor, floor_faces)
    floor = floor[np.asarray(surface.vertex_ids)] - [0.05, 0.0005, 0.05]
    steps = np.arange(FRAMES)[:, None, None]
    body = jnp.asarray(floor + steps * [0.002, 0.0, 0.001], jnp.float32)
    bumps = 1e-3 * random.standard_normal((FRAMES, len(rest), 3))
    positions = np.asarray(garment.rest_positions)[None].repeat(FRAMES, axis=0)
    positions[:, : len(rest)] += bumps + steps * [0.004, 0.0, 0.0]
    positions = jnp.asarray(positions, jnp.float32)
    scene = Scene(
        garment=jax.tree.map(jnp.asarray, garment),
        material=COTTON,
        timestep=jnp.float32(TIMESTEP),
        initial_state=initial_state(positions[0], jnp.zeros_like(positions[0])),
        body=Obstacle(surface, body),
        pin_targets=None,
        terms=(),
        num_frames=FRAMES,
    )
    return positions, scene


@pytest.mark.slow
def test_metrics_of_a_trajectory_are_those_of_its_frames(worn):
    positions, scene = worn
    body, faces = scene.body.positions, scene.body.surface.faces
    found = jax.jit(hood_metrics)(positions, scene)

    @jax.jit
    def of_frame(position, current, previous, bodies):
        problem = HoodProblem(
            current, previous, bodies, scene.garment, scene.material, TIMESTEP, METRIC_PARAMETERS
        )
        return hood_terms(position, problem, criterion="metric")

    for k in range(FRAMES - 2):
        bodies = BodyFrames(*body[k : k + 3], faces)
        terms = of_frame(positions[k + 2], positions[k + 1], positions[k], bodies)
        for name, value in terms.items():
            np.testing.assert_allclose(found[name][k], value, rtol=1e-4, err_msg=name)
        assert terms["collision"] > 0


@pytest.mark.slow
def test_heights_count_from_the_origin(worn):
    positions, scene = worn
    lower = np.array([0.0, -0.5, 0.0], np.float32)
    found, shifted = (jax.jit(hood_metrics)(positions, scene, origin=origin) for origin in (0 * lower, lower))
    weight = 9.81 * float(jnp.sum(vertex_masses(scene.garment, scene.material)))
    np.testing.assert_allclose(shifted["gravity"] - found["gravity"], 0.5 * weight, rtol=1e-4)
    np.testing.assert_allclose(shifted["stretch"], found["stretch"], rtol=1e-2)


def test_a_scene_without_a_body_is_refused(worn):
    positions, scene = worn
    with pytest.raises(ValueError, match="body"):
        hood_metrics(positions, scene.replace(body=None))
