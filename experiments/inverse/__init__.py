"""What gradients find, and how far they are off: `python experiments/inverse SCRIPT`."""
