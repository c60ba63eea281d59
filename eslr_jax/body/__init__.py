"""Rigged bodies: skinning in JAX; motions and retargeting on the host."""
