"""Bad input is a named error before anything is compiled, or a status bit with the first bad frame."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.assets import load_body
from eslr_jax.config import SimConfig, from_dict
from eslr_jax.errors import CapacityError, ConfigError, MeshError, MotionError, Status
from eslr_jax.evaluation.hard_cases.build import icosphere, join_meshes, make_cloth, make_scene, sheet
from eslr_jax.geometry.validate import validate_body
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.rollout import check_scene, more_room, raise_for_status, rollout
from eslr_jax.simulation.scan import simulate_scene


def level_sheet(**options):
    return make_cloth(sheet(6, 6, (0.1, 0.1)), {}, **options)


def fall(config, scene):
    return simulate_scene(None, scene, PhysicsParameters(), config)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"material": COTTON.replace(density=-0.2)}, "material density = -0.2; give a value from"),
        ({"material": COTTON.replace(density=0.0)}, "material density = 0; give a value from"),
        ({"material": COTTON.replace(thickness=0.0)}, "material thickness = 0; give a value from"),
        ({"material": COTTON.replace(lame_mu=1e12)}, r"material lame_mu = 1e\+12; give a value from"),
        ({"material": COTTON.replace(density=np.ones(7))}, r"one per vertex \(36\)"),
        ({"timestep": jnp.float32(0.0)}, "timestep = 0; give a value from"),
        ({"timestep": jnp.float32(-1 / 30)}, "timestep = -0.0333333; give a value from"),
    ],
)
def test_unphysical_scenes_are_refused_by_name(changes, message):
    garment = level_sheet()
    scene = make_scene(garment, garment.rest_positions, 3).scene
    check_scene(scene, PhysicsParameters())
    with pytest.raises(ConfigError, match=message):
        check_scene(dataclasses.replace(scene, **changes), PhysicsParameters())


def test_the_front_door_checks_fabric_and_constants(tshirt, walk):
    with pytest.raises(ConfigError, match="material density = 0"):
        rollout(None, tshirt, walk, material=COTTON.replace(density=0.0))
    with pytest.raises(ConfigError, match="friction_coefficient = -1"):
        rollout(None, tshirt, walk, parameters=PhysicsParameters(friction_coefficient=-1.0))


def test_pins_are_a_mask_or_indices_of_vertices_that_exist():
    by_index = level_sheet(is_pinned=np.array([0, 35]))
    np.testing.assert_array_equal(np.flatnonzero(by_index.is_pinned), [0, 35])
    for pins in ([0, 36], [-1]):
        with pytest.raises(MeshError, match=rf"vertex {pins[-1]} can't be pinned; .* from 0 to 35"):
            level_sheet(is_pinned=np.array(pins))
    with pytest.raises(MeshError, match="one boolean per vertex, or indices"):
        level_sheet(is_pinned=np.zeros(36))


def test_self_contact_that_overflows_names_the_capacities_needed_and_gets_them():
    lower = sheet(6, 6, (0.1, 0.1))
    mesh = join_meshes(lower, (lower[0] + np.array([0.0, 0.004, 0.0]), lower[1]))
    garment = make_cloth(mesh, {}, allow_components=True)
    scene = make_scene(garment, mesh[0], 3).scene
    config = SimConfig(
        simulator="physics",
        solver_iterations=2,
        self_contact=True,
        self_contact_capacity=5,
        self_contact_cell_capacity=3,
    )
    trajectory = fall(config, scene)
    assert Status(int(trajectory.status)) == Status.SELF_CONTACT_OVERFLOW
    with pytest.raises(CapacityError, match=r"^frame 1: ") as caught:
        raise_for_status(trajectory)
    pairs, faces = map(int, re.findall(r"_capacity to at least (\d+)", str(caught.value)))
    assert pairs > 5
    assert faces > 3
    assert more_room(trajectory, SimConfig(simulator="physics", self_contact=True)) is None  # had room enough
    # Cut short, a search does not know all that it needs.
    while (larger := more_room(trajectory, config)) is not None:
        config = larger
        trajectory = fall(config, scene)
    assert Status(int(trajectory.status)) == Status.OK
    assert config.self_contact_capacity >= pairs
    assert config.self_contact_cell_capacity >= faces


@pytest.mark.parametrize("name", ["self_contact_capacity", "solver_iterations", "tolerance"])
def test_impossible_options_are_refused(name):
    with pytest.raises(ConfigError, match=name):
        from_dict(SimConfig, {name: -1})


def test_an_open_body_is_refused():
    positions, faces = icosphere(2, 0.2)
    is_obstacle = np.ones(len(faces), bool)
    validate_body(positions, faces, is_obstacle)
    with pytest.raises(MeshError, match=r"3 edges have a face on one side only.* not closed"):
        validate_body(positions, faces[1:], is_obstacle[1:])
    around = np.isin(faces, faces[0]).sum(axis=1) >= 2
    validate_body(positions, faces[1:], ~around[1:])  # a hole where no cloth goes is accepted
    with pytest.raises(MeshError, match="point inside"):
        validate_body(positions, faces[:, ::-1], is_obstacle)


def test_an_open_body_file_is_refused(tmp_path):
    from eslr_jax.assets.catalog import find_asset

    arrays = dict(np.load(find_asset("body", "anny")))
    first = int(np.argmax(arrays["obstacle_faces"]))
    for key in ("faces", "obstacle_faces"):
        arrays[key] = np.delete(arrays[key], first, axis=0)
    np.savez(tmp_path / "open.npz", **arrays)
    with pytest.raises(MeshError, match=r"open.npz: 3 edges .* not closed"):
        load_body(tmp_path / "open.npz")


def test_a_body_too_fast_for_the_contact_search_sets_the_bit():
    garment = level_sheet()
    ball = icosphere(2, 0.1)
    track = np.array([0.2, 0.2, 0.2, -0.4])[:, None, None] * np.array([0.0, -1.0, 0.0])  # up by 60 cm at last
    body_positions = ball[0] + track
    scene = make_scene(garment, garment.rest_positions, 4, body=ball, body_positions=body_positions).scene
    trajectory = fall(SimConfig(simulator="physics", solver_iterations=2), scene)
    assert Status(int(trajectory.status)) == Status.BODY_TOO_FAST
    assert int(trajectory.first_bad_frame) == 3
    with pytest.raises(MotionError, match=r"^frame 3: the body moved farther .* resample"):
        raise_for_status(trajectory)
