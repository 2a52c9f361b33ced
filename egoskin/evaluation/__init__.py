"""Evaluation of policies on held-out throws, and of the visibility of a skin."""
