"""Train Stable-Baselines3's PPO on the dodgeball task, with many robots at once.

python scripts/train_sb3.py --seconds 60        (needs `pip install stable-baselines3`)

Stable-Baselines3 has its own interface for vector environments; `Robots` adapts
Gymnasium's to it. A single robot needs no adapter:
``PPO("MlpPolicy", gymnasium.make(ENV_ID))``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecEnv, VecMonitor  # pyright: ignore[reportMissingImports]

from egoskin.gym import ENV_ID


class Robots(VecEnv):
    """Adapter from Gymnasium's vector environments to Stable-Baselines3's.

    Args:
        envs: Gymnasium's vector environment.
    """

    def __init__(self, envs: gymnasium.vector.VectorEnv) -> None:
        self._envs = envs
        super().__init__(
            envs.num_envs, envs.single_observation_space, envs.single_action_space
        )

    def reset(self) -> np.ndarray:
        """Return the first observations, ``[num_envs, N]``."""
        observations, _ = self._envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Return observations, rewards, ends and infos of the step."""
        observations, rewards, terminated, truncated, last_infos = self._envs.step(
            self._actions
        )
        done, infos = terminated | truncated, [{} for _ in range(self.num_envs)]
        for row in done.nonzero()[0]:
            infos[row] = {
                "terminal_observation": last_infos["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
            }
        return observations, rewards, done, infos

    def close(self) -> None:
        """Stop the worker processes."""
        self._envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute that all robots share, once for each."""
        value = getattr(self._envs, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise AttributeError: robots have no attributes or methods of their own."""
        raise AttributeError(attr_name)

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """Raise AttributeError: robots have no attributes or methods of their own."""
        raise AttributeError(method_name)

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for each robot."""
        return [False for _ in self._get_indices(indices)]


class Until(BaseCallback):
    """Ends training after a given time.

    Args:
        seconds: Training time [s].
    """

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self._seconds = seconds

    def _on_training_start(self) -> None:
        # The worker processes are running by now.
        self._begin = time.monotonic()

    def _on_step(self) -> bool:
        self.spent = time.monotonic() - self._begin
        return self.spent < self._seconds


def main(args: Sequence[str] | None = None) -> PPO:
    """Train a policy and return it."""
    parser = argparse.ArgumentParser(description="Train with Stable-Baselines3.")
    parser.add_argument("--num-envs", type=int, default=256, help="robots")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to train")
    parser.add_argument("--save", help="file to write the policy to")
    options = parser.parse_args(args)
    envs = VecMonitor(Robots(gymnasium.make_vec(ENV_ID, options.num_envs)))
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=16,
        batch_size=options.num_envs * 4,
        n_epochs=5,
        seed=0,
        device="cpu",
    )
    until = Until(options.seconds)
    try:
        model.learn(10**9, callback=until)
    finally:
        envs.close()
    speed = model.num_timesteps / until.spent
    lengths = [episode["l"] for episode in model.ep_info_buffer or ()]
    print(
        f"{model.num_timesteps:,} environment steps, {speed:,.0f} each second; "
        f"the last {len(lengths)} episodes lasted {np.mean(lengths):.0f} steps"
    )
    if options.save is not None:
        model.save(options.save)
    return model


if __name__ == "__main__":
    main()
