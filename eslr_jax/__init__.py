"""Garment simulation in JAX: message passing with Laplacian smoothing, geodesic attention, physics."""

__version__ = "0.1.0"
