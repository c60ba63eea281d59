"""Bad input is a named error before anything is compiled."""

from pathlib import Path

import numpy as np
import pytest
from draped_ball import square

from eslr_jax import MeshError, SimConfig, load_body

ANNY = Path(__file__).parents[2] / "data" / "body" / "anny_cmu.npz"


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
    with pytest.raises(ValueError, match=name):
        SimConfig(**{name: -1})


def test_an_open_body_is_refused(tmp_path):
    with np.load(ANNY) as file:
        arrays = dict(file)
    faces, is_obstacle = arrays["faces"], arrays["obstacle_faces"]
    first = int(np.argmax(is_obstacle))
    around = np.isin(faces, faces[first]).sum(axis=1) >= 2
    rest = np.arange(len(faces)) != first

    def body(**changed):
        np.savez(tmp_path / "body.npz", **arrays | changed)
        return load_body(tmp_path / "body.npz")

    body(faces=faces[rest], obstacle_faces=(is_obstacle & ~around)[rest])  # a hole where no cloth goes
    with pytest.raises(MeshError, match=r"body.npz: 3 edges have a face on one side only.* not closed"):
        body(faces=faces[rest], obstacle_faces=is_obstacle[rest])
    with pytest.raises(MeshError, match="point inside"):
        body(faces=faces[:, ::-1])
