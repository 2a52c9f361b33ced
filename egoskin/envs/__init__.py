"""Batched environments: physics, throws, rewards and non-sensor observations."""
