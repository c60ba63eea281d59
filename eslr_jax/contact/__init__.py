"""Where cloth meets the body, and itself."""
