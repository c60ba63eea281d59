"""Impossible materials, constants and timesteps are refused by name."""

import numpy as np
import pytest
from cloth import make_garment, make_sheet
from jax import numpy as jnp

from eslr_jax import ConfigError, Material, scene_terms
from eslr_jax.fabric.materials import COTTON, fabric_material
from eslr_jax.fabric.validate import MATERIAL_RANGES, validate_material, validate_timestep
from eslr_jax.networks.features import LAME_LAMBDA_RANGE, LAME_MU_RANGE
from eslr_jax.terms import Air, Collision, Damping, Gravity
from eslr_jax.terms.stretch import contact_excess

TERMS = (*scene_terms(), Air((0.0, 0.0, 0.0)), Damping(0.01))
CONSTANTS = [(term, field) for term in TERMS for field in term.ranges]


def test_defaults_and_the_ends_of_the_training_ranges_are_accepted():
    validate_material(COTTON)
    for term in TERMS:
        term.check()
    for timestep in (1 / 30, 1 / 3, np.float32(1 / 60)):
        validate_timestep(timestep)
    validate_material(
        Material(
            density=np.array([0.0434, 0.7]),
            lame_mu=np.array([15909.0, 63636.0]),
            lame_lambda=np.array([3535.4, 93333.7]),
            bending_stiffness=np.array([6.37e-8, 1.314e-3]),
            thickness=4.7e-4,
        )
    )


def test_the_bounds_themselves_are_accepted_in_float32():
    for pick in (0, 1):
        validate_material(Material(**{k: np.float32(v[pick]) for k, v in MATERIAL_RANGES.items()}))
    for bound in (-100.0, 100.0):
        Air(wind=(bound, 0.0, 0.0)).check()
    with pytest.raises(ConfigError, match=r"-100\.1"):
        Air(wind=(-100.1, 0.0, 0.0)).check()


@pytest.mark.parametrize("field", list(MATERIAL_RANGES))
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, 1e12])
def test_material_out_of_range_names_field_value_and_range(field, value):
    with pytest.raises(ConfigError, match=rf"material {field} = .* give a value from .* to ") as caught:
        validate_material(COTTON.replace(**{field: value}))
    assert f"{value:.6g}" in str(caught.value)


@pytest.mark.parametrize("field", ["density", "lame_mu", "thickness"])
def test_zero_density_stiffness_or_thickness_is_refused(field):
    with pytest.raises(ConfigError, match=f"material {field} = 0;"):
        validate_material(COTTON.replace(**{field: 0.0}))


def test_a_bad_element_of_an_array_is_named():
    values = np.full(7, 0.2)
    values[5] = -0.2
    with pytest.raises(ConfigError, match=r"density\[5\] = -0.2"):
        validate_material(COTTON.replace(density=values))


def test_an_array_of_the_wrong_size_names_the_size_needed():
    garment = make_garment(*make_sheet(4, 4))
    faces, hinges, vertices = (len(part) for part in (garment.faces, garment.hinges, garment.vertex_mask))
    right = {"density": vertices, "lame_mu": faces, "thickness": faces, "bending_stiffness": hinges}
    for field, count in right.items():
        value = float(getattr(COTTON, field))
        validate_material(COTTON.replace(**{field: np.full(count, value)}), garment)
        with pytest.raises(ConfigError, match=rf"material {field} has shape \({count + 1},\).*\({count}\)"):
            validate_material(COTTON.replace(**{field: np.full(count + 1, value)}), garment)


@pytest.mark.parametrize(
    ("term", "field"), CONSTANTS, ids=[f"{one.name}-{field}" for one, field in CONSTANTS]
)
def test_constants_out_of_range_are_refused(term, field):
    for value in (-1.0, np.nan, 1e13):
        with pytest.raises(ConfigError, match=f"{term.name} {field} = "):
            term.replace(**{field: value}).check()


def test_a_constant_must_be_one_number():
    with pytest.raises(ConfigError, match=r"gravity acceleration has shape \(3,\)"):
        Gravity(np.full(3, 9.81)).check()
    with pytest.raises(ConfigError, match="is not a number"):
        Collision(thickness="thin").check()


@pytest.mark.parametrize("timestep", [0.0, -1 / 30, np.nan, 60.0])
def test_an_impossible_timestep_is_refused(timestep):
    with pytest.raises(ConfigError, match="timestep = "):
        validate_timestep(timestep)


def test_the_validator_is_light_to_import():
    import subprocess
    import sys

    code = "import sys, eslr_jax.fabric.validate; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


# --- contacts that suit the fabric --------------------------------------------------------------------------


@pytest.mark.parametrize("end", [0, 1])
def test_fabrics_that_networks_know_have_the_constants_they_were_trained_with(end):
    material = COTTON.replace(lame_mu=LAME_MU_RANGE[end], lame_lambda=LAME_LAMBDA_RANGE[end])
    assert float(contact_excess(material)) == 1.0


def test_contacts_grow_with_the_stiffest_face():
    one, double = (contact_excess(fabric_material("suiting").replace(thickness=h)) for h in (4.7e-4, 9.4e-4))
    assert one > 40
    assert double == pytest.approx(2 * float(one))
    mixed = COTTON.replace(lame_mu=jnp.array([23600.0, 1e7, 23600.0]))
    assert contact_excess(mixed) == contact_excess(COTTON.replace(lame_mu=1e7))
