"""Collection: what an agent meets in an environment, as PPO needs it.

Contract: a rollout keeps the values it bootstraps from, not the next observations;
the value of a time-out is taken from the terminal observation, before the reset; and
what a row meets does not depend on how many workers there are.
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
    """Step an environment with an agent; return what PPO needs.

    Args:
        env: Batched environment; its batch ``[*B]`` is flattened to ``N`` rows.
        agent: Chooses the actions, on its own device.
        root: Tensordict to start from.
        num_steps: Number of steps ``T``.
        info_keys: What else to keep of what the environment says, for metrics.
        noise_correlation: Of the noise with that of the step before.

    Returns:
        The rollout ``[T, N]`` with the agent's ``inputs``, what it normalises, and
        ``action``, ``action_log_prob``, ``loc``, ``scale``, ``state_value``,
        ``next_state_value``, ``reward``, ``done``, ``terminated``, on its device; the
        tensordict to go on from; and for each step the entries asked for.
    """
    device = agent.head.log_std.device
    shape = (num_steps, root.numel(), len(agent.head.log_std))
    noise = correlated_noise(shape, noise_correlation, device)
    frames, ended, infos = [], [], []
    for now in noise:
        frame = _act(agent, _readable(agent, root), now)
        root["action"] = frame["action"].reshape(*root.batch_size, -1).to(root.device)
        step, root = env.step_and_maybe_reset(root)
        after = step["next"].reshape(-1)
        for key in ("reward", "done", "terminated"):
            frame[key] = after[key].to(device)
        frames.append(frame)
        ended.append(_readable(agent, after)[_timed_out(after)])
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
    shape: tuple[int, int, int], correlation: float, device: torch.device | None = None
) -> Tensor:
    """Return standard normal noise, ``[T, N, J]``, that goes on from step to step.

    Each step's action is distributed as with white noise, and has that
    log-probability: what is learnt is what a shift that lasts as long would do.

    Args:
        shape: Steps, rows, actions.
        correlation: With the noise of the step before; 0 is white.
        device: Device that draws it, with a generator of its own.
    """
    noise = torch.randn(shape, device=device)
    if correlation:
        # AR(1), whose variance stays 1.
        noise[1:] *= (1 - correlation**2) ** 0.5
        for before, after in zip(noise, noise[1:], strict=False):
            after.add_(before, alpha=correlation)
    return noise


def _act(agent: Agent, state: TensorDictBase, noise: Tensor) -> TensorDict:
    """Return what an agent reads of a state ``[n]``, and its noisy actions.

    That is ``inputs``, what it normalises, ``loc``, ``scale``, ``action`` and
    ``action_log_prob``.
    """
    features = _sense(agent, state)
    frame = agent.encode(features)
    inputs = (frame[key] for key in input_keys(agent.actor_keys))
    frame["loc"], frame["scale"] = agent.head(*inputs)
    frame["action"] = frame["loc"] + frame["scale"] * noise
    likelihood = agent.actor.build_dist_from_params(frame)
    frame["action_log_prob"] = likelihood.log_prob(frame["action"])
    # For the statistics.
    return frame.update(features.select(*agent.norms))


def _readable(agent: Agent, root: TensorDictBase) -> TensorDictBase:
    """Return what an agent's senses read of an environment's output, ``[n]``."""
    return root.select(*agent.read_keys).reshape(-1)


def _sense(agent: Agent, state: TensorDictBase) -> TensorDict:
    """Return what the agent's networks read of a state ``[n]``, on its device."""
    return agent.sense(state.to(agent.head.log_std.device))


def _value(agent: Agent, state: TensorDictBase) -> Tensor:
    """Return the values of a state ``[n]``, ``[n, 1]``."""
    return agent.critic(agent.encode(_sense(agent, state)))["state_value"]


def _timed_out(steps: TensorDictBase) -> Tensor:
    """Return which rows ended without termination, ``[*B]`` bool."""
    return (steps["done"] & ~steps["terminated"])[..., 0]


def _joined(frames: Sequence[TensorDict]) -> TensorDict:
    """Return frames ``[n]`` one after the other, ``[N]``."""
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
