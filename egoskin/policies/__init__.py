"""A trained policy as a file."""
