"""Contract of all transforms: offline, in an environment, around workers."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import Binary as BinarySpec
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.envs.observations import Oracle, Privileged, Proprioception, approaches_b
from egoskin.envs.physics.contract import GRAVITY
from egoskin.make import EnvConfig, make_worker_env
from egoskin.robots.builtin import H1_2
from egoskin.sensors import (
    MASK_ALL,
    BeamMinimum,
    Binary,
    Corruption,
    Field,
    FieldSensor,
    History,
    KeepLast,
    Localization,
    Proximity,
    RaySensor,
    Tactile,
    place_sensors,
)
from egoskin.sensors.config import SensorConfig
from egoskin.transform import RowTransform, StatefulTransform
from throwing import TASK, assert_same, wild_actions

SKIN = place_sensors(H1_2, 12, seed=0)
BALLS = TASK.throws.balls
DEFAULT = torch.from_numpy(H1_2.default_joint_pos)
JOINTS = len(H1_2.joints)

BUILDERS = {
    "field": partial(FieldSensor, SKIN, H1_2.chain, BALLS, 1.0),
    "field, cone, occluded": partial(
        FieldSensor,
        SKIN,
        H1_2.chain,
        BALLS,
        1.0,
        Field(half_angle_deg=70),
        body=H1_2.primitives,
    ),
    "ray": partial(RaySensor, SKIN, H1_2.chain, BALLS, 1.0),
    "ray, reduced": partial(RaySensor, SKIN, H1_2.chain, BALLS, 1.0, reduce="min"),
    "ray, each object": partial(
        RaySensor, SKIN, H1_2.chain, BALLS, 1.0, per_object=True
    ),
    "proximity": partial(Proximity, 1.0),
    "closeness": partial(Proximity, 1.0, closeness=True),
    "binary": Binary,
    "localization": Localization,
    "proprioception": partial(Proprioception, DEFAULT),
    "proprioception, action": partial(
        Proprioception,
        DEFAULT,
        in_keys=(*Proprioception.STATE_KEYS, "previous_action"),
    ),
    "oracle": Oracle,
    "privileged objects": partial(Privileged, "objects", GRAVITY),
    "privileged velocity": partial(Privileged, "velocity", GRAVITY),
}
every_transform = pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS)


@pytest.fixture(scope="module")
def full_state(random_state):
    """Function like random_state, with the field sensor's results added."""

    def draw(n: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> TensorDict:
        return BUILDERS["field"]()(random_state(n, seed, dtype))

    return draw


def select(state: TensorDict, keys) -> TensorDict:
    return TensorDict({key: state[key] for key in keys}, batch_size=state.batch_size)


# --- offline --------------------------------------------------------------------


@every_transform
def test_works_offline_with_a_time_dimension(build, full_state):
    transform, state = build(), full_state(5 * 32)
    ins = transform.in_keys
    flat = transform(select(state, ins))
    stored = transform(select(state, ins).reshape(5, 32))
    assert stored.batch_size == (5, 32)
    assert_same(stored.reshape(-1), flat)


@every_transform
def test_works_without_a_batch(build, full_state):
    transform, state = build(), full_state(1)
    expected = transform(select(state, transform.in_keys))
    single = transform(select(state, transform.in_keys)[0])
    for key in transform.out_keys:
        torch.testing.assert_close(single[key], expected[key][0])


@every_transform
def test_nested_and_custom_keys_change_no_value(build, full_state):
    plain, state = build(), full_state(32)
    expected = plain(select(state, plain.in_keys))
    for rename in (lambda k: f"my_{k}", lambda k: ("robot_1", "raw", k)):
        ins = [rename(key) for key in plain.in_keys]
        outs = [rename(key) for key in plain.out_keys]
        transform = build(in_keys=ins, out_keys=outs)
        given_ = TensorDict({}, batch_size=[32])
        for new, old in zip(ins, plain.in_keys, strict=True):
            given_[new] = state[old]
        result = transform(given_)
        for new, old in zip(outs, plain.out_keys, strict=True):
            assert torch.equal(result[new], expected[old])
        assert all(key not in result.keys() for key in plain.out_keys)


@every_transform
def test_float64_gives_float64_of_the_same_value(build, full_state):
    transform = build()
    single = transform(select(full_state(32), transform.in_keys))
    double = transform(select(full_state(32, dtype=torch.float64), transform.in_keys))
    for key in transform.out_keys:
        floating = single[key].is_floating_point()
        assert double[key].dtype == (torch.float64 if floating else torch.bool)
        torch.testing.assert_close(
            double[key].float(), single[key].float(), atol=1e-5, rtol=1e-5
        )


@every_transform
def test_a_missing_key_is_named(build, full_state):
    transform, state = build(), full_state(4)
    missing = transform.in_keys[-1]
    name = type(transform).__name__
    state = select(state, transform.in_keys[:-1])
    with pytest.raises(KeyError, match=f"{name} reads '{missing}', which .* lacks"):
        transform(state)


def test_specs_are_by_default_those_of_the_results():
    class Split(RowTransform):
        def __init__(self) -> None:
            super().__init__(in_keys=["x"], out_keys=["y", "flag"])

        def compute(self, *inputs) -> Any:
            return inputs[0][:, :2].double(), inputs[0][:, 0] > 0

    spec = Composite(x=Unbounded((2, 4, 3)), shape=[2, 4])
    specs = Split().transform_observation_spec(spec)
    assert specs["y"] == Unbounded((2, 4, 2), dtype=torch.float64)
    assert specs["flag"] == BinarySpec(shape=torch.Size((2, 4)), dtype=torch.bool)


@pytest.mark.parametrize("given", ["bare", "two"])
@pytest.mark.parametrize("method", ["compute", "out_specs"])
def test_results_that_are_not_one_for_each_key_are_refused(method, given):
    class Doubled(RowTransform):
        """A typical first transform: a single result without a tuple."""

        def __init__(self) -> None:
            super().__init__(in_keys=["x"], out_keys=["y"])

        def compute(self, *inputs) -> Any:
            return self.wrong("compute", 2 * inputs[0])

        def out_specs(self, spec) -> Any:
            return self.wrong("out_specs", spec["x"].clone())

        def wrong(self, name, result):
            if name != method:
                return (result,)
            return result if given == "bare" else (result, result)

    got = "tuple of 2" if given == "two" else r"(Tensor|UnboundedContinuous)$"
    expected = rf"Doubled\.{method} must return a tuple with .* \['y'\], got {got}"
    asked = {
        "compute": (Doubled(), TensorDict({"x": torch.ones(1, 3)}, [1])),
        "out_specs": (
            Doubled().transform_observation_spec,
            Composite(x=Unbounded((1, 3)), shape=[1]),
        ),
    }
    ask, given_to_it = asked[method]
    with pytest.raises(TypeError, match=expected):
        ask(given_to_it)


class Summed(StatefulTransform):
    """The sum of an input over an episode, by an author who may make mistakes."""

    def __init__(self, mistake: str = "", state_keys: Sequence[str] = ("sum",)) -> None:
        super().__init__(in_keys=["x"], out_keys=["sum"], state_keys=state_keys)
        self._mistake = mistake

    def start(self, rows, inputs, before) -> Any:
        return inputs[0] if self._mistake == "start, bare" else (inputs[0],)

    def advance(self, rows, inputs, state) -> Any:
        total = state[0] + inputs[0]
        return {
            "advance, bare": total,
            "advance, none": (),
            "advance, a row": (total[:1],),
            "advance, a number": (total.sum(),),
        }.get(self._mistake, (total,))


def test_results_of_a_transform_with_a_state_are_checked():
    values, done = torch.arange(6.0).reshape(2, 3, 1), torch.zeros(2, 3, 1) > 0
    data = TensorDict({"x": values, "next": {"done": done}}, [2, 3])
    assert torch.equal(Summed()(data)["sum"], values.cumsum(1))
    for mistake, error, message in (
        ("start, bare", TypeError, r"Summed\.start must return a tuple .* got Tensor"),
        ("advance, bare", TypeError, r"Summed\.advance must return a tuple .*Tensor"),
        ("advance, none", TypeError, r"Summed\.advance must return .* got tuple of 0"),
        (
            *("advance, a row", ValueError),
            r"Summed\.advance must .* a row for each of the 2 .* \[1, 1\] for 'sum'",
        ),
        ("advance, a number", ValueError, r"got \[\] for 'sum'"),
    ):
        with pytest.raises(error, match=message):
            Summed(mistake)(data)


def test_what_another_transform_writes_is_not_overwritten():
    sensor = FieldSensor(SKIN, H1_2.chain, BALLS, 1.0)
    spec = Composite(distance=Unbounded((1, 12)), shape=[1])
    spec = Proximity(sensor).transform_observation_spec(spec)
    with pytest.raises(ValueError, match="Binary would overwrite 'signal', which it"):
        Binary(sensor).transform_observation_spec(spec)
    spec = Binary(sensor, out_keys=["seen"]).transform_observation_spec(spec)
    assert {"signal", "seen"} < {*spec.keys()}


def test_measurements_without_the_dimension_that_is_reduced_are_refused():
    data = TensorDict({"distance": torch.ones(4, 12)}, [4])
    with pytest.raises(ValueError, match=r"BeamMinimum needs beams, .* is \[\*B, 12\]"):
        BeamMinimum()(data)
    with pytest.raises(ValueError, match=r"'distance' must be \[\*B, S, \.\.\.\], got"):
        Proximity(1.0)(TensorDict({"distance": torch.ones(4)}, [4]))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Summed(state_keys=("total",)), r"state_keys must be among the out_ke"),
        (lambda: Summed(state_keys="sum"), "state_keys must be a list of keys, got"),
        # Only `Proximity` and `Binary` take the sensor.
        (
            lambda: Localization(FieldSensor(SKIN, H1_2.chain, BALLS, 1.0)),
            r"in_keys must be a list of keys, got FieldSensor\(",
        ),
        (lambda: History(3, "signal"), "in_keys must be a list of keys, got 'signal'"),
        (lambda: History(3, ["a"], "b"), "out_keys must be a list of keys, got 'b'"),
        (
            lambda: Corruption([], dt=1, seed=0, in_keys="distance"),
            "in_keys must be a list of keys, got 'distance'",
        ),
        (
            lambda: Corruption([], dt=1, seed=0, out_keys=["a", "b"]),
            r"out_keys must be a list of 1, got \['a', 'b'\]",
        ),
        # A nested key in place of a list of one.
        (
            lambda: Proximity(1.0, in_keys=("next", "distance")),
            r"in_keys must be a list of 1, got \['next', 'distance'\]",
        ),
        (lambda: Binary(in_keys=["a", "b"], out_keys=["c", "d"]), "in_keys must be a"),
        (
            lambda: Proximity(1.0, out_keys=[]),
            r"out_keys must be a list of 1, got \[\]",
        ),
        (lambda: BeamMinimum(["a", "b"]), "in_keys must be a list of 1, got"),
        (
            lambda: Localization(["a"]),
            r"in_keys must be a list of at least 4, got \['a",
        ),
        (lambda: KeepLast(["signal"]), "in_keys must be a list of at least 2, got"),
        (lambda: Oracle(["base_pose"]), "in_keys must be a list of 5, got"),
        (lambda: Tactile(1.0, ["a", "b"]), "in_keys must be a list of 1, got"),
    ],
)
def test_keys_of_a_wrong_kind_or_number_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_transform_before_what_it_reads_names_the_key():
    sensor = FieldSensor(SKIN, H1_2.chain, BALLS, 1.0)
    spec = Composite(base_pose=Unbounded((1, 7)), shape=[1])
    expected = "Proximity needs 'distance', which nothing before it writes"
    with pytest.raises(KeyError, match=expected):
        Proximity(sensor).transform_observation_spec(spec)


@every_transform
def test_inputs_are_never_written(build, full_state):
    transform, state = build(), full_state(32)
    state = select(state, transform.in_keys)
    before = state.clone()
    result = transform(state)
    assert set(result.keys()) == {*transform.in_keys, *transform.out_keys}
    # Writing to a result must not reach an input either.
    for key in transform.out_keys:
        result[key].fill_(1)
    assert_same(select(state, transform.in_keys), before)


@every_transform
def test_results_are_those_of_the_spec(build, full_state):
    transform, state = build(), full_state(8)
    spec = Composite(
        {
            key: Unbounded(shape=value.shape, dtype=value.dtype)
            for key, value in state.items()
        },
        shape=[8],
    )
    for key in transform.out_keys:
        spec.pop(key, None)
    spec = transform.transform_observation_spec(spec)
    result = transform(select(state, transform.in_keys))
    for key in transform.out_keys:
        assert spec[key].is_in(result[key]), key


@every_transform
@given(st.lists(st.booleans(), min_size=64, max_size=64))
def test_a_reset_computes_the_rows_that_reset_to_the_same_bits(build, full_state, mask):
    transform, state = build(), full_state(64)
    state = select(state, transform.in_keys)
    full = transform(state.clone())
    mask = torch.tensor(mask)
    asked = TensorDict({"_reset": mask[:, None]}, batch_size=[64])
    partial_ = transform._reset(asked, state)
    for key in transform.out_keys:
        assert torch.equal(partial_[key][mask], full[key][mask])
        # The other rows are the environment's to fill in: nothing was computed there
        # (but one row, if none resets, so that shapes are known).
        others = ~mask
        others[0] = False
        assert not partial_[key][others].any()


@every_transform
def test_rows_that_do_not_reset_keep_their_last_values(build, full_state):
    # Transforms with statistics of all rows, as VecNormV2, read them.
    transform = build()
    before, after = (select(full_state(64, s), transform.in_keys) for s in (0, 1))
    last = transform._step(before, before.clone())
    new = build()(after.clone())
    mask = torch.arange(64) % 7 == 3
    asked = TensorDict({"_reset": mask[:, None]}, batch_size=[64])
    reset = transform._reset(asked, after.clone())
    for key in transform.out_keys:
        assert torch.equal(reset[key][mask], new[key][mask])
        assert torch.equal(reset[key][~mask], last[key][~mask])
    # A clone knows nothing of them, and may have another number of rows.
    some = after[:32].clone()
    reset = transform.clone()._reset(asked[:32], some)
    for key in transform.out_keys:
        assert torch.equal(reset[key][mask[:32]], new[key][:32][mask[:32]])


@every_transform
def test_a_reset_works_on_batches_of_workers(build, full_state):
    transform, state = build(), full_state(64)
    state = select(state, transform.in_keys).reshape(4, 16)
    full = transform(state.clone())
    mask = torch.zeros(4, 16, 1, dtype=torch.bool)
    mask[1, 3] = mask[2, :5] = True
    asked = TensorDict({"_reset": mask}, batch_size=[4, 16])
    partial_ = transform._reset(asked, state)
    rows = mask[..., 0]
    for key in transform.out_keys:
        assert partial_[key].shape == full[key].shape
        assert torch.equal(partial_[key][rows], full[key][rows])


def test_privileged_refuses_the_wrong_number_of_keys():
    with pytest.raises(ValueError, match="in_keys must name base_pose, base_lin_vel_w"):
        Privileged("velocity", GRAVITY, in_keys=["base_pose"])


# --- layouts by hand ------------------------------------------------------------

HALF = 0.5**0.5


def tensors(**values) -> TensorDict:
    return TensorDict(
        {
            k: torch.as_tensor(v)[None]
            if isinstance(v, torch.Tensor)
            else torch.tensor([v])
            for k, v in values.items()
        },
        batch_size=[1],
    )


def test_proprioception_by_hand():
    # Rolled +90 deg about x: the world's z is the base's y, so gravity is its -y.
    deviation = torch.linspace(-1, 1, JOINTS)
    velocity = torch.linspace(5, 6, JOINTS)
    state = tensors(
        base_pose=[7.0, 8, 9, HALF, HALF, 0, 0],
        base_ang_vel_b=[0.1, 0.2, 0.3],
        joint_pos=DEFAULT.float() + deviation,
        joint_vel=velocity,
    )
    observation = BUILDERS["proprioception"]()(state)["observation"][0]
    assert observation.shape == (48,)  # 3 + 21 + 21 + 3
    torch.testing.assert_close(observation[:3], torch.tensor([0.1, 0.2, 0.3]))
    torch.testing.assert_close(observation[3:24], deviation)
    torch.testing.assert_close(observation[24:45], velocity)
    torch.testing.assert_close(
        observation[45:], torch.tensor([0.0, -1, 0]), atol=1e-6, rtol=0
    )


def privileged_state() -> TensorDict:
    # Base at (1, 0, 1), turned +90 deg about z: its x is the world's y, its y the -x.
    return tensors(
        base_pose=[1.0, 0, 1, HALF, 0, 0, HALF],
        base_lin_vel_w=[0.0, 2, 0.5],
        displacement_w=[1.0, 0],
        previous_action=torch.arange(JOINTS, dtype=torch.float32),
        object_pose=[[1.0, 3, 2, 1, 0, 0, 0], [5.0, 5, 5, 1, 0, 0, 0]],
        object_lin_vel_w=[[-4.0, 2, 0], [1.0, 1, 1]],
        object_active=[True, False],
    )


def test_privileged_objects_by_hand():
    result = BUILDERS["privileged objects"]()(privileged_state())
    observation = result["privileged_observation"][0]
    expected = [
        *(2, 0, 0.5),  # base velocity
        *(0, -1, 0),  # displacement (1, 0) in the base frame
        *range(JOINTS),  # previous action
        # First ball: (0, 3, 1) from the base is (3, 0, 1); its velocity relative to
        # the base (-4, 0, -.5) is (0, 4, -.5); active.
        *(3, 0, 1, 0, 4, -0.5, 1),
        *(0,) * 7,  # the second ball is not in play
        # It flies past in the base's y: now it is as near as it gets, 3 m ahead.
        *(1, 3, 0, 1),
        *(0,) * 4,
        1,  # height of the base
    ]
    torch.testing.assert_close(observation, torch.tensor(expected).float())


@pytest.mark.parametrize("gravity", [GRAVITY, 0.0])
def test_an_approach_is_where_the_ball_will_be(gravity):
    # A ball that was thrown at a base which walks and is turned: simulated on.
    base_pose = torch.tensor([[1.0, 2, 1, HALF, 0, 0, HALF]]).double()
    base_velocity = torch.tensor([[0.5, -0.25, 0.0]]).double()
    ball = torch.tensor([[[5.0, 2.5, 2.0]]]).double()
    velocity = torch.tensor([[[-6.0, 0.0, 1.0]]]).double()
    times = torch.linspace(0, 2, 20_001).double()[:, None]
    flown = ball[0] + velocity[0] * times
    flown[:, 2] -= 0.5 * gravity * times[:, 0] ** 2
    offset = flown - (base_pose[:, :3] + base_velocity * times)
    nearest = int(offset[:, :2].norm(dim=-1).argmin())
    dx, dy, dz = offset[nearest]
    pose = torch.cat((ball, torch.tensor([[[1.0, 0, 0, 0]]]).double()), -1)
    active = torch.tensor([[True]])

    def approach(velocity: torch.Tensor) -> torch.Tensor:
        state = (base_pose, base_velocity, pose, velocity, active)
        return approaches_b(*state, gravity=gravity)[0]

    expected = torch.stack((0.3 / (0.3 + times[nearest, 0]), dy, -dx, dz))
    torch.testing.assert_close(approach(velocity), expected, atol=1e-3, rtol=0)
    # A ball that flies away is nearest now.
    expected = torch.tensor([1.0, 0.5, -3.0, 1.0]).double()
    torch.testing.assert_close(approach(-velocity), expected)


def test_an_approach_is_told_for_two_seconds_ahead_and_three_metres_around():
    # Balls at 1 m/s: one comes from 2.5 m ahead, one flies past at 5 m to the left.
    pose = torch.tensor([[[2.5, 0, 0.5, 1, 0, 0, 0], [1.0, 5, 0.5, 1, 0, 0, 0]]])
    velocity = torch.tensor([[[-1.0, 0, 0], [-1.0, 0, 0]]])
    base_pose = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]])
    active = torch.ones(1, 2, dtype=torch.bool)
    told = approaches_b(
        base_pose, torch.zeros(1, 3), pose, velocity, active, gravity=0.0
    )
    # After 2 s the first is 0.5 m away; the second is nearest after 1 s.
    expected = torch.tensor([[0.3 / 2.3, 0.5, 0, 0.5, 0.3 / 1.3, 0, 3, 0.5]])
    torch.testing.assert_close(told, expected)


def test_an_oracle_is_told_of_every_ball_by_hand():
    state = privileged_state()
    state["object_active"][:] = True
    expected = [
        *(3, 0, 1, 0, 4, -0.5, 1),  # as above
        # (4, 5, 4) from the base is (5, -4, 4); the velocity relative to the base
        # (1, -1, 0.5) is (-1, -1, 0.5).
        *(5, -4, 4, -1, -1, 0.5, 1),
    ]
    signal = BUILDERS["oracle"]()(state)["signal"][0]
    torch.testing.assert_close(signal, torch.tensor(expected).float())


def test_an_oracle_sees_what_the_critic_sees(full_state):
    state = full_state(64)
    told = BUILDERS["privileged objects"]()(state.clone())["privileged_observation"]
    assert torch.equal(BUILDERS["oracle"]()(state)["signal"], told[:, -23:-9])


def test_privileged_velocity_by_hand():
    result = BUILDERS["privileged velocity"]()(privileged_state())
    torch.testing.assert_close(
        result["privileged_observation"][0], torch.tensor([2, 0, 0.5])
    )


def test_privileged_does_not_see_an_inactive_object():
    build, state = BUILDERS["privileged objects"], privileged_state()
    expected = build()(state.clone())["privileged_observation"]
    state["object_pose"][:, 1] += 100
    state["object_lin_vel_w"][:, 1] -= 3
    assert torch.equal(build()(state)["privileged_observation"], expected)


# --- in an environment ----------------------------------------------------------

SENSORS = {
    "proximity": SensorConfig(),
    "localization": SensorConfig(signal="localization"),
    "binary": SensorConfig(signal="binary", range=0.5),
    "infinite": SensorConfig(range=float("inf")),
    "blind": SensorConfig(coverage="none"),
    "oracle": SensorConfig(coverage="oracle"),
    "ray": SensorConfig(coverage="ray", signal="closeness"),
    "ray, last": SensorConfig(coverage="ray", signal="localization", keep_last=True),
    "cone, real, hidden": SensorConfig(
        field=Field(half_angle_deg=60), corruption="acoustic", occlusion=True
    ),
    "ray, reduced, real": SensorConfig(
        coverage="ray", reduce="min", corruption="time_of_flight"
    ),
}


def run(env, steps: int) -> list[TensorDict]:
    """Outputs of an environment under fixed actions, flat over its rows."""
    out, root = [], env.reset()
    for action in wild_actions(root.numel(), 100)[:steps]:
        root["action"] = action.reshape(*root.batch_size, JOINTS)
        step, root = env.step_and_maybe_reset(root)
        out += [step["next"].reshape(-1).clone(), root.reshape(-1).clone()]
    return out


FORMS = {name: {"sensor": sensor} for name, sensor in SENSORS.items()}
FORMS |= {
    "history": {"sensor": SENSORS["binary"], "history": 3},
    "velocity": {"sensor": SENSORS["oracle"], "privileged": "velocity"},
    "previous action": {"sensor": SENSORS["blind"], "previous_action": True},
}


@pytest.mark.parametrize("form", FORMS)
def test_environment_keeps_its_specs(form):
    config = EnvConfig(task=TASK, **FORMS[form])
    for keep_raw in (False, True):
        env = make_worker_env(config, SKIN, num_envs=6, seed=0, keep_raw=keep_raw)
        check_env_specs(env)


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("keep_raw", [False, True])
def test_masked_sensors_detect_nothing_and_the_critic_still_observes(sparse, keep_raw):
    # Within 5 m of the body nearly all balls are detected.
    sensor = SensorConfig(coverage="ray", range=5.0)
    sensing, masked = (
        make_worker_env(
            EnvConfig(task=TASK, sensor=sensor),
            SKIN,
            num_envs=6,
            seed=0,
            sparse=sparse,
            keep_raw=keep_raw,
            mask=mask,
        )
        for mask in ((), MASK_ALL)
    )
    sensed = False
    for one, other in zip(run(sensing, 40), run(masked, 40), strict=True):
        assert torch.equal(one["done"], other["done"])
        key = "privileged_observation"
        assert torch.equal(one[key], other[key])
        if sparse or keep_raw:
            assert not other["object_active"].any()
        if not sparse:
            assert (other["signal"] == 1).all()
        sensed |= bool((one["object_active"] if sparse else one["signal"] < 1).any())
    assert sensed
    check_env_specs(masked)


@pytest.mark.parametrize(
    ("signal", "content"),
    [("proximity", "objects"), ("localization", "velocity"), ("binary", "objects")],
)
def test_signals_are_those_of_the_state_under_staggered_resets(signal, content):
    # Fixed actions, rows that end at different steps: what stands in the tensordict
    # must always be what the raw state beside it gives offline.
    sensor = SensorConfig(signal=signal)
    config = EnvConfig(task=TASK, sensor=sensor, privileged=content)
    env = make_worker_env(config, SKIN, num_envs=6, seed=0, keep_raw=True)
    ended = []
    for state in run(env, 70):
        ended.append(state["done"][:, 0].clone())
        for transform in env.transform:  # pyright: ignore - a Compose
            again = transform(select(state, transform.in_keys))
            for key in transform.out_keys:
                torch.testing.assert_close(state[key], again[key])
    per_step = torch.stack(ended[::2]).sum(1)
    assert ((per_step > 0) & (per_step < 6)).sum() >= 3  # partial resets happened


@every_transform
def test_a_reset_gives_its_rows_what_all_rows_give_them(build, full_state):
    transform, state = build(), full_state(50)
    state = select(state, transform.in_keys)
    whole = transform(state.clone())
    mask = torch.arange(50)[:, None] % 7 == 3
    reset = TensorDict({"_reset": mask}, [50])
    part = transform._reset(reset, state.clone())
    for key in transform.out_keys:
        assert torch.equal(part[key][mask[:, 0]], whole[key][mask[:, 0]])


def test_a_reset_on_another_device_waits_for_nothing(full_state):
    # Nothing can be read on the meta device.
    state = full_state(8).to("meta")
    reset = TensorDict({"_reset": torch.ones(8, 1, dtype=torch.bool)}, [8]).to("meta")
    out = BUILDERS["proprioception"]().to("meta")._reset(reset, state)
    assert out["observation"].shape == (8, 6 + 2 * JOINTS)


def test_the_actor_observes_its_previous_action_only_if_asked():
    plain, told = (
        make_worker_env(config, SKIN, num_envs=6, seed=0, keep_raw=True)
        for config in (EnvConfig(task=TASK), EnvConfig(task=TASK, previous_action=True))
    )
    check_env_specs(told)
    taken = set()
    told.set_seed(0, static_seed=True)
    for state, other in zip(run(plain, 70), run(told, 70), strict=True):
        action = state["previous_action"]
        taken.update(action.any(-1).tolist())
        expected = torch.cat((state["observation"], action), -1)
        assert torch.equal(other["observation"], expected)
    # None at the start of an episode.
    assert taken == {False, True}


def outside(config: EnvConfig, parallel, **kwargs) -> TransformedEnv:
    """Transforms around two base environments of three rows."""
    bases = [
        partial(DodgeballEnv, H1_2, config.task, num_envs=3, seed=5, row_offset=i)
        for i in (0, 3)
    ]
    gravity = config.task.throws.gravity
    transforms = [
        Proprioception(DEFAULT),
        Privileged("objects", gravity),
        *config.pipeline(SKIN).transforms(BALLS, dt=1 / 60),
    ]
    return TransformedEnv(parallel(2, bases, **kwargs), Compose(*transforms))


@pytest.fixture(scope="module")
def inside_run() -> list[TensorDict]:
    """Transforms in the environment itself: the reference of the next tests."""
    return run(make_worker_env(EnvConfig(task=TASK), SKIN, num_envs=6, seed=5), 60)


OBSERVED = ("observation", "privileged_observation", "signal")


@pytest.mark.parametrize(
    ("parallel", "options"),
    [(SerialEnv, {}), (ParallelEnv, {"mp_start_method": "forkserver"})],
    ids=["serial", "parallel"],
)
def test_transforms_around_workers_give_what_they_give_inside(
    inside_run, parallel, options
):
    # The workers import only once.
    multiprocessing.set_forkserver_preload(["egoskin.make"])
    env = outside(EnvConfig(task=TASK), parallel, **options)
    try:
        states = run(env, 60)
    finally:
        env.close()
    assert any(state["done"].any() for state in states)
    for state, expected in zip(states, inside_run, strict=True):
        for key in (*OBSERVED, "done", "episode_step"):
            torch.testing.assert_close(state[key], expected[key])


def test_a_static_seed_reaches_the_environments_of_all_workers(inside_run):
    env = outside(EnvConfig(task=TASK), SerialEnv)
    env.set_seed(99, static_seed=True)
    other = run(env, 1)
    assert not torch.equal(other[0]["observation"], inside_run[0]["observation"])
    env.set_seed(5, static_seed=True)
    for state, expected in zip(run(env, 10), inside_run, strict=False):
        for key in OBSERVED:
            torch.testing.assert_close(state[key], expected[key])
    env.close()


# --- inputs of the actor --------------------------------------------------------


def test_the_actor_reads_its_observation_and_the_signal_alone():
    assert EnvConfig().actor_keys == ["observation", "signal"]
    blind = EnvConfig(sensor=SensorConfig(coverage="none"))
    assert blind.actor_keys == ["observation"]
    for config in (EnvConfig(), blind):
        assert config.critic_keys == [*config.actor_keys, "privileged_observation"]
    env = make_worker_env(EnvConfig(), SKIN, num_envs=2, seed=0)
    assert env.observation_spec["observation"].shape == (2, 48)
    assert env.observation_spec["signal"].shape == (2, len(SKIN))


ACTORS = {
    "field": SensorConfig(range=5.0),
    "localization": SensorConfig(range=5.0, signal="localization"),
    "ray": SensorConfig(range=5.0, coverage="ray"),
    "corrupted": SensorConfig(range=5.0, corruption="time_of_flight"),
    "blind": SensorConfig(coverage="none"),
    "oracle": SensorConfig(coverage="oracle"),
}


@pytest.mark.parametrize("sensor", ACTORS.values(), ids=ACTORS)
def test_nothing_tells_the_actor_when_the_first_ball_comes(sensor):
    """Before the throw, the actor's inputs do not depend on the delay."""
    found = []
    for delay in ((0.5, 0.8), (1.5, 2.0), (30.0, 40.0)):
        throws = replace(TASK.throws, first_delay=delay)
        config = EnvConfig(task=replace(TASK, throws=throws), sensor=sensor, history=2)
        env = make_worker_env(config, SKIN, num_envs=6, seed=0, keep_raw=True)
        states = run(env, 60)
        waiting = [~s["object_active"].any(-1) for s in states]
        found.append((config.actor_keys, states, torch.stack(waiting)))
    (keys, early, still_early), (_, late, still_late), (_, never, always) = found
    assert always.all()
    for states, waiting in ((early, still_early), (late, still_late)):
        # Until the first ball of each row, through falls and new starts.
        waiting = waiting.cumprod(0).bool()
        assert waiting.sum(0).min() >= 2 * 29
        for state, expected, rows in zip(states, never, waiting, strict=True):
            for key in keys:
                assert torch.equal(state[key][rows], expected[key][rows]), key
    assert not still_early.all()


@pytest.mark.parametrize("signal", ["proximity", "localization", "binary"])
def test_the_actor_sees_nothing_that_it_may_not(random_state, signal):
    """Allowed: angular velocity, joints, gravity, and where the ball is in range."""
    config = EnvConfig(task=TASK, sensor=SensorConfig(signal=signal))
    env = make_worker_env(config, SKIN, num_envs=32, seed=0, keep_raw=True)
    env.reset()
    state = env.rollout(3)[:, -1].select(*random_state(1).keys())
    other = random_state(32, seed=1)
    changed = state.clone()
    forbidden = (
        "base_lin_vel_w",
        "object_lin_vel_w",
        "displacement_w",
        "previous_action",
    )
    for key in forbidden:
        changed[key] = other[key]
    # The whole scene moved over the floor and turned about the vertical.
    yaw, shift = 1.1, torch.tensor([3.0, -2.0, 0.0])
    c, s = np.cos(yaw), np.sin(yaw)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]]).float()
    for key in ("base_pose", "object_pose"):
        changed[key][..., :3] = state[key][..., :3] @ turn.T + shift
    w, x, y, z = state["base_pose"][:, 3:].unbind(-1)
    c, s = np.cos(yaw / 2), np.sin(yaw / 2)
    turned = (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)
    changed["base_pose"][:, 3:] = torch.stack(turned, -1)

    seen, seen_changed = (env.transform(td.clone()) for td in (state, changed))
    for key in config.actor_keys:
        torch.testing.assert_close(seen_changed[key], seen[key], atol=1e-5, rtol=0)
    key = "privileged_observation"
    assert not torch.isclose(seen_changed[key], seen[key]).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"engine": "MuJoCo"}, "engine must be one of mujoco, warp, got 'MuJoCo'"),
        ({"device": "cuda:99"}, "no device 'cuda:99'"),
    ],
)
def test_an_unknown_engine_or_device_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make_worker_env(EnvConfig(), num_envs=2, seed=0, **options)


@pytest.mark.parametrize(
    ("flight", "gravity"), [("straight", 0.0), ("ballistic", GRAVITY)]
)
def test_the_critic_knows_how_balls_fly(flight, gravity):
    task = replace(TASK, throws=replace(TASK.throws, flight=flight))
    env = make_worker_env(EnvConfig(task=task), SKIN, num_envs=2, seed=0)
    assert isinstance(env.transform, Compose)
    (privileged,) = (t for t in env.transform if isinstance(t, Privileged))
    assert privileged._gravity == gravity
