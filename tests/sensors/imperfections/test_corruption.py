"""Each imperfection compared with values by hand, and the presets in the task."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.robots.builtin import H1_2
from egoskin.sensors import FieldSensor, Proximity, place_sensors
from egoskin.sensors.imperfections.corruption import (
    Corruption,
    Moment,
    Places,
    corrupt,
)
from egoskin.sensors.imperfections.models import (
    Bias,
    DeadSensors,
    Drift,
    Dropout,
    FalsePositives,
    Latency,
    Noise,
    Quantisation,
    RangeLimits,
    SampleAndHold,
)
from egoskin.sensors.imperfections.presets import PRESETS
from throwing import TASK

INF, NAN = math.inf, math.nan
DT = 0.01


def moment(rows: int, step: int = 0, speed: float = 0.0, **changes) -> Moment:
    row = torch.arange(rows)
    fields = {
        "seed": 5,
        "dt": DT,
        "row": row,
        "episode": torch.zeros_like(row),
        "step": torch.full_like(row, step),
        "speed": torch.full((rows,), speed),
        "redraw_traits": True,
    }
    return Moment(**{**fields, **changes})


def read(models, distance: torch.Tensor, **when) -> torch.Tensor:
    """First readings of an episode, ``[B, S, K]`` or ``[B, S]``."""
    shaped = distance.reshape(*distance.shape[:2], -1)
    reading, _ = corrupt(models, shaped, None, moment(len(distance), **when))
    return reading.reshape(distance.shape)


def everywhere(value: float, rows: int, sensors: int, *beams: int) -> torch.Tensor:
    return torch.full((rows, sensors, *beams), value)


def sequence(models, distances: torch.Tensor, **when) -> torch.Tensor:
    """Readings of an episode, from ``[T, B, S, K]``."""
    states, readings = None, []
    for step, distance in enumerate(distances):
        now = moment(len(distance), step, **when)
        reading, states = corrupt(models, distance, states, now)
        readings.append(reading)
    return torch.stack(readings)


# --- deterministic models ---------------------------------------------------------


def test_quantisation_by_hand():
    distance = torch.tensor([[0.1234, 0.1236, 1.0, INF, NAN]])
    got = read([Quantisation(step=0.001)], distance)
    expected = torch.tensor([[0.123, 0.124, 1.0, INF, NAN]])
    torch.testing.assert_close(got, expected, equal_nan=True)


@pytest.mark.parametrize(("below", "near"), [("nothing", INF), ("minimum", 0.1)])
def test_range_limits_by_hand(below, near):
    distance = torch.tensor([[0.05, 0.1, 1.0, 2.0, 2.001, INF, NAN]])
    limits = RangeLimits(minimum=0.1, maximum=2.0, below=below)
    expected = torch.tensor([[near, 0.1, 1.0, 2.0, INF, INF, NAN]])
    torch.testing.assert_close(read([limits], distance), expected, equal_nan=True)


def test_bias_by_hand():
    # 1 + 0.1 + 0.2 x 1 = 1.3; a reading is never negative.
    distance = torch.tensor([[1.0, 0.5, INF, NAN]])
    got = read([Bias(offset=0.1, gain=0.2)], distance)
    expected = torch.tensor([[1.3, 0.7, INF, NAN]])
    torch.testing.assert_close(got, expected, equal_nan=True)
    assert read([Bias(offset=-2.0)], distance)[0, 0] == 0


def test_latency_by_hand():
    # 0.024 s are two steps of 0.01 s; until then the first reading.
    distances = torch.arange(6.0).reshape(6, 1, 1, 1)
    got = sequence([Latency(seconds=0.024)], distances).flatten().tolist()
    assert got == [0, 0, 0, 1, 2, 3]
    got = sequence([Latency(seconds=0.026)], distances).flatten().tolist()
    assert got == [0, 0, 0, 0, 1, 2]
    got = sequence([Latency(seconds=0.004)], distances).flatten().tolist()
    assert got == [0, 1, 2, 3, 4, 5]


def test_no_model_changes_nothing():
    distance = torch.tensor([[0.0, 1.0, INF, NAN]])
    torch.testing.assert_close(read([], distance), distance, equal_nan=True)


# --- sample and hold ----------------------------------------------------------------


def test_each_sensor_samples_at_its_rate_with_a_phase_of_its_own():
    # At 25 Hz of 100 steps/s every fourth: the reading is the step of the sample.
    steps, rows, sensors = 40, 50, 40
    now = torch.arange(float(steps)).reshape(-1, 1, 1, 1)
    distances = now.expand(steps, rows, sensors, 2)
    readings = sequence([SampleAndHold(rate_hz=25.0)], distances)
    assert (readings[..., 0] == readings[..., 1]).all()  # beams sample together
    assert (readings[0] == 0).all()
    sampled = readings[..., 0] == now[..., 0]
    assert (sampled[1:].reshape(-1, rows, sensors)[:36].sum(0) == 9).all()
    # Each of four phases with probability 1/4: 2000 draws, standard deviation 19.4.
    counts = sampled[4:8].sum((1, 2))
    assert counts.sum() == rows * sensors
    assert (counts - 500).abs().max() < 5 * 19.4


@settings(max_examples=10)
@given(st.floats(1.0, 99.0))
def test_the_rate_is_kept_in_the_long_run(rate):
    steps = 500
    distances = torch.arange(float(steps)).reshape(-1, 1, 1, 1).expand(-1, 1, 8, 1)
    readings = sequence([SampleAndHold(rate_hz=rate)], distances)[..., 0, :, 0]
    samples = (readings[1:] != readings[:-1]).sum(0)
    # The clock counts in 1/65536 of a step: 500 steps are off by 0.01 samples.
    assert ((samples - (steps - 1) * DT * rate).abs() < 1.02).all()


@pytest.mark.parametrize("rate", [100.0, 250.0])
def test_a_rate_above_that_of_control_holds_nothing(rate):
    distances = torch.rand(20, 3, 4, 1)
    assert torch.equal(sequence([SampleAndHold(rate_hz=rate)], distances), distances)


# --- random models ------------------------------------------------------------------

MANY = 2**18  # readings, as 2**12 rows of 64 sensors


def many(value: float) -> torch.Tensor:
    return everywhere(value, 2**12, 64)


def assert_gaussian(errors: torch.Tensor, std: float) -> None:
    """Mean, spread and tail of errors, to five standard errors."""
    z, n = errors.double().flatten() / std, errors.numel()
    assert z.mean().abs() < 5 / n**0.5
    assert (z.square().mean() - 1).abs() < 5 * (2 / n) ** 0.5
    # P(|z| > 2) = 0.0455
    tail = (z.abs() > 2).double().mean()
    assert (tail - 0.0455).abs() < 5 * (0.0455 * 0.9545 / n) ** 0.5


@pytest.mark.parametrize(
    ("distance", "std"),
    [(0.5, 0.1), (2.0, 0.2), (10.0, 3.0)],
    ids=["constant", "linear", "quadratic"],
)
def test_noise_has_the_largest_of_three_spreads(distance, std):
    # max(0.1, 0.1 d, 0.03 d^2): 0.1 at 0.5 m, 0.2 at 2 m, 3 at 10 m; + 20 so that
    # no reading is cut at 0: a bias beforehand would change the spread.
    noise = Noise(constant=0.1, linear=0.1, quadratic=0.03)
    errors = read([noise, Bias(offset=20.0)], many(distance)) - 20 - distance
    assert_gaussian(errors, std)


def test_noise_rises_with_the_speed_of_the_joints():
    noise = Noise(constant=0.01, per_speed=0.5)
    assert_gaussian(read([noise], many(1.0), speed=4.0) - 1, 0.03)


def test_common_noise_is_that_of_a_row():
    errors = read([Noise(constant=0.01, common=True)], many(1.0)) - 1
    assert (errors == errors[:, :1]).all()
    assert_gaussian(errors[:, 0], 0.01)


def test_noise_of_neighbours_steps_and_models_is_uncorrelated():
    noise = Noise(constant=0.01)
    first = read([noise], many(1.0)) - 1
    second = read([noise], many(1.0), step=1) - 1
    episode = read([noise], many(1.0), episode=torch.ones(2**12).long()) - 1
    both = read([noise, noise], many(1.0)) - 1
    pairs = [
        (first[:, 1:], first[:, :-1]),
        (first[1:], first[:-1]),
        (first, second),
        (first, episode),
        (first, both - first),
    ]
    for a, b in pairs:
        # The correlation of n independent pairs has standard deviation 1/sqrt(n).
        assert abs((a * b).double().mean() / 1e-4) < 5 / a.numel() ** 0.5


def test_bias_is_drawn_for_each_sensor():
    # z (0.1 + 0.2 d) of two draws: at 1 m sqrt(0.01 + 0.04) = 0.2236.
    bias = [Bias(offset_std=0.1, gain_std=0.2), Bias(offset=5.0)]
    errors = read(bias, many(1.0)) - 6
    assert_gaussian(errors, 0.05**0.5)
    # Of a sensor, the same at each step and in each beam.
    beams = read(bias, everywhere(1.0, 2**12, 64, 2), step=9) - 6
    assert torch.equal(beams[..., 0], errors)
    assert torch.equal(beams[..., 1], errors)
    # Another episode draws other sensors, unless the robot is kept.
    episode = torch.ones(2**12).long()
    assert (
        not torch.isclose(read(bias, many(1.0), episode=episode) - 6, errors)
        .any(1)
        .all()
    )
    fixed = read(bias, many(1.0), redraw_traits=False) - 6
    assert (fixed == fixed[0]).all()
    assert fixed[0].unique().numel() > 60
    again = read(bias, many(1.0), redraw_traits=False, episode=episode) - 6
    assert torch.equal(again, fixed)


@pytest.mark.parametrize(
    ("model", "speed", "chance"),
    [
        (Dropout(probability=0.1, per_metre=0.1), 0.0, 0.3),
        (Dropout(probability=0.1, per_speed=0.02), 5.0, 0.2),
        (DeadSensors(probability=0.05), 0.0, 0.05),
        (FalsePositives(probability=0.02, max_range=3.0), 0.0, 0.0),
    ],
)
def test_readings_are_lost_with_their_probability(model, speed, chance):
    lost = read([model], many(2.0), speed=speed).isinf()
    error = 5 * (chance * (1 - chance) / MANY) ** 0.5
    assert (lost.double().mean() - chance).abs() <= error


def test_traits_are_constant_and_independent_of_the_draws_of_every_step():
    row, place = torch.ones(50, 64).nonzero(as_tuple=True)
    places = Places(row, place, beams=1)
    traits = [places.draw_trait(moment(50, step)) for step in (0, 7)]
    assert torch.equal(*traits)
    for step in (0, 7):
        # Of 3,200 pairs of 16-bit numbers, hardly one is equal by chance.
        assert (places.draw(moment(50, step)) == traits[0]).sum() < 5


def test_dead_sensors_are_dead_for_an_episode():
    distance = everywhere(1.0, 256, 64, 4)
    dead = read([DeadSensors(probability=0.2)], distance).isinf()
    assert (dead == dead[..., :1]).all()
    later = read([DeadSensors(probability=0.2)], distance, step=7).isinf()
    assert torch.equal(later, dead)


@pytest.mark.parametrize("chance", [1e-4, 0.03, 0.5, 1.0])
def test_false_positives_come_independently_at_any_distance(chance):
    model = FalsePositives(probability=chance, max_range=3.0)
    reading = read([model], many(INF))
    false = reading.isfinite()
    error = 5 * (chance * (1 - chance) / MANY) ** 0.5
    assert (false.double().mean() - chance).abs() <= error
    # Every sensor alike; two neighbours with probability p^2.
    by_sensor = false.double().mean(0)
    assert (by_sensor - chance).abs().max() <= 5 * (
        chance * (1 - chance) / 2**12
    ) ** 0.5
    pairs = (false[:, 1:] & false[:, :-1]).double().mean()
    assert (pairs - chance**2).abs() <= 5 * chance / (2**12 * 63) ** 0.5
    # Uniform over the range: mean 1.5, standard deviation 3 / sqrt(12).
    values = reading[false]
    assert (values > 0).all()
    assert (values < 3).all()
    assert (values.mean() - 1.5).abs() < 5 * 0.866 / len(values) ** 0.5


def test_false_positives_leave_what_is_seen():
    distance = torch.tensor([[1.0, NAN, INF]]).repeat(100, 1)
    reading = read([FalsePositives(probability=1.0, max_range=3.0)], distance)
    assert (reading[:, 0] == 1).all()
    assert reading[:, 1].isnan().all()
    assert reading[:, 2].isfinite().all()


@pytest.mark.parametrize("sensors", [3, 200])
def test_drift_walks_from_zero(sensors):
    # After n steps of 0.01 s a spread of std sqrt(0.01 n), here at 1 m: max(0, 0.4).
    steps, rows = 100, 2**14 // sensors
    distances = everywhere(1.0, rows, sensors, 2).expand(steps, -1, -1, -1)
    models = [Drift(quadratic=0.4), Bias(offset=9.0)]
    errors = sequence(models, distances) - 10
    assert torch.equal(errors[..., 0], errors[..., 1])
    torch.testing.assert_close(errors[0].abs(), torch.full_like(errors[0], 0.04))
    spread = errors[-1, ..., 0].double().square().mean().sqrt()
    assert (spread / 0.4 - 1).abs() < 5 / (2 * rows * sensors) ** 0.5
    # Steps are independent of those before and of the neighbour's.
    change = (errors[1:] - errors[:-1])[..., 0].double()
    n = change[1:].numel()
    assert (change[1:] * change[:-1]).mean().abs() / 0.0016 < 5 / n**0.5
    n = change[..., 1:].numel()
    assert (change[..., 1:] * change[..., :-1]).mean().abs() / 0.0016 < 5 / n**0.5


# --- composition ----------------------------------------------------------------------


def test_models_apply_in_order():
    distance = torch.tensor([[0.96]])
    cut, shift = RangeLimits(maximum=1.0), Bias(offset=0.1)
    assert read([cut, shift], distance).item() == pytest.approx(1.06)
    assert read([shift, cut], distance).item() == INF
    # A lost reading is not restored by a later model.
    assert read([Bias(offset=0.1), cut, Bias(offset=-0.5)], distance).item() == INF


ALL = [
    Bias(offset=0.1, offset_std=0.1, gain_std=0.1),
    Drift(linear=0.1),
    Noise(linear=0.1),
    Noise(quadratic=0.1, common=True),
    Dropout(probability=0.3),
    FalsePositives(probability=0.3, max_range=1.0),
    DeadSensors(probability=0.3),
    RangeLimits(minimum=0.1, maximum=2.0),
    Quantisation(step=0.01),
    SampleAndHold(rate_hz=10.0),
    Latency(seconds=0.02),
]


@pytest.mark.parametrize("model", ALL, ids=lambda m: type(m).__name__)
def test_bad_input_stays_marked(model):
    distance = everywhere(NAN, 50, 20, 2)
    assert read([model], distance).isnan().all()
    assert sequence([model], distance.expand(5, -1, -1, -1)).isnan().all()


@pytest.mark.parametrize("model", ALL, ids=lambda m: type(m).__name__)
def test_nothing_stays_nothing_but_for_false_positives(model):
    reading = read([model], everywhere(INF, 50, 20, 2))
    assert reading.isinf().all() == (not isinstance(model, FalsePositives))


@settings(max_examples=20)
@given(st.integers(1, 40), st.integers(0, 2**32 - 1), st.data())
def test_a_row_does_not_depend_on_the_others(rows, seed, data):
    generator = torch.Generator().manual_seed(seed)
    distances = 3 * torch.rand(4, rows, 11, 2, generator=generator)
    distances = distances.masked_fill(distances > 2, INF)
    alone = data.draw(st.integers(0, rows - 1))
    together = sequence(ALL, distances, seed=seed)[:, alone]
    one = torch.tensor([alone])
    alone_reading = sequence(ALL, distances[:, alone : alone + 1], seed=seed, row=one)[
        :, 0
    ]
    assert torch.equal(together, alone_reading)


def test_beams_and_sensors_are_read_alike():
    # A reduced ray sensor has a single beam.
    distance = torch.rand(4, 9)
    assert torch.equal(read(ALL, distance), read(ALL, distance[..., None])[..., 0])


# --- the transform ------------------------------------------------------------------

SKIN = place_sensors(H1_2, 12, seed=0)
BALLS = TASK.throws.balls


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_presets_run_in_the_task(preset):
    sensor = FieldSensor(SKIN, H1_2.chain, BALLS, 6.0)
    corruption = Corruption(preset(), dt=1 / 60, seed=1)
    env = TransformedEnv(
        DodgeballEnv(H1_2, TASK, num_envs=6, seed=0),
        Compose([sensor, corruption, Proximity(6.0, in_keys=["reading"])]),
    )
    check_env_specs(env)
    data = env.rollout(30, break_when_any_done=False)
    seen, read_ = data["distance"].isfinite(), data["reading"]
    assert seen.float().mean() > 0.2
    assert not read_.isnan().any()
    assert (read_ >= 0).all()
    assert not torch.equal(read_, data["distance"])
    assert data["signal"].isfinite().all()


def test_presets_are_what_they_say():
    near, far = everywhere(0.01, 256, 64), everywhere(4.5, 256, 64)
    beyond = everywhere(0.25, 256, 64)
    optical = PRESETS["time_of_flight"]()
    reading = read(optical, everywhere(1.0, 256, 64))
    seen = reading[reading.isfinite()]
    # Whole millimetres; sqrt(0.005^2 + 0.01^2 + 0.02^2) = 0.0229 m of spread at 1 m.
    torch.testing.assert_close(seen * 1000, (seen * 1000).round(), atol=1e-3, rtol=0)
    assert seen.std().item() == pytest.approx(0.0229, rel=0.05)
    assert read(optical, near).min() >= 0.02 - 1e-6
    # 4.5 m are beyond the range by five standard deviations of the reading.
    assert read(optical, far).isinf().float().mean() > 0.98
    # 25 cm are beyond 18 cm by two and a half.
    assert read(PRESETS["capacitive"](), beyond).isinf().float().mean() > 0.95
    # At 5 rad/s, 5 % and the dead hundredth are unseen.
    acoustic = read(PRESETS["acoustic"](), everywhere(1.0, 2048, 64), speed=5.0)
    assert acoustic.isinf().float().mean().item() == pytest.approx(0.0595, rel=0.05)


def test_a_restart_repeats_all_readings():
    corruption = Corruption(PRESETS["acoustic"](), dt=1 / 60, seed=1)
    env = TransformedEnv(
        DodgeballEnv(H1_2, TASK, num_envs=6, seed=0),
        Compose([FieldSensor(SKIN, H1_2.chain, BALLS, 6.0), corruption]),
    )

    def readings() -> torch.Tensor:
        env.set_seed(0, static_seed=True)
        data = env.rollout(20, lambda td: td.set("action", still), auto_reset=True)
        return data["reading"]

    still = torch.zeros(6, len(H1_2.joints))
    first = readings()
    # The seed of an environment does not reach its transforms.
    assert not torch.equal(readings(), first)
    corruption.restart()
    assert torch.equal(readings(), first)
    corruption.restart(seed=2)
    assert not torch.equal(readings(), first)
    corruption.restart(seed=1)
    assert torch.equal(readings(), first)
    with pytest.raises(ValueError, match="seed"):
        corruption.restart(seed=-1)


def test_a_step_makes_no_tensor_from_numbers(monkeypatch):
    # Each would be copied to a GPU.
    corruption = Corruption([Noise(constant=0.1)], dt=DT, seed=0)
    corruption.mask([1])
    rows, inputs = torch.arange(2), [torch.ones(2, 4, 1)]
    _, *state = corruption.start(rows, inputs, None)

    def refuse(*args, **kwargs):
        raise AssertionError("a tensor is made from numbers")

    monkeypatch.setattr(torch, "tensor", refuse)
    monkeypatch.setattr(torch.Tensor, "new_tensor", refuse)
    reading, clock, *_ = corruption.advance(rows, inputs, state)
    assert reading.isinf()[..., 0].tolist() == [[False, True, False, False]] * 2
    assert clock.tolist() == [[0, 1]] * 2


def test_a_clone_has_the_same_state_dict():
    corruption = Corruption([Noise(constant=0.1)], dt=DT, seed=0)
    before = list(corruption.state_dict())
    clone = corruption.clone()
    clone.mask([1])
    assert list(corruption.state_dict()) == list(clone.state_dict()) == before
    assert len(corruption._masked) == 0
    corruption.load_state_dict(clone.state_dict())


def test_episode_and_step_are_counted_from_reset_to_reset():
    corruption = Corruption([Noise(constant=0.1)], dt=DT, seed=0)
    done = torch.tensor([0, 0, 1, 0, 0, 0, 1, 0], dtype=torch.bool)[None, :, None]
    data = TensorDict(
        {"distance": torch.ones(1, 8, 4), "next": {"done": done}}, batch_size=[1, 8]
    )
    clock = corruption(data)["reading_clock"][0].tolist()
    expected = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (1, 3), (2, 0)]
    assert clock == [list(c) for c in expected]


def test_the_fastest_joint_sets_the_speed():
    distance = torch.ones(64, 64)
    joint_vel = torch.tensor([0.5, -3.0, 2.0]).expand(64, 3)
    noise = Noise(constant=0.01, per_speed=1.0)
    corruption = Corruption([noise], dt=DT, seed=5)
    assert corruption.in_keys == ["distance", "joint_vel"]
    got, *_ = corruption.start(torch.arange(64), [distance, joint_vel], None)
    assert torch.equal(got, read([noise], distance, speed=3.0))


def test_names_of_keys_follow_the_reading():
    models = [Latency(seconds=DT), Noise(constant=0.1), SampleAndHold(rate_hz=10)]
    names = ["reading", "reading_clock", "reading_0_queue"]
    names += ["reading_2_held", "reading_2_phase"]
    corruption = Corruption(models, dt=DT, seed=0)
    assert corruption.out_keys == names
    assert corruption.state_keys == names[1:]
    nested = Corruption(models, dt=DT, seed=0, out_keys=[("a", "reading")])
    assert nested.out_keys == [("a", name) for name in names]


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda: Bias(gain_std=-1), "Bias.gain_std must not be negative, got -1"),
        (lambda: Noise(linear=-1), "Noise.linear must not be negative, got -1"),
        (lambda: Noise(per_speed=-1), "Noise.per_speed must not be negative"),
        (lambda: Drift(constant=-1), "Drift.constant must not be negative"),
        (
            lambda: Dropout(probability=2),
            "Dropout.probability must be at most 1, got 2",
        ),
        (lambda: Dropout(probability=-1), "Dropout.probability must not be negative"),
        (lambda: Dropout(per_metre=-1), "Dropout.per_metre must not be negative"),
        (
            lambda: DeadSensors(probability=NAN),
            "DeadSensors.probability must be a finite number, got nan",
        ),
        (lambda: Latency(seconds=-1), "Latency.seconds must not be negative"),
        (lambda: SampleAndHold(rate_hz=0), "SampleAndHold.rate_hz must be positive"),
        (
            lambda: SampleAndHold(rate_hz=INF),
            "rate_hz must be a finite number, got inf",
        ),
        (lambda: Quantisation(step=0), "Quantisation.step must be positive"),
        (lambda: Quantisation(step=INF), "step must be a finite number, got inf"),
        (lambda: Bias(offset=NAN), "Bias.offset must be a finite number, got nan"),
        (
            lambda: Noise(constant=INF),
            "Noise.constant must be a finite number, got inf",
        ),
        (
            lambda: Latency(seconds=INF),
            "Latency.seconds must be a finite number, got inf",
        ),
        (
            lambda: replace(RangeLimits(), below="none"),
            "below must be one of nothing, minimum, got 'none'",
        ),
        (lambda: RangeLimits(minimum=-1), "RangeLimits.minimum must not be negative"),
        (lambda: RangeLimits(maximum=NAN), "RangeLimits.maximum must be a finite"),
        (lambda: RangeLimits(minimum=2, maximum=1), "minimum < maximum, got 2"),
        (
            lambda: FalsePositives(probability=0.1, max_range=INF),
            "FalsePositives.max_range must be a finite number, got inf",
        ),
        (lambda: Corruption([], dt=0, seed=0), "dt must be positive, got 0"),
        (lambda: Corruption([], dt=1, seed=-1), r"seed must be in \[0, 2\*\*32\)"),
        (lambda: Corruption([], dt=1, seed=2**33), f"got {2**33}"),
        (lambda: Corruption([], dt=1, seed=None), "seed must be an integer, got None"),
        (lambda: Corruption([Noise], dt=1, seed=0), "FrameModel instances, got"),
        (lambda: Corruption(Noise(), dt=1, seed=0), "FrameModel instances, got"),
        (lambda: Corruption(ALL * 6, dt=1, seed=0), "at most 64 models, got 66"),
        (
            lambda: Corruption([], dt=1, seed=0, in_keys=["a", "b"]),
            "in_keys must name distance, got",
        ),
    ],
)
def test_what_makes_no_sensor_is_refused(build, text):
    with pytest.raises(ValueError, match=text):
        build()
