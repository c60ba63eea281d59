"""Bodies in motion as arrays: skinning, joints, timing."""
