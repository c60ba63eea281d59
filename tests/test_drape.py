"""Cusick's drape test, and fabrics from measurements."""

import numpy as np
import pytest
from commands import eslr_here, refused

from eslr_jax import ConfigError
from eslr_jax.fabric.drapes import BANDS, DRAPES
from eslr_jax.fabric.materials import WOVEN, bending_lengths, fabric_names, rigidity_of
from eslr_jax.pipeline import drape
from eslr_jax.pipeline.drape import DISC, TABLE, Fitted, Hung, disc, fit_drape, hang
from eslr_jax.pipeline.fabrics import describe_fabric

COARSE = 0.03  # [m]


def flat(spacing=0.01):
    positions, faces = disc(spacing)
    return Hung(positions, positions, faces, 0.0)


def test_disc_faces_up_and_has_the_area_of_the_rim():
    positions, faces = disc(0.01)
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    assert np.all(normals[:, 1] > 0)
    ring = np.pi * (DISC**2 - (TABLE - 0.005) ** 2)
    assert 0.5 * normals[:, 1].sum() == pytest.approx(ring, rel=0.01)


def test_coefficient_is_one_of_a_flat_disc_and_none_of_one_that_hangs_straight():
    level = flat()
    assert level.coefficient == pytest.approx(1.0, abs=0.02)
    x, z = level.flat[:, 0], level.flat[:, 2]
    radius = np.hypot(x, z)
    shrunk = np.minimum(radius, TABLE) / radius
    straight = np.stack([x * shrunk, TABLE - np.maximum(radius, TABLE), z * shrunk], axis=1)
    assert level._replace(positions=straight).coefficient < 0.01


def test_stiffer_fabric_covers_more():
    soft, stiff = (
        hang(describe_fabric(f"density=0.2,flexural_rigidity={rigidity}"), spacing=COARSE, frames=31)
        for rigidity in (1e-5, 1e-4)
    )
    assert 0.3 < soft.coefficient < stiff.coefficient < 1.0


def test_bending_length_is_peirces():
    """c = (D / w)^(1/3), there and back."""
    rigidity = rigidity_of(0.021, 0.15)
    assert rigidity == pytest.approx(0.15 * 9.81 * 0.021**3)
    assert bending_lengths(WOVEN["raw-denim-woven"]) == pytest.approx((0.025, 0.025))


def test_every_fabric_has_a_drape_coefficient():
    assert set(DRAPES) == {*fabric_names(), *WOVEN}
    assert all(0 < share < 1 for share in DRAPES.values())
    assert set(BANDS) <= set(DRAPES)


@pytest.mark.parametrize("name", [name for name in WOVEN if WOVEN[name].source.startswith("class")])
def test_class_drapes_inside_the_band_of_its_kind(name):
    assert BANDS[name].low < 100 * DRAPES[name] < BANDS[name].high


def test_fitted_fabric_has_its_weight_bending_length_and_drape(monkeypatch):
    """By discs that are told: the search itself, without minutes of simulation."""
    seen = []

    def told(described, *, spacing):
        shear = described.weave.stiffness[3]
        seen.append(described)
        level = flat(COARSE)
        keep = np.sqrt(TABLE**2 + (0.6 + 0.1 * np.log10(shear)) * (DISC**2 - TABLE**2)) / DISC
        return level._replace(positions=level.flat * keep)

    monkeypatch.setattr(drape, "hang", told)
    fitted = fit_drape(0.7, 0.15, 0.021)
    assert fitted.drape == pytest.approx(0.7, abs=0.01)
    described = describe_fabric(fitted.fabric)
    assert described.sheet.density == pytest.approx(0.15, rel=1e-3)
    assert described.weave
    assert described.weave.rigidity == pytest.approx((rigidity_of(0.021, 0.15),) * 2, rel=1e-3)
    with pytest.raises(ConfigError, match="measure the bending length again"):
        fit_drape(0.3, 0.15, 0.021)
    assert {one.weave.rigidity for one in seen} == {described.weave.rigidity}


@pytest.mark.parametrize(
    ("drape", "weight", "length", "cause"),
    [
        ("0.68", "150", "2.1cm", "--weight 150: "),
        ("0.68", "150gsm", "2.1", "--bending-length 2.1: "),
        ("0.68", "150gsm", "21cm", "between 0.006 and 0.1 m"),
        ("68", "150gsm", "2.1cm", "--drape 68: write it such as 0.68 or 68%"),
        ("nan", "150gsm", "2.1cm", "--drape nan"),
    ],
)
def test_measurement_that_is_none_is_refused_at_once(drape, weight, length, cause):
    refused(eslr_here("fabric", "--drape", drape, "--weight", weight, "--bending-length", length), cause)


def test_fabric_of_measurements_is_printed_as_other_commands_take_it(monkeypatch):
    monkeypatch.setattr(
        drape,
        "fit_drape",
        lambda *measured: Fitted(
            f"density={measured[1]:g},flexural_rigidity=1e-5", 0.68, (3, 300), (0.6, 0.8)
        ),
    )
    done = eslr_here("fabric", "--drape", "68%", "--weight", "0.15kg/m2", "--bending-length", "21mm")
    first, *others = done.stdout.splitlines()
    assert describe_fabric(first).sheet.density == pytest.approx(0.15)
    assert any(line.startswith("free: ") for line in others)
