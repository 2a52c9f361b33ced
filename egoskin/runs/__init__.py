"""Training runs: run folder, configuration, trainer and metrics."""
