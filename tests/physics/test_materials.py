"""Contacts that suit the fabric."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from eslr_jax.graph.features import LAME_LAMBDA_RANGE, LAME_MU_RANGE
from eslr_jax.physics.materials import COTTON, constants_for, fabric_material
from eslr_jax.types import PhysicsConstants


@pytest.mark.parametrize("end", [0, 1])
def test_fabrics_that_networks_know_have_the_constants_they_were_trained_with(end):
    material = COTTON.replace(lame_mu=LAME_MU_RANGE[end], lame_lambda=LAME_LAMBDA_RANGE[end])
    assert jax.tree.all(jax.tree.map(np.array_equal, constants_for(material), PhysicsConstants()))


def test_contacts_grow_with_the_stiffest_face():
    one, double = (constants_for(fabric_material("suiting").replace(thickness=h)) for h in (4.7e-4, 9.4e-4))
    assert one.collision_stiffness > 40 * PhysicsConstants().collision_stiffness
    assert double.collision_stiffness == pytest.approx(2 * float(one.collision_stiffness))
    assert double.repulsion_stiffness == pytest.approx(2 * float(one.repulsion_stiffness))
    mixed = COTTON.replace(lame_mu=jnp.array([23600.0, 1e7, 23600.0]))
    assert (
        constants_for(mixed).collision_stiffness
        == constants_for(COTTON.replace(lame_mu=1e7)).collision_stiffness
    )
