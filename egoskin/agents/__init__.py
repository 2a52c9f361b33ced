"""Actor, critic and PPO. They know TensorDict keys and nothing of robots or tasks."""
