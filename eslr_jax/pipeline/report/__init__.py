"""How good a trajectory or a model is: metrics, optimality gap, reports."""
