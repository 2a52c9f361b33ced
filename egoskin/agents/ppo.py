"""Proximal policy optimisation: advantages and the update on a rollout."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

import torch
from tensordict import NonTensorData, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from egoskin.agents.networks import Agent, NetworkConfig, input_keys
from egoskin.agents.normalizers import RunningNorm
from egoskin.bounds import COUNT, NOT_NEGATIVE, POSITIVE, SHARE, Interval, check_bounds
from egoskin.sparse import SparseRows

# Adaptive learning rate: bounds, and the largest change factor per update.
_LR_BOUNDS, _LR_FACTOR = (1e-5, 1e-2), 1.5
# Number of frames on which the KL divergence of an update is estimated.
_KL_FRAMES = 4096
# Number of shares of a minibatch whose gradients are computed in threads. It is fixed,
# since the last bits of their sum depend on it. With more shares, the overhead of
# calling PyTorch would dominate.
_SHARES = 4


class NonFiniteError(RuntimeError):
    """A loss, gradient or weight is not finite; the agent must not be saved.

    Args:
        text: Description of the value that is not finite.
        batch: The data on which it occurred.
    """

    def __init__(self, text: str, batch: TensorDictBase) -> None:
        super().__init__(text)
        dense = (
            (key, _sparse(value).dense() if isinstance(value, NonTensorData) else value)
            for key, value in batch.flatten_keys("/").items()
        )
        self.batch: dict[str, Tensor] = dict(dense)


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Networks and PPO."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Size and initialisation of actor and critic."""
    rollout_steps: Annotated[int, Interval(ge=1, le=100_000)] = 16
    """Control steps per agent and update."""
    ppo_epochs: Annotated[int, Interval(ge=1, le=1000)] = 5
    """Passes over a rollout."""
    num_mini_batches: Annotated[int, COUNT] = 4
    """Minibatches in each pass."""
    gamma: Annotated[float, SHARE] = 0.995
    """Discount per control step."""
    gae_lambda: Annotated[float, SHARE] = 0.8
    """Decay of the generalised advantage estimate for the actor."""
    value_lambda: Annotated[float | None, SHARE] = 0.95
    """Decay of the estimate for the critic's targets; None: gae_lambda."""
    noise_correlation: Annotated[float, Interval(ge=0, lt=1)] = 0.5
    """Correlation of the exploration noise between consecutive steps of a rollout
    (white noise at 60 Hz hardly moves a body)."""
    noise_correlation_start: Annotated[int, NOT_NEGATIVE] = 16_000_000
    """Frames up to which the noise is white nevertheless."""
    clip_epsilon: Annotated[float, Interval(gt=0, le=1)] = 0.2
    """Clip range of the probability ratio (at most 1, for the log of 1 - epsilon)."""
    entropy_coeff: Annotated[float, NOT_NEGATIVE] = 0.003
    """Initial weight of the entropy bonus."""
    entropy_frames: Annotated[int | None, COUNT] = 65_536_000
    """Frames over which the entropy weight falls linearly to zero; None: constant."""
    critic_coeff: Annotated[float, POSITIVE] = 1.0
    """Weight of the value loss. It matters little: the critic has its own weights, and
    Adam's step does not depend on the scale of a loss, except through max_grad_norm."""
    learning_rate: Annotated[float, POSITIVE] = 1e-3
    """Initial learning rate of Adam."""
    desired_kl: Annotated[float | None, POSITIVE] = 0.02
    """KL divergence per update to which the learning rate is adapted; None: constant
    learning rate."""
    max_grad_norm: Annotated[float, POSITIVE] = 1.0
    """Gradient norm limit, for actor and critic separately."""

    def __post_init__(self) -> None:
        """Raise ValueError for values outside their ranges."""
        check_bounds(self)
        low, high = _LR_BOUNDS
        if self.desired_kl is not None and not low <= self.learning_rate <= high:
            raise ValueError(
                f"with desired_kl, learning_rate must be between {low:g} and {high:g}, "
                f"got {self.learning_rate}"
            )

    def noise_correlation_at(self, frames: int) -> float:
        """Return the correlation of the noise after a number of frames."""
        return self.noise_correlation if frames >= self.noise_correlation_start else 0.0

    def entropy_coeff_at(self, frames: int) -> float:
        """Return the weight of the entropy bonus after a number of frames."""
        if self.entropy_frames is None:
            return self.entropy_coeff
        return self.entropy_coeff * max(0.0, 1.0 - frames / self.entropy_frames)


def add_advantages(
    rollout: TensorDict,
    gamma: float,
    gae_lambda: float,
    value_lambda: float | None = None,
) -> None:
    """Write ``advantage`` (normalised over the rollout) and ``value_target``.

    Args:
        rollout: Result of `collect`, ``[T, N]``.
        gamma: Discount.
        gae_lambda: Decay of the advantage estimate.
        value_lambda: Decay of the estimate for the value targets; None for the same.
    """

    def estimate(decay: float) -> tuple[Tensor, Tensor]:
        return generalized_advantage_estimate(
            gamma,
            decay,
            rollout["state_value"],
            rollout["next_state_value"],
            rollout["reward"],
            rollout["done"],
            rollout["terminated"],
            time_dim=0,
        )

    advantage, target = estimate(gae_lambda)
    if value_lambda is not None and value_lambda != gae_lambda:
        target = estimate(value_lambda)[1]
    rollout["value_target"] = target
    rollout["advantage"] = (advantage - advantage.mean()) / (advantage.std() + 1e-8)


class PPO:
    """PPO update with TorchRL's clipped loss, Adam and an adaptive learning rate.

    On a CPU, a thread pool computes the gradients of shares of a minibatch: on networks
    this small, PyTorch's own threads would mostly wait for each other. The number of
    shares is fixed, so results do not depend on the number of threads, provided that
    the caller limits PyTorch to one thread (sums of long tensors depend on that).

    Args:
        agent: The agent to train.
        config: Hyperparameters.
        num_threads: Threads for the shares, if the agent is on a CPU.
    """

    def __init__(self, agent: Agent, config: PPOConfig, num_threads: int = 1) -> None:
        self.agent, self.config = agent, config
        self.loss = ClipPPOLoss(
            agent.actor,
            agent.critic,
            clip_epsilon=config.clip_epsilon,
            entropy_bonus=True,
            entropy_coeff=config.entropy_coeff,
            critic_coeff=config.critic_coeff,
            # Computed for the whole rollout, not for each minibatch.
            log_explained_variance=False,
            loss_critic_type="l2",
            normalize_advantage=False,
            # Threads share the networks, so parameters must not be swapped in and out.
            functional=False,
        )
        self.loss.set_keys(sample_log_prob="action_log_prob")
        self._weights = [*agent.actor.parameters(), *agent.critic.parameters()]
        self._actor, self._critic = _as_vector(agent.actor), _as_vector(agent.critic)
        self.optimizer = torch.optim.Adam(
            [self._actor, self._critic], lr=config.learning_rate, eps=1e-5, fused=True
        )
        on_cpu = agent.head.log_std.device.type == "cpu"
        self.shares = _SHARES if on_cpu else 1
        self.num_threads = min(num_threads, self.shares)
        self._pool = ThreadPoolExecutor(
            self.num_threads, "learner", torch.set_num_threads, (1,)
        )

    @property
    def learning_rate(self) -> float:
        """Current learning rate."""
        return self.optimizer.param_groups[0]["lr"]

    @learning_rate.setter
    def learning_rate(self, rate: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = rate

    def state(self) -> dict[str, Tensor]:
        """Return the tensors of the optimiser state by name."""
        states = self.optimizer.state_dict()["state"].items()
        return {f"{i}/{key}": v for i, state in states for key, v in state.items()}

    def load_state(self, tensors: Mapping[str, Tensor], learning_rate: float) -> None:
        """Load a state of the optimiser that `state` returned.

        Raises:
            ValueError: If it does not match the networks; nothing is loaded then.
        """
        content = self.optimizer.state_dict()
        expected, found = {}, {}
        for i, vector in enumerate((self._actor, self._critic)):
            expected[f"{i}/step"] = (torch.Size(), torch.float32)
            for moment in ("exp_avg", "exp_avg_sq"):
                expected[f"{i}/{moment}"] = (vector.shape, vector.dtype)
        for name, value in tensors.items():
            found[name] = (value.shape, value.dtype)
        # Before the first step the state is empty.
        if found and found != expected:
            raise ValueError(
                "the optimiser state belongs to other networks or to an older version "
                "of egoskin"
            )
        for name, value in tensors.items():
            index, key = name.split("/")
            content["state"].setdefault(int(index), {})[key] = value
        self.optimizer.load_state_dict(content)
        self.learning_rate = learning_rate

    def update(self, rollout: TensorDict, frames: int = 0) -> dict[str, float]:
        """Update the agent on a rollout, then update the normalisers with it.

        Args:
            rollout: Result of `collect`, ``[T, N]``.
            frames: Number of frames trained on before this rollout.

        Returns:
            Metrics by name.

        Raises:
            NonFiniteError: If a loss, gradient, weight or normaliser is not finite.
        """
        config = self.config
        weight = self.loss.entropy_coeff
        assert isinstance(weight, Tensor)
        weight.fill_(config.entropy_coeff_at(frames))
        add_advantages(rollout, config.gamma, config.gae_lambda, config.value_lambda)
        residual = rollout["value_target"] - rollout["state_value"]
        explained = 1 - residual.var() / rollout["value_target"].var().clamp(min=1e-12)
        data = rollout.reshape(-1)
        kept = ["inputs", "action", "action_log_prob", "loc", "scale"]
        batch = data.select(*kept, "advantage", "value_target", "state_value")
        sums: dict[str, Tensor] = {}
        count = 0
        for _ in range(config.ppo_epochs):
            order = torch.randperm(len(batch), device=batch.device)
            for index in order.tensor_split(config.num_mini_batches):
                for name, value in self.step(batch, index).items():
                    sums[name] = sums.get(name, 0.0) + value
                count += 1
        metrics = {name: float(value) / count for name, value in sums.items()}
        some = torch.randperm(len(batch), device=batch.device)[:_KL_FRAMES]
        metrics["kl"] = self._divergence(batch, some)
        if config.desired_kl is not None:
            self._adapt_learning_rate(metrics["kl"], config.desired_kl)
        self.update_norms(data)
        metrics["explained_variance"] = float(explained)
        metrics["learning_rate"] = self.learning_rate
        metrics["action_std"] = float(self.agent.head.log_std.detach().exp().mean())
        return metrics

    def update_norms(self, data: TensorDictBase) -> None:
        """Update the normalisers with the features of some rows.

        Args:
            data: Contains the features that are normalised, ``[n]``.

        Raises:
            NonFiniteError: If a mean or variance is not finite then; its batch are the
                rows whose feature is not finite.
        """
        for key, norm in self.agent.norms.items():
            assert isinstance(norm, RunningNorm)
            norm.update(data[key])
            if not torch.isfinite(norm.mean + norm.var).all():
                value = data[key]
                sparse = isinstance(value, SparseRows)
                finite = value.is_finite() if sparse else value.isfinite().all(-1)
                (bad,) = (~finite).nonzero(as_tuple=True)
                raise NonFiniteError(f"normaliser of {key!r}", _rows(data, bad))

    def step(self, data: TensorDictBase, index: Tensor) -> dict[str, Tensor]:
        """Take one step of the optimiser on a minibatch.

        Args:
            data: Entries of a rollout that `update` selects, ``[n]``.
            index: Rows of the minibatch, ``[m]`` int64.

        Returns:
            Metrics by name.

        Raises:
            NonFiniteError: If a loss or gradient is not finite (the agent is unchanged
                then), or if a weight is not finite after the step.
        """
        shares = index.chunk(self.shares)
        # The loss sets these global modes and restores the previous ones when it ends.
        # With overlapping threads, the next rollout would be left without exploration.
        mode = set_exploration_type(self.loss.deterministic_sampling_mode)
        with mode, set_recurrent_mode(True):
            results = list(self._pool.map(partial(self._gradients, data), shares))
        weights = [len(share) / len(index) for share in shares]

        def mean(values: Iterable[Tensor]) -> Tensor:
            return _total(w * v for w, v in zip(weights, values, strict=True))

        metrics = {name: mean(r[1][name] for r in results) for name in results[0][1]}
        networks = (self._actor, self._critic)
        gradient = mean(r[0] for r in results).split([len(n) for n in networks])
        norms = []
        for network, part in zip(networks, gradient, strict=True):
            assert network.grad is not None
            network.grad.copy_(part)
            norms.append(nn.utils.get_total_norm([network.grad]))
        actor_norm, critic_norm = norms
        # A non-finite loss may have a zero gradient.
        total = metrics["loss_actor"] + metrics["loss_critic"]
        if not torch.isfinite(actor_norm + critic_norm + total):
            losses = (f"{k} {float(v)}" for k, v in metrics.items() if "loss" in k)
            raise NonFiniteError(
                f"{', '.join(losses)}, actor gradient norm {float(actor_norm)}, "
                f"critic gradient norm {float(critic_norm)}",
                _rows(data, index),
            )
        for network, norm in zip(networks, norms, strict=True):
            limit = self.config.max_grad_norm
            nn.utils.clip_grads_with_norm_(network, limit, norm)
        self.optimizer.step()
        norm = nn.utils.get_total_norm(networks)
        if not torch.isfinite(norm):
            raise NonFiniteError(
                f"norm of the weights {float(norm)}", _rows(data, index)
            )
        self.agent.head.bound_std()
        return {
            **metrics,
            "grad_norm_actor": actor_norm,
            "grad_norm_critic": critic_norm,
        }

    def _gradients(
        self, data: TensorDictBase, index: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the gradient and metrics of the mean loss of some rows.

        Returns:
            The concatenated gradient of all weights, and metrics by name.
        """
        batch = _rows(data.exclude("loc", "scale"), index)
        losses = self.loss(batch)
        total = _total(v for k, v in losses.items() if k.startswith("loss_"))
        gradients = torch.autograd.grad(total, self._weights)
        metrics = {
            "loss_actor": losses["loss_objective"].detach(),
            "loss_critic": losses["loss_critic"].detach(),
            "entropy": losses["entropy"],
            "clip_fraction": losses["clip_fraction"],
        }
        return torch.cat([g.flatten() for g in gradients]), metrics

    @torch.no_grad()
    def _divergence(self, data: TensorDictBase, index: Tensor) -> float:
        """Return the KL divergence of the policy from the one that collected rows."""
        part = _rows(data.select("inputs", "loc", "scale"), index)
        new = self.agent.head(*(part[key] for key in input_keys(self.agent.actor_keys)))
        return float(gaussian_kl(part["loc"], part["scale"], *new).mean())

    def _adapt_learning_rate(self, kl: float, desired: float) -> None:
        """Adapt the learning rate to the divergence of an update.

        This is done once per update. Adapted at each minibatch, as is common, the rate
        overshoots where the policy is sensitive and varies by factors of a thousand.
        """
        # The divergence is proportional to the square of the step.
        factor = (desired / max(kl, 1e-12)) ** 0.5
        rate = self.learning_rate * min(max(factor, 1 / _LR_FACTOR), _LR_FACTOR)
        self.learning_rate = min(max(rate, _LR_BOUNDS[0]), _LR_BOUNDS[1])


def gaussian_kl(loc0: Tensor, scale0: Tensor, loc1: Tensor, scale1: Tensor) -> Tensor:
    """Return KL(N0 || N1) of diagonal Gaussians, ``[*B]`` from ``[*B, J]``."""
    # log(s1/s0) + (s0^2 + (m0 - m1)^2) / (2 s1^2) - 1/2
    ratio = (scale0.square() + (loc0 - loc1).square()) / (2 * scale1.square())
    return ((scale1 / scale0).log() + ratio - 0.5).sum(-1)


def _as_vector(network: nn.Module) -> nn.Parameter:
    """Return the trainable parameters of a network as one vector.

    The layers and their gradients become views of it. The optimiser then takes one step
    instead of one per layer, each of which wakes its threads; this saves a twelfth of
    the time of an update.
    """
    weights = list(network.parameters())
    vector = nn.Parameter(nn.utils.parameters_to_vector(weights).detach())
    nn.utils.vector_to_parameters(vector.detach(), weights)
    vector.grad = torch.zeros_like(vector)
    parts = vector.grad.split([weight.numel() for weight in weights])
    for weight, part in zip(weights, parts, strict=True):
        weight.grad = part.view_as(weight)
    return vector


def _total(values: Iterable[Tensor]) -> Tensor:
    """Return the sum of tensors, added in order."""
    return functools.reduce(torch.add, values)


def _sparse(value: NonTensorData) -> SparseRows:
    """Return the sparse rows of an entry."""
    rows = value.data
    assert isinstance(rows, SparseRows)
    return rows


def _rows(data: TensorDictBase, index: Tensor) -> TensorDict:
    """Return some rows, ``[m]``; data[index] takes four times as long."""
    rows = TensorDict(batch_size=index.shape, device=data.device)
    for key, value in data.items():
        if isinstance(value, TensorDictBase):
            rows[key] = _rows(value, index)
        elif isinstance(value, NonTensorData):
            rows.set_non_tensor(key, _sparse(value).select(index))
        else:
            rows[key] = value.index_select(0, index)
    return rows
