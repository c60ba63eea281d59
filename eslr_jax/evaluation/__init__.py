"""How good a trajectory or a model is: metrics, gap, referee, hard cases, reports."""
