"""From measurements to a material, and which values are physical."""
