"""Proximal policy optimisation: collection, advantages, update.

Contract: a rollout keeps the values it bootstraps from, not the next observations;
the value of a time-out is taken from the terminal observation, before the reset.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from egoskin.agents.networks import Agent, NetworkConfig, RunningNorm

# Adaptive learning rate (Unitree's and other humanoid codes): bounds and factor.
_LR_BOUNDS, _LR_FACTOR = (1e-5, 1e-2), 1.5
# The divergence is estimated on this many frames of each minibatch.
_KL_FRAMES = 4096


class NonFiniteError(RuntimeError):
    """A loss, gradient or weight is not finite; the agent must not be saved.

    Args:
        text: What is not finite.
        batch: The data it was met on.
    """

    def __init__(self, text: str, batch: TensorDictBase) -> None:
        super().__init__(text)
        self.batch: dict[str, Tensor] = dict(batch.items())


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Networks and PPO."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Size and initialisation of actor and critic."""
    rollout_steps: int = 16
    """Control steps each agent collects for one update."""
    ppo_epochs: int = 5
    """Passes over a rollout."""
    num_mini_batches: int = 4
    """Minibatches in each pass."""
    gamma: float = 0.99
    """Discount for each control step."""
    gae_lambda: float = 0.95
    """Decay of the generalised advantage estimate."""
    clip_epsilon: float = 0.2
    """Clip range of the probability ratio."""
    entropy_coeff: float = 0.0
    """Weight of the entropy bonus."""
    critic_coeff: float = 1.0
    """Weight of the value loss."""
    learning_rate: float = 1e-3
    """Adam's learning rate at the start."""
    desired_kl: float | None = 0.01
    """Adapt the learning rate to this divergence of an update; None keeps it."""
    max_grad_norm: float = 1.0
    """Gradient norm to clip at, for actor and critic separately."""

    def __post_init__(self) -> None:
        """Raise ValueError for values outside their ranges."""
        positive = (
            "rollout_steps",
            "ppo_epochs",
            "num_mini_batches",
            "clip_epsilon",
            "learning_rate",
            "max_grad_norm",
        )
        for name in positive:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("gamma", "gae_lambda"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(
                    f"{name} must be between 0 and 1, got {getattr(self, name)}"
                )
        if self.desired_kl is not None and self.desired_kl <= 0:
            raise ValueError(f"desired_kl must be positive, got {self.desired_kl}")


@torch.no_grad()
def collect(
    env: EnvBase,
    agent: Agent,
    root: TensorDictBase,
    num_steps: int,
    info_keys: Sequence[str] = (),
) -> tuple[TensorDict, TensorDictBase, list[TensorDict]]:
    """Step an environment with an agent; return what PPO needs.

    Args:
        env: Batched environment; its batch ``[*B]`` is flattened to ``N`` rows.
        agent: Chooses the actions, on its own device.
        root: Tensordict to start from.
        num_steps: Number of steps ``T``.
        info_keys: What else to keep of what the environment says, for metrics.

    Returns:
        The rollout ``[T, N]`` with the agent's keys, ``action``, ``action_log_prob``,
        ``loc``, ``scale``, ``state_value``, ``next_state_value``, ``reward``,
        ``done`` and ``terminated``, on the agent's device; the tensordict to go on
        from; and for each step the entries asked for.
    """
    device = agent.head.log_std.device
    frames, bootstraps, infos = [], [], []
    inputs = agent.critic_keys
    for _ in range(num_steps):
        frame = root.select(*inputs).reshape(-1).to(device)
        agent.actor(frame)
        root["action"] = frame["action"].reshape(*root.batch_size, -1).to(root.device)
        step, root = env.step_and_maybe_reset(root)
        after = step["next"].reshape(-1)
        for key in ("reward", "done", "terminated"):
            frame[key] = after[key].to(device)
        frames.append(frame)
        bootstraps.append(_timeout_values(agent, after, device))
        infos.append(after.select(*info_keys))
    rollout = TensorDict.maybe_dense_stack(frames)
    assert isinstance(rollout, TensorDict)
    last = root.select(*inputs).reshape(-1).to(device)
    agent.critic(rollout)
    following = agent.critic(last)["state_value"]
    next_value = torch.cat((rollout["state_value"][1:], following[None]))
    for t, (rows, values) in enumerate(bootstraps):
        next_value[t, rows] = values
    rollout["next_state_value"] = next_value
    return rollout, root, infos


def _timeout_values(
    agent: Agent, after: TensorDictBase, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Rows that ended without termination, and the values of their last states."""
    ended = (after["done"] & ~after["terminated"])[:, 0].nonzero()[:, 0]
    if not len(ended):
        return ended.to(device), torch.zeros(0, 1, device=device)
    terminal = after.select(*agent.critic_keys)[ended].to(device)
    return ended.to(device), agent.critic(terminal)["state_value"]


def add_advantages(rollout: TensorDict, gamma: float, gae_lambda: float) -> None:
    """Write ``advantage`` (normalised over the rollout) and ``value_target``.

    Args:
        rollout: What `collect` returned, ``[T, N]``.
        gamma: Discount.
        gae_lambda: Decay of the estimate.
    """
    advantage, target = generalized_advantage_estimate(
        gamma,
        gae_lambda,
        rollout["state_value"],
        rollout["next_state_value"],
        rollout["reward"],
        rollout["done"],
        rollout["terminated"],
        time_dim=0,
    )
    rollout["value_target"] = target
    rollout["advantage"] = (advantage - advantage.mean()) / (advantage.std() + 1e-8)


class PPO:
    """The update: TorchRL's clipped loss, Adam, adaptive learning rate.

    Args:
        agent: What is trained.
        config: How.
    """

    def __init__(self, agent: Agent, config: PPOConfig) -> None:
        self.agent, self.config = agent, config
        self.loss = ClipPPOLoss(
            agent.actor,
            agent.critic,
            clip_epsilon=config.clip_epsilon,
            entropy_bonus=True,
            entropy_coeff=config.entropy_coeff,
            critic_coeff=config.critic_coeff,
            # A metric of the whole rollout, not of each minibatch.
            log_explained_variance=False,
            loss_critic_type="l2",
            normalize_advantage=False,
        )
        self.loss.set_keys(sample_log_prob="action_log_prob")
        self._actor = [p for p in agent.actor.parameters() if p.requires_grad]
        self._critic = [p for p in agent.critic.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(
            [*self._actor, *self._critic], lr=config.learning_rate, eps=1e-5, fused=True
        )

    @property
    def learning_rate(self) -> float:
        """Current learning rate."""
        return self.optimizer.param_groups[0]["lr"]

    def state(self) -> dict[str, Tensor]:
        """Return the state of the optimiser by name."""
        states = self.optimizer.state_dict()["state"].items()
        return {f"{i}/{key}": v for i, state in states for key, v in state.items()}

    def load_state(self, tensors: Mapping[str, Tensor], learning_rate: float) -> None:
        """Put the optimiser into a state that `state` returned."""
        content = self.optimizer.state_dict()
        for name, value in tensors.items():
            index, key = name.split("/")
            content["state"].setdefault(int(index), {})[key] = value
        content["param_groups"][0]["lr"] = learning_rate
        self.optimizer.load_state_dict(content)

    def update(self, rollout: TensorDict) -> dict[str, float]:
        """Improve the agent on a rollout, then take it into the normalisers.

        Args:
            rollout: What `collect` returned, ``[T, N]``.

        Returns:
            Metrics by name.

        Raises:
            NonFiniteError: If a loss, gradient, weight or normaliser is not finite.
        """
        config = self.config
        add_advantages(rollout, config.gamma, config.gae_lambda)
        residual = rollout["value_target"] - rollout["state_value"]
        explained = 1 - residual.var() / rollout["value_target"].var().clamp(min=1e-12)
        kept = [
            *self.agent.critic_keys,
            *("action", "action_log_prob", "loc", "scale"),
            *("advantage", "value_target", "state_value"),
        ]
        data = rollout.select(*kept).reshape(-1)
        sums: dict[str, Tensor] = {}
        count = 0
        for batch in _minibatches(data, config.ppo_epochs, config.num_mini_batches):
            if config.desired_kl is not None:
                sums["kl"] = sums.get("kl", 0.0) + self._adapt_learning_rate(batch)
            for name, value in self.step(batch).items():
                sums[name] = sums.get(name, 0.0) + value
            count += 1
        for key, norm in self.agent.norms.items():
            assert isinstance(norm, RunningNorm)
            norm.update(data[key])
            if not torch.isfinite(norm.mean + norm.var).all():
                rows = ~torch.isfinite(data[key]).all(-1)
                raise NonFiniteError(f"normaliser of {key!r}", data[rows])
        metrics = {name: float(value) / count for name, value in sums.items()}
        metrics["explained_variance"] = float(explained)
        metrics["learning_rate"] = self.learning_rate
        metrics["action_std"] = float(self.agent.head.log_std.detach().exp().mean())
        return metrics

    def step(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take one step of the optimiser on a minibatch.

        Args:
            batch: Rows of what `update` keeps of a rollout, ``[n]``.

        Returns:
            Metrics by name.

        Raises:
            NonFiniteError: If a loss or gradient, then the agent is as it was before,
                or a weight after the step is not finite.
        """
        losses = self.loss(batch)
        total = sum(v for k, v in losses.items() if k.startswith("loss_"))
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        limit = self.config.max_grad_norm
        actor_norm = nn.utils.clip_grad_norm_(self._actor, limit)
        critic_norm = nn.utils.clip_grad_norm_(self._critic, limit)
        # A loss that is not finite shows in a gradient norm that is not.
        if not torch.isfinite(actor_norm + critic_norm):
            raise NonFiniteError(
                f"loss {float(total.detach())}, actor gradient norm "
                f"{float(actor_norm)}, critic gradient norm {float(critic_norm)}",
                batch,
            )
        self.optimizer.step()
        weights = nn.utils.get_total_norm([*self._actor, *self._critic])
        if not torch.isfinite(weights):
            raise NonFiniteError(f"norm of the weights {float(weights)}", batch)
        self.agent.head.bound_std()
        return {
            "loss_actor": losses["loss_objective"].detach(),
            "loss_critic": losses["loss_critic"].detach(),
            "entropy": losses["entropy"],
            "clip_fraction": losses["clip_fraction"],
            "grad_norm_actor": actor_norm,
            "grad_norm_critic": critic_norm,
        }

    @torch.no_grad()
    def _adapt_learning_rate(self, batch: TensorDictBase) -> Tensor:
        """Divergence of the policy from the one that collected; adapts the rate."""
        part = batch[:_KL_FRAMES]
        assert isinstance(part, TensorDictBase)
        old = part["loc"], part["scale"]
        new = self.agent.head(*(part[key] for key in self.agent.actor_keys))
        kl = gaussian_kl(*old, *new).mean()
        desired, (low, high) = self.config.desired_kl, _LR_BOUNDS
        assert desired is not None
        rate = self.learning_rate
        if kl > 2 * desired:
            rate = max(rate / _LR_FACTOR, low)
        elif kl < desired / 2:
            rate = min(rate * _LR_FACTOR, high)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        return kl


def gaussian_kl(loc0: Tensor, scale0: Tensor, loc1: Tensor, scale1: Tensor) -> Tensor:
    """Return KL(N0 || N1) of diagonal Gaussians, ``[*B]`` from ``[*B, J]``."""
    # log(s1/s0) + (s0^2 + (m0 - m1)^2) / (2 s1^2) - 1/2
    ratio = (scale0.square() + (loc0 - loc1).square()) / (2 * scale1.square())
    return ((scale1 / scale0).log() + ratio - 0.5).sum(-1)


def _minibatches(
    data: TensorDictBase, passes: int, parts: int
) -> Iterator[TensorDictBase]:
    """Yield shuffled minibatches; draws from torch's global generator."""
    for _ in range(passes):
        order = torch.randperm(len(data)).to(data.device or "cpu")
        for index in order.chunk(parts):
            # data[index] would take four times as long.
            yield data.apply(
                partial(torch.index_select, dim=0, index=index), batch_size=index.shape
            )
