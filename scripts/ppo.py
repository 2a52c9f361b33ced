"""Train a robot to dodge: the main job.

python scripts/ppo.py --sensor.signal localization --sensor.range 2 --seed 1
python scripts/ppo.py --resume runs/NAME --total-frames 100_000_000
"""

from __future__ import annotations

import egoskin  # noqa: F401  (before torch: it says how torch's threads wait)

# isort: split

import dataclasses
import math
import signal
import sys
import time
from types import FrameType

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from egoskin.agents.networks import Agent
from egoskin.agents.ppo import PPO, NonFiniteError, collect
from egoskin.checkpoint import part, prefixed
from egoskin.cli import clear_errors
from egoskin.envs.rewards import TERMS
from egoskin.make import check_num_workers, load_env_state, make_env, save_env_state
from egoskin.policies import (
    PolicySpec,
    agent_tensors,
    load_agent_tensors,
    save_policy,
)
from egoskin.progress import ProgressLine
from egoskin.runs import Run, TrainConfig, parse_config
from egoskin.sensors import Skin
from egoskin.survival import SurvivalCurve
from egoskin.workers import WorkerError, WorkerPool

# What the metrics of an episode are made of.
METRIC_KEYS = (
    "diverged",
    "episode_step",
    "fallen",
    "hit",
    "reward",
    "reward_terms",
    "self_contact",
    "terminated",
)
# A checkpoint is at most this old [s]; the next rollout must fit in as well.
CHECKPOINT_AGE = 60.0


class Stop:
    """Notes the first Ctrl-C or SIGTERM; a second one ends the process at once."""

    def __init__(self) -> None:
        self.requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        print("\nstopping after this rollout, with a checkpoint", file=sys.stderr)
        for again in (signal.SIGINT, signal.SIGTERM):
            signal.signal(again, signal.SIG_DFL)


class Trainer:
    """Everything that a checkpoint holds, and how to go on from it."""

    def __init__(
        self, config: TrainConfig, run: Run, env: WorkerPool, skin: Skin
    ) -> None:
        self.config, self.run, self.env = config, run, env
        device = config.learner_device()
        spec = env.observation_spec
        self.spec = PolicySpec(
            env=config.env,
            skin=skin,
            network=config.ppo.network,
            sizes={key: spec[key].shape[-1] for key in config.env.critic_keys},
            num_actions=env.action_spec.shape[-1],
        )
        torch.manual_seed(config.seed)
        self.agent: Agent = self.spec.build_agent().to(device)
        self.ppo = PPO(self.agent, config.ppo)
        self.survival = SurvivalCurve(config.env.task.episode_steps)
        self.frames = 0
        self.wall_s = 0.0
        self.root: TensorDictBase = TensorDict()

    def start(self) -> None:
        """Begin a new run: first observations, first policy, first checkpoint."""
        self.root = self.env.reset()
        self.keep_policy()
        self.save()

    def iterate(self) -> dict[str, float]:
        """Collect a rollout, improve the agent on it; return the metrics."""
        start = time.perf_counter()
        rollout, self.root, infos = collect(
            self.env,
            self.agent,
            self.root,
            self.config.ppo.rollout_steps,
            METRIC_KEYS,
        )
        collected = time.perf_counter()
        learned = self.ppo.update(rollout)
        end = time.perf_counter()
        self.frames += self.config.frames_per_batch
        self.wall_s += end - start
        return {
            "frames": self.frames,
            "time/wall_s": self.wall_s,
            "time/steps_per_s": self.config.frames_per_batch / (end - start),
            "time/collect_share": (collected - start) / (end - start),
            **self._episode_metrics(TensorDict.maybe_dense_stack(infos)),
            **{f"ppo/{name}": value for name, value in learned.items()},
        }

    def _episode_metrics(self, infos: TensorDictBase) -> dict[str, float]:
        """What the environment said during a rollout, ``[T, N]``."""
        self.survival.decay()
        for info in infos:
            self.survival.update(info["episode_step"][:, 0], info["terminated"][:, 0])
        task = self.config.env.task
        hz = task.physics.control_hz
        ended = float(infos["terminated"].sum())
        terms = infos["reward_terms"].mean(0).mean(0).tolist()

        def share_of_ends(key: str) -> float:
            return float(infos[key].sum()) / ended if ended else float("nan")

        return {
            "episode/survival_s": self.survival.mean() / hz,
            "episode/success": self.survival.probability(
                round(min(task.success_s, task.episode_length_s) * hz)
            ),
            "episode/ended_by_ball": share_of_ends("hit"),
            "episode/ended_by_fall": share_of_ends("fallen"),
            "episode/diverged": float(infos["diverged"].sum()),
            "episode/self_contact": float(infos["self_contact"].float().mean()),
            "reward/mean": float(infos["reward"].mean()),
            "reward/negative_share": float((infos["reward"] < 0).float().mean()),
            **{f"reward/{n}": v for n, v in zip(TERMS, terms, strict=True)},
        }

    def keep_policy(self) -> None:
        """Keep the present policy for learning curves."""
        spec = dataclasses.replace(self.spec, frames=self.frames)
        save_policy(self.run.policy_path(self.frames), self.agent, spec)

    def save(self) -> None:
        """Write a checkpoint from which `load` continues bit for bit."""
        optimizer: dict[str, Tensor] = {}
        for index, state in self.ppo.optimizer.state_dict()["state"].items():
            optimizer |= {f"{index}/{key}": value for key, value in state.items()}
        spec = dataclasses.replace(self.spec, frames=self.frames)
        self.run.save_checkpoint(
            {
                **prefixed("agent", agent_tensors(self.agent)),
                **prefixed("optimizer", optimizer),
                **prefixed("env", save_env_state(self.env, self.root)),
                "survival/at_risk": self.survival.at_risk,
                "survival/ended": self.survival.ended,
                "random_state": torch.get_rng_state(),
            },
            {
                "policy": spec.header(),
                "frames": self.frames,
                "wall_s": self.wall_s,
                "learning_rate": self.ppo.learning_rate,
            },
        )

    def load(self) -> None:
        """Continue from the run's checkpoint."""
        tensors, header = self.run.load_checkpoint()
        what = str(self.run.checkpoint_path)
        load_agent_tensors(self.agent, part("agent", tensors), what)
        state = self.ppo.optimizer.state_dict()
        for name, value in part("optimizer", tensors).items():
            index, key = name.split("/")
            state["state"].setdefault(int(index), {})[key] = value
        state["param_groups"][0]["lr"] = header["learning_rate"]
        self.ppo.optimizer.load_state_dict(state)
        self.root = load_env_state(self.env, part("env", tensors))
        self.survival.at_risk.copy_(tensors["survival/at_risk"])
        self.survival.ended.copy_(tensors["survival/ended"])
        self.frames, self.wall_s = header["frames"], header["wall_s"]
        torch.set_rng_state(tensors["random_state"])


def train(trainer: Trainer, stop: Stop) -> None:
    """Iterate to the end or to a stop, with checkpoints, metrics and progress."""
    config, run = trainer.config, trainer.run
    rollouts = math.ceil(config.total_frames / config.frames_per_batch)
    line = ProgressLine(trainer.frames, rollouts * config.frames_per_batch)
    saved_at = time.monotonic()
    next_snapshot = trainer.frames + config.snapshot_frames
    while trainer.frames < config.total_frames and not stop.requested:
        start = time.monotonic()
        metrics = trainer.iterate()
        run.log(metrics)
        line.update(metrics)
        if trainer.frames >= next_snapshot:
            trainer.keep_policy()
            next_snapshot += config.snapshot_frames
        now = time.monotonic()
        if now - saved_at + 1.5 * (now - start) > CHECKPOINT_AGE:
            trainer.save()
            saved_at = now
    trainer.save()
    trainer.keep_policy()
    line.finish()


def main(args: list[str]) -> None:
    """Run the command."""
    config = parse_config(args)
    config.learner_device()
    if config.learner_threads is not None:
        torch.set_num_threads(config.learner_threads)
    if config.resume is not None:
        run = Run(config.resume, config)
        skin = Skin.load(run.skin_path)
    else:
        skin = config.env.skin.build(config.env.robot_config)
        run = Run.create(config, skin)
    workers = check_num_workers(config.num_envs, config.num_workers)
    print(
        f"run {run.path}: {config.num_envs} agents on {workers} workers, learner on "
        f"{config.device} with {torch.get_num_threads()} threads"
    )
    stop = Stop()
    env = make_env(
        config.env,
        skin,
        num_envs=config.num_envs,
        seed=config.seed,
        num_workers=config.num_workers,
    )
    try:
        trainer = Trainer(config, run, env, skin)
        if config.resume is None:
            trainer.start()
        else:
            trainer.load()
        run.write_config()
        run.record_start()
        run.start_metrics(trainer.frames)
        train(trainer, stop)
    except (WorkerError, NonFiniteError) as error:
        raise SystemExit(f"{error}\n{_how_to_go_on(run)}") from error
    finally:
        run.close()
        env.close()
    if trainer.frames < config.total_frames:
        print(_how_to_go_on(run))
    else:
        print(f"done; evaluate it with: python scripts/evaluate.py {run.path}")


def _how_to_go_on(run: Run) -> str:
    return f"go on with: python scripts/ppo.py --resume {run.path}"


if __name__ == "__main__":
    with clear_errors():
        main(sys.argv[1:])
