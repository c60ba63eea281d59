"""Broken garment files: always one named line, never a traceback, a hang, a flood of memory or a file."""

import io
import json
import pickle
import re
import struct

import numpy as np
import pytest
from garment_bytes import FACES, POSITIONS, READERS, whole_file

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
    ("glb", lambda data: data.replace(b"glTF", b"GLTF"), "can't be read"),
    ("glb", gltf(lambda g: g["accessors"][0].update(count=10**9)), "1000000000 values in a view"),
    ("glb", gltf(lambda g: g["buffers"][0].update(uri="http://example.org/x")), "not beside it"),
    ("glb", gltf(lambda g: g.pop("meshes")), "meshes 0, which it doesn't have"),
    ("glb", gltf(lambda g: g["meshes"][0]["primitives"][0]["attributes"].pop("POSITION")), "accessors None"),
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


def test_whole_files_are_read(tmp_path, whole):
    for kind, content in whole.items():
        path = tmp_path / f"whole.{kind.rpartition('.')[2]}"
        path.write_bytes(content)
        READERS[kind](path)
