"""Bodies of files: rigs, alignment, sequences, clothing."""
