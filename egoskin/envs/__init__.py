"""Batched environments: physics, throws, rewards. No sensor and no observation."""
