"""Bad input is a named error before anything is compiled."""

import numpy as np
import pytest
from draped_ball import ball, square

from eslr_jax import ConfigError, MeshError, SimConfig, load_body
from eslr_jax.config import from_dict
from eslr_jax.mesh.validate import validate_body


def test_pins_are_a_mask_or_indices_of_vertices_that_exist():
    by_index = square(6, is_pinned=np.array([0, 35]))
    np.testing.assert_array_equal(np.flatnonzero(by_index.is_pinned), [0, 35])
    for pins in ([0, 36], [-1]):
        with pytest.raises(MeshError, match=rf"vertex {pins[-1]} can't be pinned; .* from 0 to 35"):
            square(6, is_pinned=np.array(pins))
    with pytest.raises(MeshError, match="one boolean per vertex, or indices"):
        square(6, is_pinned=np.zeros(36))


@pytest.mark.parametrize("name", ["iterations", "tolerance", "memory"])
def test_impossible_options_are_refused(name):
    with pytest.raises(ConfigError, match=name):
        from_dict(SimConfig, {name: -1})


def test_an_open_body_is_refused():
    positions, faces = ball()
    is_obstacle = np.ones(len(faces), bool)
    validate_body(positions, faces, is_obstacle)
    with pytest.raises(MeshError, match=r"3 edges have a face on one side only.* not closed"):
        validate_body(positions, faces[1:], is_obstacle[1:])
    around = np.isin(faces, faces[0]).sum(axis=1) >= 2
    validate_body(positions, faces[1:], ~around[1:])  # a hole where no cloth goes is accepted
    with pytest.raises(MeshError, match="point inside"):
        validate_body(positions, faces[:, ::-1], is_obstacle)


def test_an_open_body_file_is_refused(tmp_path):
    from eslr_jax.pipeline.assets.catalog import find_asset

    arrays = dict(np.load(find_asset("body", "anny")))
    first = int(np.argmax(arrays["obstacle_faces"]))
    for key in ("faces", "obstacle_faces"):
        arrays[key] = np.delete(arrays[key], first, axis=0)
    np.savez(tmp_path / "open.npz", **arrays)
    with pytest.raises(MeshError, match=r"open.npz: 3 edges .* not closed"):
        load_body(tmp_path / "open.npz")
