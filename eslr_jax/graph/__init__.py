"""A frame as a graph: features, normalisers, gathers and sums. Only this room and `models` import jraph."""
