"""Garments as meshes: topology, validation, padding, geodesic embedding."""
