"""Contract of all stateful transforms, whatever resets them, wherever they run."""

from __future__ import annotations

import math
import multiprocessing
from functools import partial

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    ParallelEnv,
    SelectTransform,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from egoskin.rng import Stream, uniform
from egoskin.sensors.history import History, KeepLast
from egoskin.sensors.imperfections.corruption import Corruption
from egoskin.sensors.imperfections.models import (
    Bias,
    DeadSensors,
    Drift,
    Dropout,
    FalsePositives,
    Latency,
    Noise,
    Quantisation,
    SampleAndHold,
)

SENSORS = 20
STEPS = 25
EVERYTHING = (
    Bias(offset_std=0.01, gain_std=0.1),
    Drift(constant=0.1),
    Noise(constant=0.01, per_speed=0.5),
    Noise(linear=0.1, common=True),
    Dropout(probability=0.1),
    FalsePositives(probability=0.05, max_range=1.0),
    DeadSensors(probability=0.1),
    Quantisation(step=0.001),
    SampleAndHold(rate_hz=3.0),
    Latency(seconds=0.2),
)


class ScriptedEnv(EnvBase):
    """Episodes of different lengths; all values depend on (row, episode, step).

    About 4 in 10 distances are finite and 1 in 50 is NaN.
    """

    def __init__(self, num_envs: int, row_offset: int = 0) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([num_envs]))
        self.row = torch.arange(num_envs) + row_offset
        self.episode = torch.full((num_envs,), -1)
        self.age = torch.zeros(num_envs, dtype=torch.int64)

        def unbounded(*shape: int) -> Unbounded:
            return Unbounded(shape=torch.Size((num_envs, *shape)), dtype=torch.float32)

        def flag(*shape: int) -> Binary:
            return Binary(shape=torch.Size((num_envs, *shape)), dtype=torch.bool)

        self.observation_spec = Composite(
            distance=unbounded(SENSORS),
            joint_vel=unbounded(3),
            signal=unbounded(3),
            object_detected=flag(2),
            shape=self.batch_size,
        )
        self.action_spec = unbounded(1)
        self.reward_spec = unbounded(1)
        self.done_spec = Composite(
            done=flag(1), terminated=flag(1), shape=self.batch_size
        )

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _state(self) -> TensorDict:
        size = SENSORS + 8
        u = uniform(99, Stream.START, self.row, self.episode, self.age, size)
        distance = u[:, :SENSORS] * 5
        distance = distance.masked_fill(distance > 2, math.inf)
        distance = distance.masked_fill(distance < 0.1, math.nan)
        done = (self.age >= 3 + (5 * self.row + self.episode) % 6)[:, None]
        return TensorDict(
            {
                "distance": distance,
                "joint_vel": u[:, -3:] - 0.5,
                "signal": u[:, -6:-3],
                "object_detected": u[:, -8:-6] < 0.2,
                "done": done,
                "terminated": done.clone(),
            },
            batch_size=self.batch_size,
        )

    def _reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: object
    ) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = slice(None) if mask is None else mask[:, 0]
        self.episode[rows] += 1
        self.age[rows] = 0
        return self._state()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.age += 1
        return self._state().set("reward", torch.zeros(*self.batch_size, 1))


BUILDERS = {
    "corruption": partial(Corruption, EVERYTHING, dt=0.1, seed=3),
    "one robot": partial(Corruption, EVERYTHING, dt=0.1, seed=3, redraw_traits=False),
    "history": partial(History, 3, ["distance", "signal"], ["distances", "signals"]),
    "last signal": partial(KeepLast),
}
every_transform = pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS)


def rows_from(build, row_offset: int):
    """A transform for a worker whose rows start at an offset."""
    of_rows = {"row_offset": row_offset} if build.func is Corruption else {}
    return build(**of_rows)


def make(build, num_envs: int, row_offset: int = 0) -> TransformedEnv:
    return TransformedEnv(
        ScriptedEnv(num_envs, row_offset), rows_from(build, row_offset)
    )


def run(env, root=None, steps: int = STEPS) -> list[TensorDict]:
    """Outputs of an environment, flat over rows: next, then root, by step."""
    out, root = [], env.reset() if root is None else root
    out.append(root.reshape(-1).clone())
    for _ in range(steps):
        root["action"] = torch.zeros(*root.batch_size, 1)
        step, root = env.step_and_maybe_reset(root)
        out += [step["next"].reshape(-1).clone(), root.reshape(-1).clone()]
    return out


def assert_same_bits(states, others, keys) -> None:
    for state, other in zip(states, others, strict=True):
        for key in keys:
            torch.testing.assert_close(
                state[key], other[key], rtol=0, atol=0, equal_nan=True, msg=str(key)
            )


@every_transform
@pytest.mark.parametrize("num_envs", [1, 5, 33])
def test_rows_follow_the_recurrence_under_staggered_resets(build, num_envs):
    # A row alone, in a plain loop: what the environment gives must be those bits,
    # whichever rows are computed or reset with it.
    transform = build()
    states = run(make(build, num_envs))
    ends = torch.stack([state["done"][:, 0] for state in states[1::2]])
    assert num_envs == 1 or (ends.any(1) & ~ends.all(1)).sum() >= 5
    for row in {0, num_envs // 2, num_envs - 1}:
        one = torch.tensor([row])

        def inputs(state):
            return [state[key][one] for key in transform.in_keys]  # noqa: B023

        def check(state, values):
            expected = dict(zip(transform.out_keys, values, strict=True))
            assert_same_bits([state[one]], [expected], transform.out_keys)  # noqa: B023

        values = transform.start(one, inputs(states[0]), None)
        check(states[0], values)
        for after, root in zip(states[1::2], states[2::2], strict=True):
            values = transform.advance(one, inputs(after), transform._state_of(values))
            check(after, values)
            if after["done"][row]:
                ended = transform._state_of(values)
                values = transform.start(one, inputs(root), ended)
            check(root, values)


@every_transform
@pytest.mark.parametrize("side", ["inside", "around"])
@pytest.mark.parametrize("workers", [2, 4])
def test_bits_do_not_depend_on_workers(build, side, workers):
    expected = run(make(build, 8), steps=15)
    each = 8 // workers
    offsets = range(0, 8, each)
    if side == "inside":
        env = SerialEnv(workers, [partial(make, build, each, i) for i in offsets])
    else:
        bases = [partial(ScriptedEnv, each, i) for i in offsets]
        env = TransformedEnv(SerialEnv(workers, bases), build())
    assert_same_bits(run(env, steps=15), expected, [*build().out_keys, "done"])
    env.close()


@pytest.mark.parametrize("side", ["inside", "around"])
def test_the_state_travels_to_processes_and_back(side):
    build = BUILDERS["corruption"]
    multiprocessing.set_forkserver_preload(["egoskin.make"])
    options = {"mp_start_method": "forkserver"}
    if side == "inside":
        builders = [partial(make, build, 4, i) for i in (0, 4)]
        env = ParallelEnv(2, builders, **options)
    else:
        bases = [partial(ScriptedEnv, 4, i) for i in (0, 4)]
        env = TransformedEnv(ParallelEnv(2, bases, **options), build())
    try:
        states = run(env)
    finally:
        env.close()
    assert_same_bits(states, run(make(build, 8)), [*build().out_keys, "done"])


@every_transform
def test_a_clone_of_a_used_transform_starts_anew_with_any_number_of_rows(build):
    used = make(build, 4)
    run(used)
    for rows in (1, 4, 8):
        env = TransformedEnv(ScriptedEnv(rows), used.transform.clone())
        keys = used.transform.out_keys
        assert_same_bits(run(env), run(make(build, rows)), keys)


def test_a_new_seed_for_a_clone_is_its_own():
    build = BUILDERS["corruption"]
    transform = build()
    transform.clone().restart(seed=7)
    env = TransformedEnv(ScriptedEnv(4), transform)
    assert_same_bits(run(env), run(make(build, 4)), transform.out_keys)


@every_transform
def test_environment_keeps_its_specs(build):
    env = make(build, 3)
    check_env_specs(env)
    for key in build().state_keys:
        assert key in env.full_state_spec.keys(True)
        assert env.full_state_spec[key] == env.observation_spec[key]


@every_transform
def test_a_saved_root_continues_bit_for_bit(build):
    env = make(build, 5)
    states = run(env, steps=11)
    saved = states[-1].clone()
    base = env.base_env
    clock = [x.clone() for x in (base.row, base.episode, base.age)]
    expected = run(env, saved.clone())

    other = make(build, 5)
    root = other.reset()
    root.update(saved)
    other.base_env.row, other.base_env.episode, other.base_env.age = clock
    assert_same_bits(run(other, root), expected, [*build().out_keys, "done"])


@every_transform
def test_an_explicit_partial_reset_keeps_the_state_of_other_rows(build):
    env = make(build, 5)
    root = run(env, steps=2)[-1]
    before = root.clone()
    mask = torch.tensor([True, False, False, True, False])
    after = env.reset(root.set("_reset", mask[:, None]))
    for key in build().state_keys:
        kept = before[key][~mask]
        assert torch.equal(after[key][~mask].nan_to_num(-1), kept.nan_to_num(-1)), key


@every_transform
def test_a_row_reset_after_another_goes_on_from_its_own_state(build):
    # Row by row, or both at once, without a step between.
    envs = make(build, 3), make(build, 3)
    for env in envs:
        for _ in range(3):
            env.reset()

    def mask(*rows: int) -> TensorDict:
        flags = torch.zeros(3, 1, dtype=torch.bool)
        flags[list(rows)] = True
        return TensorDict({"_reset": flags}, [3])

    apart, together = envs
    apart.reset(mask(0))
    one, both = apart.reset(mask(2)), together.reset(mask(0, 2))
    assert_same_bits(one[2:], both[2:], build().out_keys)


@every_transform
@pytest.mark.parametrize("marked_by", ["done", "is_init"])
def test_stored_steps_give_what_the_environment_gave(build, marked_by):
    env = make(build, 5)
    data = env.rollout(STEPS, break_when_any_done=False)
    assert data.batch_size == (5, STEPS)
    transform = build()
    stored = data.select(*transform.in_keys, ("next", "done"))
    if marked_by == "is_init":
        done = stored.pop("next")["done"]
        first = torch.ones_like(done[:, :1])
        stored["is_init"] = torch.cat((first, done[:, :-1]), 1)
    assert_same_bits([transform(stored)], [data], transform.out_keys)


@every_transform
def test_stored_data_must_say_where_episodes_start(build):
    data = make(build, 5).rollout(3)
    with pytest.raises(KeyError, match="unknown starts of episodes"):
        build()(data.select(*build().in_keys))
    with pytest.raises(ValueError, match="last batch dimension is time"):
        build()(data[0, 0])


@every_transform
def test_nested_keys_and_float64_change_no_value(build):
    plain = build()
    data = make(build, 5).rollout(STEPS, break_when_any_done=False)
    ins = [("robot_1", key) for key in plain.in_keys]
    # A corruption chooses the names of its state keys.
    outs = plain.out_keys[: 1 if build.func is Corruption else None]
    outs = [("robot_1", key) for key in outs]
    # Keys can be given as positional arguments.
    arguments = build.args[:1]
    nested = build.func(*arguments, in_keys=ins, out_keys=outs, **build.keywords)
    stored = data.select(("next", "done"))
    for key in plain.in_keys:
        stored["robot_1", key] = data[key]
    nested(stored)
    for key in plain.out_keys:
        assert torch.equal(
            stored["robot_1", key].nan_to_num(-1), data[key].nan_to_num(-1)
        )

    double = data.select(("next", "done"))
    for key in plain.in_keys:
        value = data[key]
        double[key] = value.double() if value.is_floating_point() else value
    plain(double)
    for key in plain.out_keys:
        if data[key].is_floating_point():
            assert double[key].dtype == torch.float64
        # A millimetre may be rounded to the next, once in ten thousand readings.
        close = torch.isclose(
            double[key].double(), data[key].double(), atol=1e-5, equal_nan=True
        )
        assert close.float().mean() > 0.999, key


@every_transform
def test_inputs_and_earlier_states_are_never_written(build):
    env = make(build, 5)
    root = env.reset()
    kept = []
    for _ in range(8):
        root["action"] = torch.zeros(5, 1)
        kept.append((root, root.clone()))
        step, root = env.step_and_maybe_reset(root)
        kept.append((step, step.clone()))
    for now, then in kept:
        keys = [*env.transform.in_keys, *env.transform.out_keys]
        assert_same_bits([now], [then], keys)


class AutoResetEnv(EnvBase):
    """Episodes of 4 and 5 steps, which the environment itself resets in its step."""

    def __init__(self) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([2]))
        flag = Binary(shape=(2, 1), dtype=torch.bool)
        self.observation_spec = Composite(obs=Unbounded((2, 1)), shape=(2,))
        self.action_spec, self.reward_spec = Unbounded((2, 1)), Unbounded((2, 1))
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=(2,))
        self.time = torch.zeros(2, 1)
        self._torchrl_native_autoreset = True

    def _content(self, done: torch.Tensor) -> TensorDict:
        flags = {"done": done, "terminated": done.clone()}
        return TensorDict({"obs": self.time.clone(), **flags}, batch_size=[2])

    def _reset(self, tensordict=None, **kwargs) -> TensorDict:
        self.time.zero_()
        return self._content(torch.zeros(2, 1, dtype=torch.bool))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.time += 1
        done = self.time >= torch.tensor([[4], [5]])
        self.time[done] = 0
        return self._content(done).set("reward", torch.zeros(2, 1))

    def _set_seed(self, seed: int | None) -> None:
        pass


def test_rows_that_the_environment_resets_itself_start_anew():
    env = TransformedEnv(AutoResetEnv(), History(3, ["obs"], ["history"]))
    env._torchrl_native_autoreset = True
    now = env.reset()
    for step in range(1, 12):
        now["action"] = torch.zeros(2, 1)
        _, now = env.step_and_maybe_reset(now)
        for row, length in enumerate((4, 5)):
            age = step % length
            expected = [max(age - back, 0) for back in (2, 1, 0)]
            assert now["history"][row].tolist() == expected, (step, row)


def test_stored_data_may_have_no_rows():
    data = {
        "distance": torch.zeros(0, 6, SENSORS),
        "is_init": torch.zeros(0, 6, 1, dtype=torch.bool),
    }
    stored = TensorDict(data, batch_size=[0, 6])
    read = Corruption(EVERYTHING[:2], dt=0.02, seed=0)(stored)
    assert read["reading"].shape == (0, 6, SENSORS)


@every_transform
def test_a_later_transform_that_drops_the_state_is_refused(build):
    env = make(build, 3)
    env.rollout(3)
    kept = build().state_keys
    env.append_transform(SelectTransform("joint_vel", *kept[1:]))
    with pytest.raises(ValueError, match=rf"drops \['{kept[0]}'\], which the next"):
        env.rollout(3)
    env = make(build, 3)
    env.append_transform(SelectTransform("joint_vel", *kept))
    env.rollout(3)


class Seen(Transform):
    """Claims to write its out keys; keeps what it is given at a reset."""

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self.last = tensordict_reset.clone()
        return tensordict_reset

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict


@every_transform
def test_a_later_transform_that_changes_the_state_is_refused(build):
    env = make(build, 3)
    state = build().state_keys[0]
    env.append_transform(Compose(Seen([state], [state])))
    text = rf"Seen after \w+ changes \['{state}'\], which the next step reads back"
    with pytest.raises(ValueError, match=text):
        env.rollout(3)
    env = make(build, 3)
    env.append_transform(Compose(Seen([state], [])))
    env.rollout(3)


@every_transform
def test_rows_that_do_not_reset_keep_their_last_values(build):
    env = make(build, 3)
    root = env.reset()
    for _ in range(2):
        root["action"] = torch.zeros(3, 1)
        root = env.step_mdp(env.step(root))
    seen = Seen([], [])
    env.append_transform(seen)
    root["_reset"] = torch.tensor([[True], [False], [False]])
    env.reset(root.clone())
    assert_same_bits([seen.last[1:]], [root[1:]], build().out_keys)


@every_transform
def test_stored_data_without_steps_is_refused(build):
    td = make(build, 3).rollout(3, break_when_any_done=False)
    with pytest.raises(ValueError, match=r"at least one step, got \[3, 0\]"):
        build()(td[:, :0])
