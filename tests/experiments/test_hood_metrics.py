"""HOOD's measures of a whole trajectory, against its losses frame by frame."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment, make_sheet
from hard_cases.build import make_scene
from paper.hood_metrics import hood_metrics

from eslr_jax.terms.hood import METRIC_PARAMETERS, BodyFrames, HoodProblem, hood_terms
from eslr_jax.terms.term import vertex_masses

FRAMES = 4


@pytest.fixture(scope="module")
def worn():
    """A crumpled sheet that slides over a floor which moves too: its positions and its scene."""
    rest, faces = make_sheet(5, 5, 0.05, jitter=0)
    floor, floor_faces = make_sheet(7, 7, 0.06, jitter=0)
    steps = np.arange(FRAMES)[:, None, None]
    track = floor - [0.05, 0.0005, 0.05] + steps * [0.002, 0.0, 0.001]
    bumps = 1e-3 * np.random.default_rng(0).standard_normal((FRAMES, len(rest), 3))
    positions = jnp.asarray(rest + bumps + steps * [0.004, 0.0, 0.0], jnp.float32)
    moving = {"body": (track[0], floor_faces), "body_positions": track}
    return positions, make_scene(make_garment(rest, faces), positions[0], FRAMES, **moving)


@pytest.mark.slow
def test_metrics_of_a_trajectory_are_those_of_its_frames(worn):
    positions, scene = worn
    body, faces = scene.body.positions, scene.body.surface.faces
    found = jax.jit(hood_metrics)(positions, scene)

    @jax.jit
    def of_frame(position, current, previous, bodies):
        problem = HoodProblem(
            current, previous, bodies, scene.garment, scene.material, scene.timestep, METRIC_PARAMETERS
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
