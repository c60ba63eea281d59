"""Fit a garment as a program exported it to a body: units, axes, place, pose, skin, pins, penetrations."""
