"""A training run as a folder: configuration, trainer, metrics."""
