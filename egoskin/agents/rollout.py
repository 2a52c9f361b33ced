"""Collection of rollouts for PPO.

Contract: a rollout keeps the values used for bootstrapping, not the next observations.
The value of a time-out is that of the terminal observation, before the reset. The
content of a row does not depend on the number of workers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NonTensorData, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from egoskin.agents.networks import Agent, input_keys
from egoskin.sparse import SparseRows


@torch.no_grad()
def collect(
    env: EnvBase,
    agent: Agent,
    root: TensorDictBase,
    num_steps: int,
    info_keys: Sequence[str] = (),
    noise_correlation: float = 0.0,
) -> tuple[TensorDict, TensorDictBase, list[TensorDict]]:
    """Step an environment with an agent; return a rollout for PPO.

    Args:
        env: Batched environment; its batch ``[*B]`` is flattened to ``N`` rows.
        agent: Agent that chooses the actions, on its own device.
        root: Tensordict to start from.
        num_steps: Number of steps ``T``.
        info_keys: Further keys of the environment to return, for metrics.
        noise_correlation: Correlation of the noise between consecutive steps.

    Returns:
        The rollout ``[T, N]`` on the agent's device, with the agent's ``inputs``, the
        features that it normalises, ``action``, ``action_log_prob``, ``loc``,
        ``scale``, ``state_value``, ``next_state_value``, ``reward``, ``done``,
        ``terminated``; the tensordict to continue from; and the entries of
        ``info_keys`` for each step.
    """
    device = agent.head.log_std.device
    shape = (num_steps, root.numel(), len(agent.head.log_std))
    noise = correlated_noise(shape, noise_correlation, device)
    frames, ended, infos = [], [], []
    for step_noise in noise:
        frame = _act(agent, _readable(agent, root), step_noise)
        root["action"] = frame["action"].reshape(*root.batch_size, -1).to(root.device)
        step, root = env.step_and_maybe_reset(root)
        after = step["next"].reshape(-1)
        for key in ("reward", "done", "terminated"):
            frame[key] = after[key].to(device)
        frames.append(frame)
        # Indices, because a mask would be searched again for each key.
        ended.append(_readable(agent, after)[_timed_out(after).nonzero()[:, 0]])
        infos.append(after.select(*info_keys))
    rollout = agent.critic(_joined(frames)).reshape(shape[:2])
    following = _value(agent, _readable(agent, root))
    next_value = torch.cat((rollout["state_value"][1:], following[None]))
    timed_out = torch.cat(ended)
    assert isinstance(timed_out, TensorDict)
    if len(timed_out):
        next_value[_timed_out(rollout)] = _value(agent, timed_out)
    rollout["next_state_value"] = next_value
    return rollout, root, infos


def correlated_noise(
    shape: tuple[int, int, int], correlation: float, device: torch.device
) -> Tensor:
    """Return standard normal noise that is correlated in time, ``[T, N, J]``.

    PPO then learns the effect of an action shift that lasts several steps. The noise of
    each step alone is distributed as white noise, but not given the state, which
    contains the effect of the noise before: ``action_log_prob``, computed as for white
    noise, is not the density of the behaviour, and PPO's ratio is an approximation.

    Args:
        shape: Steps, rows, actions.
        correlation: Correlation with the noise of the previous step; 0 is white noise.
        device: Device that draws the noise, with its own generator.
    """
    noise = torch.randn(shape, device=device)
    if correlation:
        # AR(1) process with variance 1.
        noise[1:] *= (1 - correlation**2) ** 0.5
        for before, after in zip(noise, noise[1:], strict=False):
            after.add_(before, alpha=correlation)
    return noise


def _act(agent: Agent, state: TensorDictBase, noise: Tensor) -> TensorDict:
    """Return an agent's inputs and noisy actions for a state ``[n]``.

    The entries are ``inputs``, the features that the agent normalises, ``loc``,
    ``scale``, ``action`` and ``action_log_prob``.
    """
    features = _sense(agent, state)
    frame = agent.encode(features)
    inputs = (frame[key] for key in input_keys(agent.actor_keys))
    frame["loc"], frame["scale"] = agent.head(*inputs)
    frame["action"] = frame["loc"] + frame["scale"] * noise
    likelihood = agent.actor.build_dist_from_params(frame)
    frame["action_log_prob"] = likelihood.log_prob(frame["action"])
    # For the statistics of the normalisers.
    return frame.update(features.select(*agent.norms))


def _readable(agent: Agent, root: TensorDictBase) -> TensorDictBase:
    """Return the environment output that `Agent.sense` reads, ``[n]``."""
    return root.select(*agent.read_keys).reshape(-1)


def _sense(agent: Agent, state: TensorDictBase) -> TensorDict:
    """Return the features of a state ``[n]``, on the agent's device."""
    return agent.sense(state.to(agent.head.log_std.device))


def _value(agent: Agent, state: TensorDictBase) -> Tensor:
    """Return the values of a state ``[n]``, ``[n, 1]``."""
    return agent.critic(agent.encode(_sense(agent, state)))["state_value"]


def _timed_out(steps: TensorDictBase) -> Tensor:
    """Return which rows ended without termination, ``[*B]`` bool."""
    return (steps["done"] & ~steps["terminated"])[..., 0]


def _joined(frames: Sequence[TensorDict]) -> TensorDict:
    """Return concatenated frames ``[n]``, as ``[N]``."""
    if len(frames) == 1:
        return frames[0]
    joined = TensorDict(batch_size=[sum(map(len, frames))], device=frames[0].device)
    for key, value in frames[0].items(True):
        parts: list[Any] = [frame[key] for frame in frames]
        if isinstance(value, NonTensorData):
            joined.set_non_tensor(key, SparseRows.cat(parts))
        elif isinstance(value, Tensor):
            joined[key] = torch.cat(parts)
    return joined
