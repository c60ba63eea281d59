"""An energy of a user's own, in a module that can be imported."""

from flax import struct

from eslr_jax.terms import Term


@struct.dataclass
class Push(Term):
    """A steady push along x."""

    name = "push"
    on = "vertices"

    pressure: float

    def corner_energies(self, corners, problem, data):
        return -self.pressure * problem.garment.vertex_areas * corners[0][0]
