"""The sensors outside this project: Gymnasium, a URDF arm, a recording."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv
from torchrl.envs.utils import check_env_specs

SCRIPTS = Path(__file__).parents[2] / "scripts"
# Radius of a geom that stands for a point: MuJoCo measures between geoms [m].
TINY = 1e-9


def script(name: str) -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(SCRIPTS / f"{name}.py")))


def with_specks(spec: mujoco.MjSpec, skin, ball) -> mujoco.MjModel:
    """Return the robot with a tiny geom at each sensor, and the ball."""
    for i, (link, position) in enumerate(zip(skin.links, skin.position, strict=True)):
        spec.body(link).add_geom(name=f"sensor_{i}", size=[TINY, 0, 0], pos=position)
    ball.add_geom(spec.worldbody.add_body(name="ball", mocap=True), name="ball")
    return spec.compile()


def mujoco_distances(model: mujoco.MjModel, data: mujoco.MjData, count) -> np.ndarray:
    """Return the distance from each sensor to the ball, 0 inside, ``[S]``."""
    mujoco.mj_kinematics(model, data)
    ball, unused = model.geom("ball").id, np.zeros(6)
    sensors = [model.geom(f"sensor_{i}").id for i in range(count)]
    distance = [
        mujoco.mj_geomDistance(model, data, s, ball, 99, unused) for s in sensors
    ]
    return np.maximum(np.array(distance) + TINY, 0)


def assert_distances(distance: torch.Tensor, truth: np.ndarray, max_range: float):
    # Within rounding of the range, either result may be infinite.
    clear = np.abs(truth - max_range) > 1e-5
    expected = np.where(truth <= max_range, truth, np.inf)
    np.testing.assert_allclose(distance[clear], expected[clear], 0, 1e-5)
    # The sample has enough sensors in and out of range.
    assert 0.1 < np.isfinite(expected).mean() < 0.9


# --- Gymnasium ------------------------------------------------------------------


@pytest.fixture(scope="module")
def humanoid() -> SimpleNamespace:
    return script("reuse_gymnasium")


@pytest.fixture(scope="module")
def episode(humanoid) -> TensorDict:
    env = humanoid.make_env(humanoid.skin_of_rings(), num_envs=1)
    torch.manual_seed(0)
    env.set_seed(0)
    rollout = env.rollout(100)
    env.close()
    return rollout[0]


def test_sensors_on_gymnasiums_humanoid_equal_mujoco(humanoid, episode):
    skin = humanoid.skin_of_rings()
    path = Path(humanoid.gymnasium.__file__).parent / "envs/mujoco/assets/humanoid.xml"
    model = with_specks(mujoco.MjSpec.from_file(str(path)), skin, humanoid.BALL)
    data, truth = mujoco.MjData(model), []
    for row in episode.unbind(0):
        # Directly from Gymnasium's observation, not from the script's keys.
        data.qpos[:] = row["observation"][:24]
        data.mocap_pos[0] = row["object_pose"][0, :3]
        truth.append(mujoco_distances(model, data, len(skin)))
    assert len(truth) > 10
    assert episode["distance"].dtype == torch.float64
    assert_distances(episode["distance"], np.array(truth), humanoid.RANGE)


def test_the_ball_flies_straight_at_its_speed(humanoid, episode):
    flight = episode["object_pose"][:, 0, :3]
    np.testing.assert_allclose(flight[0], humanoid.BALL_START)
    # Ten steps of 15 ms.
    way = 0.15 * np.array(humanoid.BALL_VELOCITY)
    np.testing.assert_allclose(flight[10] - flight[0], way)


def test_gymnasiums_humanoid_keeps_its_specs(humanoid):
    env = humanoid.make_env(humanoid.skin_of_rings(), num_envs=2)
    check_env_specs(env)
    env.close()


def test_several_humanoids_end_their_episodes_in_a_state_that_was_one(humanoid):
    env = humanoid.make_env(humanoid.skin_of_rings(), num_envs=3)
    torch.manual_seed(0)
    env.set_seed(0)
    rollout = env.rollout(60, break_when_any_done=False)
    env.close()
    last = rollout["next"]
    done = last["done"][..., 0]
    assert done.sum() >= 3
    # The quaternion is valid, and the torso is low enough for the episode to end.
    norm = last["observation"][..., 3:7].norm(dim=-1)
    torch.testing.assert_close(norm, torch.ones_like(norm), atol=0.05, rtol=0)
    assert (last["observation"][done][:, 2] < 1.0).all()
    assert last["signal"].isfinite().all()
    # The next step starts a new episode.
    after = rollout[:, 1:][done[:, :-1]]
    assert (after["observation"][:, 2] > 1.3).all()
    assert (after["step_count"] == 0).all()
    # Each one is measured as if it were alone.
    sensors = humanoid.Compose(humanoid.HumanoidState(), *env.transform[-2:])
    alone = sensors(last.select("observation", "step_count")[1, 7].unsqueeze(0))
    torch.testing.assert_close(alone["signal"][0], last["signal"][1, 7])


class InStep(GymEnv):
    """``GymEnv(num_envs=..)`` without its processes, with Gymnasium's own autoreset."""

    def _async_env(self, *args, **kwargs):
        return gymnasium.vector.SyncVectorEnv(*args, **kwargs)


def test_a_signal_is_nan_only_where_torchrl_gives_no_orientation(humanoid):
    # TorchRL 0.14.1 writes zeros for the last observation of each episode.
    base = InStep(
        "Humanoid-v5",
        num_envs=2,
        exclude_current_positions_from_observation=False,
    )
    sensors = humanoid.make_env(humanoid.skin_of_rings(), num_envs=1).transform
    env = base.append_transform(sensors.clone())
    torch.manual_seed(0)
    env.set_seed(0)
    last = env.rollout(40, break_when_any_done=False)["next"]
    env.close()
    assert last["done"].any()
    zero = (last["observation"][..., 3:7] == 0).all(-1)
    assert torch.equal(last["signal"].isnan().any(-1), zero)
    assert not zero[~last["done"][..., 0]].any()


def test_the_gymnasium_script_prints_an_approach(humanoid, capsys):
    humanoid.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "Humanoid-v5 with 68 sensors, a ball flying at it"
    closest = [float(line.split()[2]) for line in lines[2:]]
    assert min(closest) < 0.2 < max(closest)


# --- URDF -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def arm() -> SimpleNamespace:
    return script("reuse_urdf_arm")


def test_sensors_on_a_urdf_arm_equal_mujoco(arm):
    skin = arm.skin_of_rings()
    states = arm.sweep(40)
    noise = torch.randn(40, 6, generator=torch.Generator().manual_seed(0))
    states["joint_pos"] = states["joint_pos"] + 0.5 * noise
    measured = arm.sensors(skin)(states)
    model = with_specks(mujoco.MjSpec.from_string(arm.urdf()), skin, arm.BALL)
    data, truth = mujoco.MjData(model), []
    for row in states.unbind(0):
        data.qpos[:] = row["joint_pos"]
        # MuJoCo puts the arm's base at the origin; the table only shifts it.
        data.mocap_pos[0] = np.subtract(arm.BALL_POSE, arm.BASE_POSE)[:3]
        truth.append(mujoco_distances(model, data, len(skin)))
    assert_distances(measured["distance"], np.array(truth), arm.RANGE)


def test_no_beam_is_shorter_than_the_distance(arm):
    measured = arm.sensors(arm.skin_of_rings())(arm.sweep(50))
    beams = measured["beams"]
    assert beams.shape == (50, 24, 64)
    assert beams.isfinite().any()
    assert (beams >= measured["distance"][..., None] - 1e-5).all()


def test_the_arm_script_prints_a_pass(arm, capsys):
    arm.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "arm of 6 joints with 24 sensors, turning past a ball"
    hits = [int(line.split()[-1]) for line in lines[2:]]
    # The arm comes from one side of the ball and leaves on the other.
    assert hits[0] == hits[-1] == 0 < max(hits)


# --- a recording ----------------------------------------------------------------


@pytest.fixture(scope="module")
def replay() -> SimpleNamespace:
    return script("reuse_recording")


@pytest.fixture(scope="module")
def recording(replay, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    replay.record(folder, 8, 40)
    return folder


def test_a_recording_is_measured_row_by_row_and_step_by_step(replay, recording):
    states = TensorDict.load_memmap(recording)
    assert states.batch_size == (8, 40)
    skin = replay.place_sensors(replay.H1_2, 64, seed=0)
    sensor = replay.FieldSensor(skin, replay.H1_2.chain, replay.TASK.throws.balls, 1.0)
    whole = sensor(states.copy())["distance"]
    assert whole.shape == (8, 40, 64)
    assert whole.isfinite().any()
    for step in range(0, 40, 7):
        now = sensor(states[:, step].clone())["distance"]
        torch.testing.assert_close(now, whole[:, step])
    # The stored recording is unchanged.
    assert set(TensorDict.load_memmap(recording).keys()) == set(replay.KEYS)


def test_a_longer_range_sees_more_and_earlier(replay, recording, capsys):
    replay.main(replay.ReplayConfig(folder=recording))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("8 robots, 40 steps")
    for kind in ("field", "ray"):
        table = [line.split() for line in lines if line.startswith(kind)]
        seen = [float(row[2]) for row in table]
        warning = [float(row[3]) for row in table]
        assert seen == sorted(seen)
        assert seen[0] < seen[-1]
        assert warning == sorted(warning)


def test_warning_by_hand(replay):
    # Closest at step 4; seen at step 0, lost at 1, then seen at steps 2 and 3.
    gap = torch.tensor([[5.0, 4, 3, 2, 1, 2]])
    seen = torch.tensor([[True, False, True, True, True, True]])
    warning = replay.seconds_of_warning(seen, gap)
    torch.testing.assert_close(warning, torch.tensor([2 * replay.STEP]))
    # Always seen: all four steps. Never seen: none.
    always = replay.seconds_of_warning(torch.ones_like(seen), gap)
    torch.testing.assert_close(always, torch.tensor([4 * replay.STEP]))
    assert replay.seconds_of_warning(torch.zeros_like(seen), gap) == 0
