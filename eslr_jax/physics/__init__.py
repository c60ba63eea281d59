"""Energies of cloth, one a file; their sum, its minimisers, and how far an answer is from the minimum.

Two sets of energies: `potential` (set `consistent`, the default) and `hood` (HOOD's published losses, for
tables); the table in `potential` shows them side by side. `newton`, `hessian` and `validate` run on the host.
"""
