"""How good a trajectory or a model is: metrics, excess, referee, hard cases, reports."""
