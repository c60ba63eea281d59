"""What is known of cloth in closed form, against what is simulated; see `__main__.py`."""
