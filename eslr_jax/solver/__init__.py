"""The minimum of a frame's potential: guesses, solver, derivatives; and what fabrics are made of.

`validate` runs on the host.
"""
