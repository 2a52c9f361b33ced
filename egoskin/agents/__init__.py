"""Actor, critic and PPO; they use TensorDict keys, independent of robot and task."""
