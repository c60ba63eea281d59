"""Scenes: what a rollout models, and all that it reads."""
