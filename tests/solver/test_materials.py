"""Contacts that suit the fabric."""

import pytest
from jax import numpy as jnp

from eslr_jax.fabric.materials import COTTON, fabric_material
from eslr_jax.networks.features import LAME_LAMBDA_RANGE, LAME_MU_RANGE
from eslr_jax.terms.stretch import contact_excess


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
