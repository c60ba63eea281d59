"""A frame as a graph: features, normalisers, jraph (the only room that imports it beside models)."""
