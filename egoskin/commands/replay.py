"""Repeat a training update whose result was NaN or infinite; show where it began.

egoskin replay runs/NAME/not-finite-000001048576.safetensors
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from tensordict import TensorDict
from torch import Tensor, nn

from egoskin.agents.networks import Agent, input_keys
from egoskin.agents.ppo import PPO, NonFiniteError, PPOConfig
from egoskin.policies.policy import PolicySpec, load_agent_tensors
from egoskin.storage.serialization import from_plain
from egoskin.storage.tensor_file import load_tensors, part


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """Replay an update that was not finite; exit status 0 if it is reproduced."""

    dump: Annotated[Path, tyro.conf.Positional]
    """File that the training wrote into its run folder."""


def load(path: Path) -> tuple[PPO, TensorDict, dict[str, Any]]:
    """Return learner, minibatch and header of a dump.

    Raises:
        ValueError: If the file is not a dump of an update.
    """
    if path.is_dir():
        raise ValueError(
            f"{path} is a folder; give the file not-finite-<frames>.safetensors that "
            "a training wrote into it when an update was not finite"
        )
    tensors, header = load_tensors(path)
    if "error" not in header:
        raise ValueError(f"{path} is not a dump of an update: it has no error")
    spec = PolicySpec.from_header(header["policy"], str(path))
    agent = spec.build_agent()
    load_agent_tensors(agent, part("agent", tensors), str(path))
    ppo = PPO(agent, from_plain(PPOConfig, header["ppo"], str(path)))
    ppo.load_state(part("optimizer", tensors), header["learning_rate"])
    batch = dict(part("batch", tensors))
    rows = len(next(iter(batch.values())))
    return ppo, TensorDict(batch, [rows]).unflatten_keys("/"), header


def forward(agent: Agent, batch: TensorDict) -> dict[str, Tensor]:
    """Return the output of every layer, by name and in the order of computation."""
    outputs: dict[str, Tensor] = {}

    def note(name: str) -> Any:
        def hook(module: nn.Module, inputs: Any, output: Tensor) -> None:
            outputs[f"output of {name}"] = output

        return hook

    for name, module in agent.named_modules():
        if not list(module.children()):
            module.register_forward_hook(note(name))
    with torch.no_grad():
        agent.head(*(batch[key] for key in input_keys(agent.actor_keys)))
        agent.critic(batch.select("inputs"))
    return outputs


def not_finite(tensors: Mapping[str, Tensor]) -> Iterator[str]:
    """Yield the name, shape and number of non-finite values of affected tensors."""
    for name, value in tensors.items():
        bad = int((~torch.isfinite(value)).sum())
        if bad:
            yield f"{name} {list(value.shape)}: {bad} of {value.numel()} not finite"


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(ReplayConfig, args=args)
    ppo, batch, header = load(config.dump)
    print(f"recorded: {header['error']}")
    agent = ppo.agent
    stages = {
        "agent": dict(agent.named_parameters()) | dict(agent.named_buffers()),
        "optimizer": ppo.state(),
        "batch": dict(batch.flatten_keys("/").items()),
    }
    found = [f"{k} {text}" for k, v in stages.items() for text in not_finite(v)]
    found += not_finite(forward(agent, batch))
    error = None
    try:
        ppo.step(batch, torch.arange(len(batch)))
        # Only the dump of a failed normaliser holds the features.
        if set(agent.norms) <= set(batch.keys()):
            ppo.update_norms(batch)
    except NonFiniteError as again:
        error = again
    found += not_finite(
        {
            f"gradient of {k}": p.grad
            for k, p in agent.named_parameters()
            if p.grad is not None
        }
    )
    for number, text in enumerate(found):
        print(f"{'first:' if number == 0 else '      '} {text}")
    if error is None:
        raise SystemExit("the step is finite here: the machine or versions may differ")
    print(f"again:    {error}")
