"""Archives of arrays, and files that are written whole or not at all."""
