"""Training: rollouts, updates, checkpoints and resuming.

Contract: a run of 2n rollouts equals n rollouts and n resumed ones, bit for bit, in the
content of the checkpoint and in all metrics except times. A state that is not finite
never replaces a checkpoint.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from egoskin.agents.networks import Agent, NetworkConfig
from egoskin.agents.ppo import PPO, NonFiniteError
from egoskin.agents.rollout import collect
from egoskin.bounds import NOT_NEGATIVE, POSITIVE, check_bounds
from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.envs.rewards import TERMS
from egoskin.envs.state import keys_read_by
from egoskin.make import (
    Trainable,
    device_of,
    load_env_state,
    make_env,
    make_worker_env,
    print_note,
    save_env_state,
)
from egoskin.parallel import start_server
from egoskin.policies.policy import (
    PolicySpec,
    agent_tensors,
    check_agent_tensors,
    check_finite,
    check_like,
    has_critic,
    load_agent_tensors,
    save_policy,
    sparse_sources,
)
from egoskin.runs.config import TrainConfig
from egoskin.runs.films import FilmMaker
from egoskin.runs.run import Run
from egoskin.runs.survival import SurvivalCurve
from egoskin.sensors import Skin
from egoskin.sparse import SparseSource
from egoskin.storage.serialization import from_plain, to_plain
from egoskin.storage.tensor_file import part, prefixed, save_tensors

# Keys from which the episode metrics are computed.
METRIC_KEYS = (*keys_read_by("trainer"), "reward", "terminated")


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a training, stored in a checkpoint beside the tensors."""

    frames: Annotated[int, NOT_NEGATIVE]
    """Number of environment steps trained on."""
    wall_s: Annotated[float, NOT_NEGATIVE]
    """Wall time of the training [s]."""
    learning_rate: Annotated[float, POSITIVE]
    """Current learning rate."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_bounds(self)


class Trainer:
    """Trains the agent of a run; saves and loads its state.

    Args:
        run: The run to train, with its configuration.
        env: Result of `make_training_env` for the run.
        skin: The run's skin.
        sources: Sparse sources of the keys that the environment does not output.
    """

    def __init__(
        self,
        run: Run,
        env: Trainable,
        skin: Skin,
        sources: Mapping[str, SparseSource],
    ) -> None:
        self.config, self.run, self.env = run.config, run, env
        config = run.config
        self.device = device_of(config.device)
        spec = PolicySpec.of(config.env, skin, config.ppo.network, env, sources)
        self.spec = dataclasses.replace(spec, engine=config.engine)
        torch.manual_seed(config.seed)
        self.agent: Agent = self.spec.build_agent(sources).to(self.device)
        self.ppo = PPO(self.agent, config.ppo, config.num_learner_threads)
        self.survival = SurvivalCurve(config.env.task.episode_steps)
        self.frames = 0
        self.wall_s = 0.0
        self.root: TensorDictBase = TensorDict()

    def start(self) -> None:
        """Start a new run: reset, and save the first policy and checkpoint.

        Raises:
            ValueError: If the networks to start from cannot be read or have changed.
        """
        if (initial := self.run.initial_networks()) is not None:
            load_agent_tensors(self.agent, initial, str(self.config.init_from))
            # They may be of other bounds.
            self.agent.head.bound_std()
            if self.config.ppo.network.init_std != NetworkConfig.init_std:
                print(
                    "note: ppo.network.init_std has no effect with init_from: "
                    f"{self.config.init_from} has its own standard deviation",
                    file=sys.stderr,
                )
            if not has_critic(initial):
                print(
                    f"note: {self.config.init_from} is of an older version and has no "
                    "critic: with a new one, success may fall for millions of frames",
                    file=sys.stderr,
                )
        self.root = self.env.reset()
        self.keep_policy()
        self.save()

    def iterate(self) -> dict[str, float]:
        """Collect a rollout, update the agent on it and return the metrics.

        Raises:
            NonFiniteError: If the update is not finite; the text says how to replay it.
            WorkerError: If a worker ends.
        """
        start = time.perf_counter()
        rollout, self.root, infos = collect(
            self.env,
            self.agent,
            self.root,
            self.config.ppo.rollout_steps,
            METRIC_KEYS,
            self.config.ppo.noise_correlation_at(self.frames),
        )
        collected = time.perf_counter()
        try:
            learned = self.ppo.update(rollout, self.frames)
        except NonFiniteError as error:
            path = quote(str(self.dump(error)))
            error.args = (f"{error}\nreplay it with: egoskin replay {path}",)
            raise
        print_note(self.env)
        end = time.perf_counter()
        self.frames += self.config.frames_per_batch
        self.wall_s += end - start
        return {
            "frames": self.frames,
            "time/wall_s": self.wall_s,
            "time/steps_per_s": self.config.frames_per_batch / (end - start),
            "time/collect_share": (collected - start) / (end - start),
            # Copied from the device once, for all metrics.
            **self._episode_metrics(TensorDict.maybe_dense_stack(infos).cpu()),
            **{f"ppo/{name}": value for name, value in learned.items()},
        }

    def _episode_metrics(self, infos: TensorDictBase) -> dict[str, float]:
        """Return metrics from the environment outputs of a rollout, ``[T, N]``."""
        self.survival.decay()
        for info in infos:
            age = info["episode_step"] - info["first_throw_step"]
            self.survival.update(age[:, 0], info["terminated"][:, 0])
        task = self.config.env.task
        hz = task.physics.control_hz
        ended = float(infos["terminated"].sum())
        terms = infos["reward_terms"].mean(0).mean(0).tolist()
        # A hit may make the robot fall; each end is attributed to one cause.
        hit = infos["hit"]
        fallen = infos["fallen"] & ~hit

        def share_of_ends(cause: Tensor) -> float:
            return float(cause.sum()) / ended if ended else float("nan")

        return {
            "episode/survival_s": self.survival.mean() / hz,
            "episode/success": self.survival.probability(
                round(task.success_age_s * hz)
            ),
            "episode/ended_by_ball": share_of_ends(hit),
            "episode/ended_by_fall": share_of_ends(fallen),
            "episode/diverged": float(infos["diverged"].sum()),
            "episode/self_contact": float(infos["self_contact"].float().mean()),
            "reward/mean": float(infos["reward"].mean()),
            "reward/negative_share": float((infos["reward"] < 0).float().mean()),
            **{f"reward/{n}": v for n, v in zip(TERMS, terms, strict=True)},
        }

    def keep_policy(self) -> None:
        """Save the current policy for learning curves."""
        save_policy(self.run.policy_path(self.frames), self.agent, self._spec_now())

    def save(self) -> None:
        """Write a checkpoint from which `load` continues bit for bit."""
        progress = Progress(
            frames=self.frames,
            wall_s=self.wall_s,
            learning_rate=self.ppo.learning_rate,
        )
        self.run.save_checkpoint(
            {**self._learner_tensors(), **self._other_tensors()},
            {"policy": self._spec_now().header(), **to_plain(progress)},
        )

    def load(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
        """Continue from a checkpoint of the run.

        Raises:
            ValueError: If it belongs to another agent or environment (nothing is loaded
                then), or if it contains values with which no policy can act.
        """
        what = str(self.run.checkpoint_path)
        names = [field.name for field in dataclasses.fields(Progress)]
        known = {name: header[name] for name in names if name in header}
        progress = from_plain(Progress, known, what)
        self.root = self.env.reset()
        own = self._other_tensors()
        if missing := own.keys() - tensors.keys():
            raise ValueError(f"{what}: tensor {min(missing)!r} is missing")
        check_like(own, {name: tensors[name] for name in own}, what)
        agent = part("agent", tensors)
        check_agent_tensors(agent_tensors(self.agent), agent, what)
        self.ppo.load_state(part("optimizer", tensors), progress.learning_rate)
        load_agent_tensors(self.agent, agent, what)
        check_finite(self.agent, what)
        self.root = load_env_state(self.env, part("env", tensors))
        self.survival.at_risk.copy_(tensors["survival/at_risk"])
        self.survival.ended.copy_(tensors["survival/ended"])
        self.frames, self.wall_s = progress.frames, progress.wall_s
        if self.device.type == "cuda":
            torch.cuda.set_rng_state(tensors["random_state"], self.device)
        else:
            torch.set_rng_state(tensors["random_state"])

    def dump(self, error: NonFiniteError) -> Path:
        """Write a file to reproduce an error with `egoskin replay`; return its path."""
        path = self.run.dump_path(self.frames)
        ppo = self.config.ppo
        now = ppo.entropy_coeff_at(self.frames)
        ppo = dataclasses.replace(ppo, entropy_coeff=now, entropy_frames=None)
        save_tensors(
            path,
            {**self._learner_tensors(), **prefixed("batch", error.batch)},
            {
                "policy": self._spec_now().header(),
                "ppo": to_plain(ppo),
                "learning_rate": self.ppo.learning_rate,
                "error": str(error),
            },
        )
        return path

    def _learner_tensors(self) -> dict[str, Tensor]:
        """Return the tensors of agent and optimiser."""
        return {
            **prefixed("agent", agent_tensors(self.agent)),
            **prefixed("optimizer", self.ppo.state()),
        }

    def _other_tensors(self) -> dict[str, Tensor]:
        """Return the other checkpoint tensors: environment, survival, random state."""
        # Noise and minibatches are drawn on the device of the learner.
        random_state = torch.get_rng_state()
        if self.device.type == "cuda":
            random_state = torch.cuda.get_rng_state(self.device)
        return {
            **prefixed("env", save_env_state(self.env, self.root)),
            "survival/at_risk": self.survival.at_risk,
            "survival/ended": self.survival.ended,
            "random_state": random_state,
        }

    def _spec_now(self) -> PolicySpec:
        return dataclasses.replace(self.spec, frames=self.frames)


@contextmanager
def open_trainer(run: Run, num_threads: int = 1) -> Iterator[Trainer]:
    """Yield the trainer of a run, at its start or checkpoint; close it afterwards.

    PyTorch is set to one thread, so that results do not depend on the number of cores.
    The learner has its own threads, see `egoskin.agents.ppo.PPO`.

    Args:
        run: A new run or one to resume.
        num_threads: Physics threads of each worker; results do not depend on it.

    Raises:
        ValueError: If the run is already being trained, or cannot be resumed.
    """
    config = run.config
    torch.set_num_threads(1)
    with run.locked():
        # Unreadable files are reported before the workers start.
        skin = run.load_skin()
        checkpoint = None if run.is_new() else run.load_checkpoint()
        run.tidy()
        if config.engine == "mujoco":
            # The server imports while the rest is built.
            start_server()
        sources = sparse_sources(config.env, skin)
        env = make_training_env(config, skin, bool(sources), num_threads)
        try:
            trainer = Trainer(run, env, skin, sources)
            if checkpoint is None:
                trainer.start()
            else:
                trainer.load(*checkpoint)
            run.write_config()
            run.record_start()
            run.start_metrics(trainer.frames)
            yield trainer
        finally:
            run.close()
            env.close()


def make_training_env(
    config: TrainConfig, skin: Skin, sparse: bool, num_threads: int = 1
) -> Trainable:
    """Return the environment of a training: in workers, or in this process.

    Args:
        config: The training.
        skin: Its skin.
        sparse: Whether to output the state instead of the signal.
        num_threads: Physics threads of each worker.

    Raises:
        ValueError: As in `make_env`, or if the engine cannot build the scene.
    """
    shared: dict[str, Any] = {
        "num_envs": config.num_envs,
        "seed": config.seed,
        "sparse": sparse,
        "num_threads": num_threads,
    }
    if config.engine == "mujoco":
        return make_env(config.env, skin, num_workers=config.num_workers, **shared)
    env = make_worker_env(
        config.env,
        skin,
        engine=config.engine,
        device=device_of(config.device),
        **shared,
    )
    assert isinstance(env.base_env, DodgeballEnv)
    env.base_env.check_scene()
    return env


def train(
    trainer: Trainer,
    stop: Callable[[], bool] = lambda: False,
    show: Callable[[dict[str, float]], None] = lambda metrics: None,
) -> None:
    """Train until the end or a stop, with checkpoints, saved policies and metrics.

    Args:
        trainer: The trainer; its run's configuration sets the end.
        stop: Returns whether to stop after the current rollout.
        show: Called with the metrics of each rollout.
    """
    config, run = trainer.config, trainer.run
    saved_at = time.monotonic()
    control_hz = config.env.task.physics.control_hz
    with FilmMaker(run.path, control_hz) as films:
        while trainer.frames < config.total_frames and not stop():
            start = time.monotonic()
            before = trainer.frames
            metrics = trainer.iterate()
            run.log(metrics)
            show(metrics)
            to_film = _passes(config.film_every, before, trainer.frames)
            if to_film or _passes(config.snapshot_frames, before, trainer.frames):
                trainer.keep_policy()
            if to_film:
                films.start(run.policy_path(trainer.frames))
            now = time.monotonic()
            # The next rollout must also fit into the interval.
            if now - saved_at + 1.5 * (now - start) > config.checkpoint_interval:
                trainer.save()
                saved_at = now
        trainer.save()
        trainer.keep_policy()
        if trainer.frames < config.total_frames:
            # Stopped: a second Ctrl-C while waiting would leave the film running.
            films.stop()


def _passes(interval: int | None, before: int, now: int) -> bool:
    """Return whether a multiple of an interval lies in (before, now]."""
    return interval is not None and before // interval < now // interval
