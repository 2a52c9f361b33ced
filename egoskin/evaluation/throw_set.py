"""Evaluation of a policy on a fixed throw set, with 95 % intervals.

The throw set of seed ``s`` is the draws of episode 0 of rows 0 to ``episodes - 1``:
azimuth, distance, height, speed, interval, link and point aimed at. Draws are
counter-based, so nothing is stored, and every policy, skin and number of workers gets
the same throws. They are held out from training, see `throw_seed`. All times count from
the first throw.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.physics import Engine
from egoskin.envs.randomization import RandomizationConfig
from egoskin.envs.standards import Standard, evaluation_task
from egoskin.make import (
    EnvConfig,
    check_num_workers,
    make_env,
    make_worker_env,
    print_note,
)
from egoskin.rng import held_out
from egoskin.sensors import Skin

Watch = Callable[[TensorDictBase, TensorDictBase, Tensor], None]
"""Called after each step with the state before it and the action, the state after it
(``[N]`` rows, raw keys kept) and the rows whose episode is still running, ``[N]``
bool."""

LATER = 5.0
"""Success is also reported at this age [s]."""
# Up to this many episodes take less time than starting workers.
_FEW = 64
# Two-sided 95 % quantile of the normal distribution.
_Z = 1.959964


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A mean with its 95 % interval."""

    mean: float
    """Mean."""
    low: float
    """Lower end of the interval."""
    high: float
    """Upper end of the interval."""


@dataclass(frozen=True, kw_only=True)
class Avoided:
    """Balls avoided per ball that arrived; None if none arrived."""

    first_ball: float | None
    """First ball, thrown while the robot still stands."""
    later_balls: float | None
    """All later balls of the episode."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Results of a policy on a throw set.

    Success is evaluated at the task's ``success_age_s``, 3 s in the standard task; it
    and the shares of endings up to then add up to 1. Times count from the first throw.
    """

    success: Estimate
    """Share of episodes without contact, fall or divergence up to then (Wilson)."""
    success_5s: Estimate
    """The same up to 5 s, where trained policies with different skins differ more."""
    survival_time: Estimate
    """Mean survival time [s], restricted to the length of an episode (standard task:
    10 s)."""
    ended_by_ball: float
    """Share of episodes ended by a ball."""
    ended_by_fall: float
    """Share ended by a fall."""
    ended_by_self_contact: float
    """Share ended by self-contact, if the task ends episodes at it."""
    diverged: float
    """Share whose simulation failed."""
    rigid_success: float
    """Success on the same throw set with the robot held rigid in its default pose."""
    avoided: Avoided
    """Balls avoided per ball that arrived, over whole episodes."""
    episodes: int
    """Size of the throw set."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Episodes:
    """How each episode of a throw set ended, ``[N]`` each."""

    steps: Tensor
    """Length from the first throw [control steps]; not positive if the episode ended
    before it."""
    hit: Tensor
    """Ended by a ball, bool."""
    fallen: Tensor
    """Ended by a fall, and not by a ball, bool."""
    diverged: Tensor
    """Ended by a failed simulation, and not by a ball or a fall, bool."""
    self_contact: Tensor
    """Ended by self-contact alone, bool."""
    arrived: Tensor
    """Number of balls that arrived: first and later ones, ``[N, 2]``."""
    avoided: Tensor
    """How many of these did not touch the robot, ``[N, 2]``."""


def wilson(successes: int, n: int) -> Estimate:
    """Return a share with its 95 % Wilson interval."""
    p, z2 = successes / n, _Z**2
    centre = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = _Z / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n**2))
    low, high = max(centre - half, 0.0), min(centre + half, 1.0)
    return Estimate(mean=p, low=min(low, p), high=max(high, p))


def mean_estimate(values: Tensor) -> Estimate:
    """Return the mean of samples ``[N]`` with its 95 % normal interval."""
    values = values.double()
    mean = float(values.mean())
    half = _Z * float(values.std()) / math.sqrt(len(values)) if len(values) > 1 else 0.0
    return Estimate(mean=mean, low=mean - half, high=mean + half)


@torch.no_grad()
def play_throws(
    policy: nn.Module | TensorDictModuleBase | None,
    config: EnvConfig,
    skin: Skin,
    *,
    throw_set: int,
    episodes: int,
    first: int = 0,
    num_workers: int | None = None,
    hold: bool = False,
    mask: Sequence[str] = (),
    on_step: Callable[[int, int], None] | None = None,
    watch: Watch | None = None,
    engine: Engine = "mujoco",
    device: torch.device | str = "cpu",
) -> Episodes:
    """Return how the episodes of a throw set end.

    Args:
        policy: Writes ``action`` into a TensorDict; None is the zero action. What it
            writes under ``next`` is given to it at the next step, as the memory of a
            recurrent policy, and if it reads ``is_init``, that is true at the first.
        config: Robot, task, sensors.
        skin: The skin.
        throw_set: Seed of the throw set.
        episodes: Number of episodes, all played side by side.
        first: Row of the first episode; must be 0 without ``watch``.
        num_workers: Processes; the result does not depend on it. None: enough to use
            all cores, or threads of this process for few episodes, to start faster.
        hold: Whether the robot is held rigid in its default pose.
        mask: Links (or shell patterns) whose sensors detect nothing, or
            `egoskin.sensors.MASK_ALL`.
        on_step: Called with (steps done, episodes still running).
        watch: Called after every step; the throws are then played in this process,
            with threads instead of workers and the same result.
        engine: Physics engine.
        device: Device of engine warp.

    Raises:
        ValueError: If an action of the policy is not finite, or as for `make_env`.
    """
    assert first == 0 or watch is not None
    seed = throw_seed(config, throw_set)
    shared: dict[str, Any] = {
        "num_envs": episodes,
        "seed": seed,
        "hold": hold,
        "mask": mask,
        # The sensor signals are not needed.
        "bare": policy is None and watch is None,
    }
    few = num_workers is None and episodes <= _FEW
    if engine == "mujoco" and watch is None and not few:
        env = make_env(config, skin, num_workers=num_workers, **shared)
    else:
        threads = check_num_workers(episodes, num_workers)
        env = make_worker_env(
            config,
            skin,
            num_threads=threads,
            row_offset=first,
            keep_raw=watch is not None,
            engine=engine,
            device=device,
            **shared,
        )
    if isinstance(policy, nn.Module) and torch.device(device).type != "cpu":
        policy = copy.deepcopy(policy).to(device)
    steps = torch.zeros(episodes, dtype=torch.int64)
    running = torch.ones(episodes, dtype=torch.bool)
    causes = ("hit", "fallen", "diverged", "terminated")
    ends = {k: torch.zeros(episodes, dtype=torch.bool) for k in causes}
    balls = {k: torch.zeros(episodes, 2) for k in ("balls_arrived", "balls_avoided")}
    try:
        root: TensorDictBase = env.reset()
        # What the policy is given besides the environment's keys.
        memory: dict[Any, Tensor] = {}
        starts = "is_init" in getattr(policy, "in_keys", ())
        first_throw = root["first_throw_step"].reshape(-1).cpu().clone()
        last = config.task.max_first_throw_step + config.task.episode_steps
        for step in range(1, last + 1):
            flat = root.reshape(-1).copy()
            if starts:
                memory["is_init"] = torch.full_like(flat["done"], step == 1)
            flat.update(memory)
            if policy is None:
                action = torch.zeros(env.action_spec.shape, device=env.device)
            else:
                written = policy(flat)
                action = written["action"]
                if "next" in written.keys():
                    memory = dict(written["next"].items(True, True))
                # MuJoCo treats NaN as zero, so the results would look normal.
                if not action.isfinite().all():
                    raise ValueError(
                        f"the policy's action is not finite at step {step}: its "
                        "weights or its observations differ from those of training"
                    )
            root["action"] = action.reshape(*root.batch_size, -1)
            data, root = env.step_and_maybe_reset(root)
            following = data["next"]
            assert isinstance(following, TensorDictBase)
            after = following.reshape(-1).cpu()
            if watch is not None:
                watch(data.exclude("next").reshape(-1), after, running)
            steps[running] = step - first_throw[running]
            for key, value in balls.items():
                value[running] = after[key][running]
            ended = running & after["done"][:, 0]
            for key, value in ends.items():
                value[ended] = after[key][ended, 0]
            running &= ~ended
            if on_step is not None:
                on_step(step, int(running.sum()))
            if not running.any():
                break
        print_note(env)
    finally:
        env.close()
    hit, fallen, diverged, terminated = ends.values()
    return Episodes(
        steps=steps,
        hit=hit,
        fallen=fallen & ~hit,
        diverged=diverged & ~fallen & ~hit,
        # Nothing else terminates an episode.
        self_contact=terminated & ~diverged & ~fallen & ~hit,
        arrived=balls["balls_arrived"],
        avoided=balls["balls_avoided"],
    )


def standard_task(
    config: EnvConfig, version: Standard | Literal["run"] = "2"
) -> EnvConfig:
    """Return the configuration with the evaluation throws and ends of a standard.

    Args:
        config: The configuration.
        version: The standard; "run" keeps the throws and ends of the configuration and
            only switches its randomisation off.

    Raises:
        ValueError: If an oracle, which observes each ball, would have other balls.
    """
    if version == "run":
        task = dataclasses.replace(config.task, randomization=RandomizationConfig())
    else:
        task = evaluation_task(version, config.task)
        own, balls = config.task.throws.num_balls, task.throws.num_balls
        if config.sensor.coverage == "oracle" and own != balls:
            raise ValueError(
                f"an oracle of {own} balls cannot play standard {version}, which has "
                f"{balls}; only standard run, the throws of its training"
            )
    return dataclasses.replace(config, task=task)


def throw_seed(config: EnvConfig, throw_set: int) -> int:
    """Return the seed of a throw set's draws.

    Training never uses this seed. The exception is version 1 of the standard throw: its
    draws are those of the first episodes of a training with seed ``throw_set``.
    """
    return throw_set if config.standard == "1" else held_out(throw_set)


def summarize(played: Episodes, rigid: Episodes, task: DodgeballConfig) -> Evaluation:
    """Return the results of a throw set from the ends of its episodes.

    Args:
        played: Episodes of the policy.
        rigid: Episodes of the rigid robot on the same throw set.
        task: The task; its control rate and ``success_age_s`` are used.
    """
    control_hz = task.physics.control_hz
    n, limit = len(played.steps), round(task.success_age_s * control_hz)
    early = played.steps <= limit

    def success(episodes: Episodes, limit: int) -> Estimate:
        ended = episodes.hit | episodes.fallen | episodes.diverged
        failed = (ended | episodes.self_contact) & (episodes.steps <= limit)
        return wilson(n - int(failed.sum()), n)

    def avoided(which: int) -> float | None:
        arrived = float(played.arrived[:, which].sum())
        return float(played.avoided[:, which].sum()) / arrived if arrived else None

    return Evaluation(
        success=success(played, limit),
        success_5s=success(played, round(LATER * control_hz)),
        survival_time=mean_estimate(played.steps.clamp(min=0) / control_hz),
        ended_by_ball=float((played.hit & early).double().mean()),
        ended_by_fall=float((played.fallen & early).double().mean()),
        ended_by_self_contact=float((played.self_contact & early).double().mean()),
        diverged=float((played.diverged & early).double().mean()),
        rigid_success=success(rigid, limit).mean,
        avoided=Avoided(first_ball=avoided(0), later_balls=avoided(1)),
        episodes=n,
    )


def evaluate(
    policy: nn.Module | TensorDictModuleBase | None,
    config: EnvConfig,
    skin: Skin,
    *,
    throw_set: int,
    episodes: int,
    num_workers: int | None = None,
    mask: Sequence[str] = (),
    on_step: Callable[[int, int], None] | None = None,
    watch: Watch | None = None,
    engine: Engine = "mujoco",
    device: torch.device | str = "cpu",
) -> Evaluation:
    """Return the results of a policy on a throw set, with those of the rigid robot.

    Args:
        policy: Writes ``action`` into a TensorDict; None is the zero action.
        config: Robot, task (its throws are those of the throw set), sensors.
        skin: The skin.
        throw_set: Seed of the throw set.
        episodes: Size of the throw set.
        num_workers: Processes; the result does not depend on it.
        mask: Links (or shell patterns) whose sensors detect nothing, or
            `egoskin.sensors.MASK_ALL`.
        on_step: Called with (steps done, episodes still running).
        watch: Called after every step of the policy's episodes, see `play_throws`.
        engine: Physics engine.
        device: Device of engine warp.
    """
    play = partial(
        play_throws,
        config=config,
        skin=skin,
        throw_set=throw_set,
        episodes=episodes,
        num_workers=num_workers,
        engine=engine,
        device=device,
    )
    played = play(policy, mask=mask, on_step=on_step, watch=watch)
    return summarize(played, play(None, hold=True), config.task)
