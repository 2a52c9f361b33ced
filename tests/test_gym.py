"""The Gymnasium environments: Gymnasium's checks, bit-identical to our environment."""

from __future__ import annotations

import re
import runpy
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict
from torchrl.envs import EnvBase, GymEnv, GymWrapper
from torchrl.envs.utils import check_env_specs

import egoskin
from calling import SCRIPTS
from egoskin.gym import ENV_ID, DodgeballGym, DodgeballVector
from egoskin.sensors.config import SensorConfig, SkinConfig
from egoskin.viewer.offscreen import RenderingError
from throwing import TASK

SOON: dict[str, Any] = {"task": {"throws": {"first_delay": (0.0, 0.0)}}}
"""The first ball at the start, so that episodes end within a second."""
FORMS: dict[str, dict[str, Any]] = {
    "default": {},
    "binary, history": {"sensor": {"signal": "binary"}, "history": 3},
    "grid": {"sensor": SensorConfig(coverage="ray"), "skin": SkinConfig(num_sensors=3)},
    "real sensors": {"sensor": {"corruption": "time_of_flight"}},
    "localization": {"sensor": {"signal": "localization", "keep_last": True}},
    "blind": {"sensor": {"coverage": "none"}, "previous_action": True},
    "oracle": {"sensor": {"coverage": "oracle"}, "privileged": "velocity"},
}


def make_vec(num_envs: int = 4, **kwargs: Any) -> DodgeballVector:
    envs = gymnasium.make_vec(ENV_ID, num_envs, **{**SOON, **kwargs})
    assert isinstance(envs, DodgeballVector)
    return envs


def still(td: TensorDict) -> TensorDict:
    return td.set("action", torch.zeros(*td.shape, 21))


# --- Gymnasium ----------------------------------------------------------------------


# Of Humanoid-v5, too: what is unbounded, and actions that are not in [-1, 1].
@pytest.mark.filterwarnings(
    "ignore:.*Box observation space m.*imum value is -?infinity",
    "ignore:.*recommend using a symmetric and normalized space",
)
@pytest.mark.parametrize("form", FORMS)
def test_gymnasiums_own_check_passes(form):
    env = gymnasium.make(ENV_ID, **FORMS[form])
    # Pictures need OpenGL; they have a test below.
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.dtype == np.float32
    env.close()


def test_a_name_alone_imports_what_it_needs():
    env = gymnasium.make(f"egoskin.gym:{ENV_ID}", sensor={"signal": "binary"})
    assert isinstance(env.unwrapped, DodgeballGym)
    observation, _ = env.reset(seed=0)
    # Signals come last, and are told to be shares.
    assert (env.observation_space.low[48:] == 0).all()
    assert (env.observation_space.high[48:] == 1).all()
    assert set(observation[48:]) <= {0.0, 1.0}


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_an_action_that_is_not_finite_is_refused(value):
    one, many = gymnasium.make(ENV_ID).unwrapped, make_vec(2, num_workers=1)
    for env in (one, many):
        env.reset(seed=0)
        action = np.zeros(env.action_space.shape, dtype=np.float32)
        action[..., -1] = value
        with pytest.raises(ValueError, match=r"^an action must be finite, got NaN or"):
            env.step(action)
        # The episode goes on.
        _, reward, *_ = env.step(np.zeros_like(action))
        assert np.isfinite(reward).all()
        env.close()


@pytest.mark.parametrize("method", ["step", "render"])
def test_what_needs_a_reset_says_so(method):
    env = gymnasium.make(ENV_ID, render_mode="rgb_array").unwrapped
    arguments = [np.zeros(21, dtype=np.float32)] if method == "step" else []
    with pytest.raises(gymnasium.error.ResetNeeded, match=f"reset before {method}"):
        getattr(env, method)(*arguments)


def test_an_action_of_another_shape_is_refused():
    one, many = gymnasium.make(ENV_ID).unwrapped, make_vec(2, num_workers=1)
    wrong = {one: [(1,), (20,), (1, 21)], many: [(21, 2), (42,), (21,), (1, 21)]}
    for env, shapes in wrong.items():
        env.reset(seed=0)
        for shape in shapes:
            expected = re.escape(f"{list(env.action_space.shape)}, got {list(shape)}")
            with pytest.raises(ValueError, match=f"^an action must .* {expected}$"):
                env.step(np.zeros(shape, dtype=np.float32))
        env.close()


@pytest.mark.parametrize(("gains", "scale"), [("rotor_inertia", 0.3), ("real", 0.2)])
def test_actions_are_bounded_where_more_asks_for_no_more_torque(gains, scale, robot):
    task = {"action_scale": scale, "physics": {"gains": gains}}
    env = gymnasium.make(ENV_ID, task=task)
    kp, _ = robot.joint_gains(gains)
    scale = scale * robot.torque_limit / kp
    for bound, end, sign in (("low", 0, 1), ("high", 1, -1)):
        target = robot.default_joint_pos + scale * getattr(env.action_space, bound)
        # At the end of its range, the joint is asked for its full torque.
        torque = kp * (target - robot.joint_range[end])
        np.testing.assert_allclose(torque, -sign * robot.torque_limit, 1e-5)


@pytest.mark.parametrize(
    "form", ["binary, history", pytest.param("real sensors", marks=pytest.mark.slow)]
)
def test_one_robot_gives_the_bits_of_our_environment(form):
    env = gymnasium.make(ENV_ID, **{**SOON, **FORMS[form]})
    config = env.unwrapped.config
    own = egoskin.make_worker_env(config, num_envs=1, seed=5)
    for episode in range(2):
        # A seed begins with its first episode, however often it is given.
        for _ in range(2 - episode):
            observation, info = env.reset(seed=None if episode else 5)
        rollout = own.rollout(200, still, auto_reset=True)
        for step in range(rollout.shape[-1]):
            td = rollout[0, step]
            given = torch.cat([td[key] for key in config.actor_keys])
            np.testing.assert_array_equal(observation, given)
            told = td["privileged_observation"]
            np.testing.assert_array_equal(info["privileged_observation"], told)
            action = np.zeros(21, dtype=np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            assert reward == td["next", "reward"]
            assert terminated == td["next", "terminated"]
            assert truncated == td["next", "truncated"]
            for key in ("hit", "fallen", "diverged"):
                assert info[key] == td["next", key]
        assert terminated


def test_many_robots_give_the_bits_of_our_environment():
    envs = make_vec(6, num_workers=2)
    config = envs.config
    own = egoskin.make_worker_env(config, num_envs=6, seed=3)
    rollout = own.rollout(70, still, break_when_any_done=False)
    extra = "privileged_observation"
    observations, infos = envs.reset(seed=3)
    ends = 0
    for step in range(70):
        td = rollout[:, step]
        given = torch.cat([td[key] for key in config.actor_keys], -1)
        np.testing.assert_array_equal(observations, given)
        # Where an episode has ended, the info is of the next one.
        np.testing.assert_array_equal(infos[extra], td[extra])
        observations, rewards, terminated, truncated, infos = envs.step(
            np.zeros((6, 21))
        )
        np.testing.assert_array_equal(rewards, td["next", "reward"][:, 0])
        np.testing.assert_array_equal(terminated, td["next", "terminated"][:, 0])
        np.testing.assert_array_equal(truncated, td["next", "truncated"][:, 0])
        done = td["next", "done"][:, 0].numpy()
        ends += done.sum()
        assert ("final_obs" in infos) == done.any()
        if done.any():
            last = torch.cat([td["next", key] for key in config.actor_keys], -1)
            np.testing.assert_array_equal(infos["_final_obs"], done)
            for row in range(6):
                final = infos["final_obs"][row]
                if done[row]:
                    np.testing.assert_array_equal(final, last[row])
                else:
                    assert final is None
            hit = td["next", "hit"][:, 0].numpy()
            np.testing.assert_array_equal(infos["final_info"]["hit"], hit)
            told = np.where(done[:, None], td["next", extra], 0)
            np.testing.assert_array_equal(infos["final_info"][extra], told)
    assert ends > 3
    envs.close()


def kinds(value: Any) -> Any:
    """Items of an info."""
    if isinstance(value, dict):
        return {key: kinds(x) for key, x in value.items()}
    return (type(value), value.dtype, value.shape)


def test_infos_are_made_as_gymnasium_makes_them():
    theirs = SyncVectorEnv(
        [lambda: gymnasium.make(ENV_ID, **SOON)] * 3,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    ours, seen = make_vec(3, num_workers=1), []
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for envs in (theirs, ours):
        _, infos = envs.reset(seed=0)
        seen.append([kinds(infos)])
        while "final_obs" not in infos:
            step = envs.step(np.zeros((3, 21), dtype=np.float32))
            infos = step[-1]
        seen[-1] += [kinds(infos), [(x.dtype, x.shape) for x in step[:-1]]]
        envs.close()
    assert seen[0] == seen[1]


def test_environments_without_a_seed_differ():
    seen = []
    for _ in range(2):
        env = gymnasium.make(ENV_ID, **SOON)
        env.reset()
        # The ball's state is among what the critic reads.
        *_, info = env.step(np.zeros(21, dtype=np.float32))
        seen.append(info["privileged_observation"])
    assert (seen[0] != seen[1]).any()


@pytest.mark.slow
def test_a_seed_begins_anew_with_any_number_of_workers():
    results = []
    for workers in (1, 2):
        envs = make_vec(4, num_workers=workers, sensor={"corruption": "acoustic"})
        for _ in range(2):
            first, _ = envs.reset(seed=7)
            steps = [envs.step(np.ones((4, 21)))[0] for _ in range(20)]
            results.append(np.stack([first, *steps]))
        envs.close()
    for other in results[1:]:
        np.testing.assert_array_equal(results[0], other)


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_what_makes_no_environment_is_refused_with_what_would(make):
    with pytest.raises(TypeError, match=r"argument 'signal'.*EnvConfig: history, .*ta"):
        make(ENV_ID, signal="binary")
    with pytest.raises(ValueError, match=r"Dodgeball-v0: .*sensor\.signal"):
        make(ENV_ID, sensor={"signal": "loud"})
    with pytest.raises(ValueError, match="seed must be in"):
        make(ENV_ID).reset(seed=2**32)


def test_a_robot_that_is_drawn_moves_as_one_that_is_not():
    seen = []
    for mode in (None, "rgb_array"):
        env = gymnasium.make(ENV_ID, render_mode=mode, **SOON)
        assert env.metadata["render_fps"] == 60
        rows, _ = env.reset(seed=1)
        steps = [env.step(np.ones(21, dtype=np.float32)) for _ in range(30)]
        seen.append([rows, *(step[0] for step in steps)])
        if mode is None:
            assert env.render() is None
            continue
        try:
            pictures = [env.render()]
        except RenderingError as error:
            pytest.skip(str(error))
        env.step(np.ones(21, dtype=np.float32))
        pictures += [env.render(), env.render()]
        env.reset()
        pictures.append(env.render())
        env.close()
        # After a close, too.
        env.reset(seed=1)
        assert env.render().shape == (360, 640, 3)
        env.close()
        for picture in pictures:
            assert picture.dtype == np.uint8
            assert picture.std() > 10
        # Equal states give equal pictures, different states different ones.
        moved, same, anew = (
            (pictures[i] != pictures[j]).mean() for i, j in ((0, 1), (1, 2), (2, 3))
        )
        assert same == 0
        assert moved > 0.001
        assert anew > 0.01
    np.testing.assert_array_equal(*seen)


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(ValueError, match="render_mode must be 'rgb_array', got 'ansi'"):
        DodgeballGym(render_mode="ansi")
    with pytest.raises(gymnasium.error.ResetNeeded, match="before render"):
        DodgeballGym(render_mode="rgb_array").render()


# --- TorchRL ------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_torchrls_own_check_passes_on_every_form(form):
    # Of our own environments: test_transforms.py.
    check_env_specs(GymEnv(ENV_ID, **FORMS[form]))


@pytest.mark.parametrize(
    "options",
    [{"sparse": True}, {"bare": True}, {"hold": True}, {"mask": ("all",)}],
    ids=str,
)
def test_torchrls_own_check_passes_with_every_option(options):
    sensor = SensorConfig(coverage="ray" if "sparse" in options else "field")
    config = egoskin.EnvConfig(sensor=sensor, skin=SkinConfig(num_sensors=3))
    check_env_specs(egoskin.make_worker_env(config, num_envs=3, seed=0, **options))


def test_torchrls_own_check_passes_on_workers_and_vectors():
    envs: list[EnvBase] = [
        GymWrapper(make_vec(2, num_workers=1)),
        egoskin.make_env(
            egoskin.EnvConfig(task=TASK), num_envs=4, seed=0, num_workers=2
        ),
    ]
    for env in envs:
        check_env_specs(env)
        env.close()


@pytest.mark.slow
def test_torchrl_reads_the_same_from_the_vector_form():
    envs = make_vec(4, num_workers=1)
    wrapped = GymWrapper(envs)
    own = egoskin.make_worker_env(envs.config, num_envs=4, seed=0)
    # TorchRL resets once to seed, and once more.
    wrapped.set_seed(0)
    own.reset()
    one, other = (
        env.rollout(80, still, break_when_any_done=False) for env in (wrapped, own)
    )
    assert one["next", "done"].sum() > 4
    for where in ((), ("next",)):
        parts = [other[(*where, key)] for key in envs.config.actor_keys]
        assert torch.equal(one[(*where, "observation")], torch.cat(parts, -1))
    for key in ("reward", "done", "terminated", "truncated"):
        assert torch.equal(one["next", key], other["next", key]), key
    wrapped.close()


# --- others -------------------------------------------------------------------------


@pytest.mark.slow
def test_stable_baselines3_trains_for_a_minute(tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    main = runpy.run_path(str(SCRIPTS / "train_sb3.py"))["main"]
    model = main(["--num-envs", "64", "--save", str(tmp_path / "policy.zip")])
    assert model.num_timesteps > 10_000
    # At most 2 s before the first ball, and 10 s after it, at 60 Hz.
    lengths = [episode["l"] for episode in model.ep_info_buffer]
    assert len(lengths) == 100
    assert 10 < np.mean(lengths) <= 720
    fresh = sb3.PPO("MlpPolicy", gymnasium.make(ENV_ID), seed=0, device="cpu")
    for key, value in fresh.policy.state_dict().items():
        assert not torch.equal(value, model.policy.state_dict()[key]), key
    loaded = sb3.PPO.load(tmp_path / "policy.zip", device="cpu")
    env = gymnasium.make(ENV_ID)
    observation, _ = env.reset(seed=0)
    action, _ = loaded.predict(observation, deterministic=True)
    env.step(action)
