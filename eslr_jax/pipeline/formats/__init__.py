"""Read and write files, one format per module; a file is written whole or not at all."""
