"""One frame, and rollouts of many: the jitted kernels."""
