"""Broken garment files: always one named line, never a traceback, a hang, a flood of memory or a file."""

import io
import json
import pickle
import re
import struct

import numpy as np
import pytest
from garment_bytes import FACES, POSITIONS, READERS, whole_file
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eslr_jax.errors import EslrError


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return {kind: whole_file(kind, tmp_path_factory.mktemp("whole")) for kind in READERS}


def npz(**arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def pkl(**entry):
    return pickle.dumps({"scarf": entry})


def gltf(change):
    def apply(data):
        length = struct.unpack_from("<I", data, 12)[0]
        content = json.loads(data[20 : 20 + length])
        change(content)
        text = json.dumps(content).encode()
        text += b" " * (-len(text) % 4)
        rest = data[20 + length :]
        head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
        return head + text + rest

    return apply


def half(data):
    return data[: len(data) // 2]


FITTED = dict(
    rest_positions=POSITIONS, faces=FACES, skin_weights=np.ones((5, 1)), skin_indices=np.zeros((5, 1), int)
)
BROKEN = [
    ("obj", lambda data: b"", "empty mesh"),
    ("obj", lambda data: data.replace(b"0.25", b"zero"), "can't be read"),
    ("obj", lambda data: data.replace(b"f 1/1 2/2 3/3", b"f 1/1 2/2"), "a face of 2 vertices"),
    ("obj", lambda data: data.replace(b"5/5/5", b"55/5/5"), "outside 0..4"),
    ("obj", lambda data: data.replace(b"f 1/1", b"f x/1"), "can't be read"),
    ("obj", lambda data: data.replace(b"v 0.5 0.0 0.0", b"v 0.5 0.0"), "can't be read"),
    ("obj", lambda data: data.replace(b"0.125", b"nan"), "not finite"),
    ("ply", half, "can't be read|triangle"),
    ("ply", lambda data: b"", "can't be read"),
    ("ply", lambda data: data.replace(b"element vertex 5", b"element vertex 9999999999"), "impossible header"),
    ("ply", lambda data: data.replace(b"element vertex", b"element corner"), "can't be read|empty|triangle"),
    ("text.ply", lambda data: data.replace(b"0.25", b"much"), "can't be read"),
    ("text.ply", lambda data: data.replace(b"3 3 2 4", b"3 3 2 9"), "outside 0..4|can't be read"),
    ("stl", lambda data: data[:60], "can't be read"),
    ("stl", lambda data: data[:80] + b"\xff\xff\xff\x7f" + data[84:], "can't be read"),
    ("stl", lambda data: b"", "can't be read|empty"),
    ("stl", lambda data: data[:96] + b"\x00\x00\xc0\x7f" + data[100:], "not finite"),
    ("text.stl", lambda data: data.replace(b"vertex", b"corner"), "can't be read|empty"),
    ("text.stl", lambda data: data.replace(b"vertex 0.25", b"vertex two"), "can't be read"),
    ("glb", half, "truncated"),
    ("glb", lambda data: b"glTF", "can't be read"),
    ("glb", lambda data: data.replace(b"glTF", b"GLTF"), "no glTF"),
    ("glb", gltf(lambda g: g["accessors"][0].update(count=10**9)), "more than the file holds"),
    ("glb", gltf(lambda g: g["buffers"][0].update(uri="http://example.org/x")), "refers to other files"),
    ("glb", gltf(lambda g: g.pop("meshes")), "can't be read|empty"),
    ("glb", gltf(lambda g: g["meshes"][0]["primitives"][0]["attributes"].pop("POSITION")), "can't be read|empty"),
    ("npz", half, "truncated"),
    ("npz", lambda data: npz(points=POSITIONS, faces=FACES), "it needs faces and"),
    ("npz", lambda data: npz(positions=POSITIONS, faces=FACES.astype(float)), "integer vertex indices"),
    ("npz", lambda data: npz(positions=POSITIONS[:, :2], faces=FACES), "vertices, 3"),
    ("npz", lambda data: npz(positions=POSITIONS, faces=FACES + 9), "outside 0..4"),
    ("npz", lambda data: npz(positions=np.array([{}, 1], object), faces=FACES), "impossible header"),
    ("pkl", half, "can't be read as a pickle"),
    ("pkl", lambda data: pickle.dumps([1, 2]), "no garments by name"),
    ("pkl", lambda data: pickle.dumps({"a": {}, "b": {}}), "name one, as in"),
    ("pkl", lambda data: pkl(faces=FACES), "no array rest_pos"),
    ("pkl", lambda data: pkl(rest_pos=POSITIONS, faces=FACES, node_type=np.zeros(4)), "4 node_types for 5"),
    ("pkl", lambda data: pkl(rest_pos=POSITIONS.astype("U9"), faces=FACES), "no array rest_pos"),
    ("pkl", lambda data: pkl(rest_pos=POSITIONS, faces=FACES * 7), "outside 0..4"),
    ("fitted.npz", half, "truncated"),
    ("fitted.npz", lambda data: npz(rest_positions=POSITIONS), "lacks faces, skin_weights"),
    ("fitted.npz", lambda data: npz(**FITTED | {"skin_weights": np.ones((4, 1))}), "skin_weights is"),
    ("fitted.npz", lambda data: npz(**FITTED, sewn_positions=POSITIONS[:3]), "sewn_positions is"),
    ("fitted.npz", lambda data: npz(**FITTED, face_parts=np.array([0, 1, 2])), "names 2 of 0 parts"),
    ("fitted.npz", lambda data: npz(**FITTED, metadata=np.array("{")), "damaged metadata"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "spoil", "message"), BROKEN)
def test_broken_files_are_named_in_one_line(tmp_path, whole, kind, spoil, message):
    path = tmp_path / f"broken.{kind.rpartition('.')[2]}"
    path.write_bytes(spoil(whole[kind]))
    assert path.read_bytes() != whole[kind]
    with pytest.raises(EslrError) as caught:
        READERS[kind](path)
    text = str(caught.value)
    assert re.search(message, text), text
    assert "broken" in text or "scarf" in text
    assert "\n" not in text
    assert list(tmp_path.iterdir()) == [path]


def test_every_format_has_five_broken_files():
    kinds = [kind for kind, _, _ in BROKEN]
    formats = ("obj", "ply", "stl", "glb", "pkl")
    assert min(sum(kind.endswith(suffix) for kind in kinds) for suffix in formats) >= 5
    assert min(kinds.count("npz"), kinds.count("fitted.npz")) >= 5


def test_whole_files_are_read(tmp_path, whole):
    for kind, content in whole.items():
        path = tmp_path / f"whole.{kind.rpartition('.')[2]}"
        path.write_bytes(content)
        READERS[kind](path)


NUMBERS = [b"-1", b"1e999", b"nan", b"9" * 14, b"\xff" * 4, b"\xff" * 8, b"\x00" * 8, b"{", b'"']


@st.composite
def mutated(draw, content):
    """Return content with a few bytes changed, cut out, doubled, or replaced by numbers that bite."""
    data = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, len(data)))
        span = draw(st.integers(1, 64))
        kind = draw(st.sampled_from(["flip", "cut", "double", "insert", "number", "truncate"]))
        if kind == "flip" and place < len(data):
            data[place] ^= 1 << draw(st.integers(0, 7))
        elif kind == "cut":
            del data[place : place + span]
        elif kind == "double":
            data[place:place] = data[place : place + span]
        elif kind == "insert":
            data[place:place] = draw(st.binary(min_size=1, max_size=16))
        elif kind == "number":
            number = draw(st.sampled_from(NUMBERS))
            data[place : place + len(number)] = number
        elif kind == "truncate":
            del data[place:]
    return bytes(data)


def read_mutated(kind, whole, folder, examples):
    seen = []

    @settings(
        max_examples=examples, deadline=10_000, database=None, derandomize=True,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(mutated(whole[kind]))
    def check(content):
        path = folder / f"mutated.{kind.rpartition('.')[2]}"
        path.write_bytes(content)
        try:
            READERS[kind](path)
        except EslrError as error:
            seen.append(str(error))
        assert not seen or "\n" not in seen[-1]
        assert list(folder.iterdir()) == [path]

    check()
    assert seen  # some mutations do harm


@pytest.mark.filterwarnings("ignore:overflow|invalid value:RuntimeWarning")
@pytest.mark.parametrize("kind", list(READERS))
def test_mutated_files_give_named_errors(tmp_path, whole, kind):
    read_mutated(kind, whole, tmp_path, 50)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:overflow|invalid value:RuntimeWarning")
@pytest.mark.parametrize("kind", list(READERS))
def test_two_thousand_mutated_files_give_named_errors_within_2_gb(tmp_path, whole, kind):
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read_mutated(kind, whole, tmp_path, 2000)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2 << 20  # kilobytes
