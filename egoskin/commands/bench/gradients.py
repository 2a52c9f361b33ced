"""Signal in an update: agreement of the gradients of rollouts of one policy."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from tensordict import TensorDict
from torch import Tensor

from egoskin.agents.ppo import PPO, add_advantages
from egoskin.agents.rollout import collect
from egoskin.bounds import SHARE, Interval, check_bounds
from egoskin.commands.bench.report import Row, show
from egoskin.runs.run import Run
from egoskin.runs.trainer import open_trainer


@dataclass(frozen=True, kw_only=True)
class GradientBench:
    """Compare the actor's gradients of several rollouts of a run's policy."""

    run: Path
    """Run folder; a copy of it is resumed from its checkpoint, without learning."""
    rollouts: Annotated[int, Interval(ge=3)] = 8
    """Rollouts to compare."""
    lambdas: Annotated[tuple[float, ...], SHARE] = (0.0, 0.5, 0.8, 0.9, 0.95, 1.0)
    """Decays of the advantage estimate (GAE lambda), in addition to the run's own."""
    json: Path | None = None
    """File to write the rows to."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)


def gradient_rows(config: GradientBench) -> list[Row]:
    """Return the agreement for each decay.

    The value is the mean cosine between the gradients of two rollouts; its square root
    is the cosine between one of them and the true gradient. The ratio, to the run's own
    decay, is that of the cosines with the gradient at lambda 1 of all other rollouts,
    which has the least bias.
    """
    run = Run.open(config.run)
    if not run.is_new():
        # The error of a damaged checkpoint names this one, not its copy.
        run.load_checkpoint()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        shutil.copytree(config.run, path)
        gradients = _gradients(config, Run(path, run.config))
    reference = gradients[1.0]
    others = reference.sum(0) - reference

    def along(g: Tensor) -> float:
        return float(torch.nn.functional.cosine_similarity(g, others, dim=1).mean())

    own = run.config.ppo.gae_lambda
    return [
        Row(
            name=f"lambda_{decay:g}",
            value=agreement(gradients[decay]),
            unit="cosine between two rollouts",
            ratio=along(gradients[decay]) / along(gradients[own]),
        )
        for decay in dict.fromkeys((own, *config.lambdas))
    ]


def agreement(gradients: Tensor) -> float:
    """Return the mean cosine between pairs of gradients, ``[n, P]``."""
    unit = torch.nn.functional.normalize(gradients, dim=1)
    n = len(unit)
    return float(((unit @ unit.t()).sum() - n) / (n * (n - 1)))


def _gradients(config: GradientBench, run: Run) -> dict[float, Tensor]:
    """Return the actor's gradients for each decay, ``[rollouts, P]``."""
    ppo_config = run.config.ppo
    found: dict[float, list[Tensor]] = {}
    with open_trainer(run) as trainer:
        for i in range(config.rollouts):
            show(f"rollout {i + 1}/{config.rollouts}")
            rollout, trainer.root, _ = collect(
                trainer.env,
                trainer.agent,
                trainer.root,
                ppo_config.rollout_steps,
                noise_correlation=ppo_config.noise_correlation_at(trainer.frames),
            )
            for decay in {ppo_config.gae_lambda, *config.lambdas, 1.0}:
                add_advantages(rollout, ppo_config.gamma, decay)
                gradient = _actor_gradient(trainer.ppo, rollout)
                found.setdefault(decay, []).append(gradient)
    show("")
    return {decay: torch.stack(each) for decay, each in found.items()}


def _actor_gradient(ppo: PPO, rollout: TensorDict) -> Tensor:
    """Return the gradient of PPO's objective for the mean action, ``[P]``."""
    loss = ppo.loss(rollout.reshape(-1))["loss_objective"]
    parameters = list(ppo.agent.head.body.parameters())
    return torch.cat([g.flatten() for g in torch.autograd.grad(loss, parameters)])
