"""Fit a garment from another program to a body: unit, axes, place, pose, skin weights, pins, penetrations."""
