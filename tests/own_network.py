"""A network of a user's own, in a module that can be imported."""

from flax import linen as nn

from eslr_jax.networks.network import System, network
from eslr_jax.solver.guess import initial_guess


@network("nudge")
class Nudge(nn.Module, System):
    """Moves the solver's own guess by what it learns of the velocity."""

    width: int = 8

    @nn.compact
    def __call__(self, problem, state):
        rows = nn.tanh(nn.Dense(self.width)(state.velocity))
        return initial_guess(problem).position + 1e-3 * nn.Dense(3)(rows)
