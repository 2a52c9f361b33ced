"""The table of state keys agrees with what the code does with them."""

from __future__ import annotations

import re

import torch

import egoskin
from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.envs.rewards import TERMS
from egoskin.envs.state import STATE, keys_read_by, state_table
from egoskin.make import EnvConfig, make_worker_env
from egoskin.robots.builtin import H1_2
from egoskin.runs.trainer import METRIC_KEYS
from egoskin.sensors.config import SensorConfig
from egoskin.sensors.tactile import ContactFree
from throwing import TASK

ROWS = {key.name: key for key in STATE}
SENSORS = (
    SensorConfig(),
    SensorConfig(corruption="acoustic"),
    SensorConfig(signal="localization"),
    SensorConfig(coverage="ray"),
    SensorConfig(coverage="oracle"),
)


def read_by_transforms(room: str) -> set[str]:
    """Return the table's keys that the transforms of a package read."""
    read = set()
    for sensor in SENSORS:
        config = EnvConfig(task=TASK, sensor=sensor, previous_action=True)
        env = make_worker_env(config, num_envs=1, seed=0)
        for transform in env.transform:  # pyright: ignore - a Compose
            if type(transform).__module__.startswith(f"egoskin.{room}"):
                read |= set(map(str, transform.in_keys))
    return read & ROWS.keys()


def test_the_readers_of_a_key_are_those_that_read_it():
    assert set(keys_read_by("observations")) == read_by_transforms("envs")
    touch = set(ContactFree(H1_2.links, ["*"]).in_keys)
    assert set(keys_read_by("sensors")) == read_by_transforms("sensors") | touch
    assert set(METRIC_KEYS) - {"reward", "terminated"} == set(keys_read_by("trainer"))


def test_only_what_somebody_reads_there_leaves_the_worker():
    config = EnvConfig(task=TASK)
    raw, sent = (
        make_worker_env(config, num_envs=2, seed=0, keep_raw=keep).reset()
        for keep in (True, False)
    )
    assert ROWS.keys() <= raw.keys()
    left = set(keys_read_by("trainer", "evaluation"))
    assert sent.keys() & ROWS.keys() == left
    assert left == {key.name for key in STATE if not key.stays_in_worker}


def test_what_tells_of_a_step_is_zero_at_a_reset_and_typed_as_declared():
    env = DodgeballEnv(H1_2, TASK, num_envs=3, seed=0)
    root = env.rollout(4, break_when_any_done=False)[:, -1].exclude("next")
    root["_reset"] = torch.tensor([[True], [False], [True]])
    after = env.reset(root)
    sizes = {"J": 21, "L": len(H1_2.links), "O": 2, "R": len(TERMS)}
    for key in STATE:
        value = after[key.name]
        assert value.dtype == key.dtype, key.name
        own = tuple(sizes.get(n, n) for n in key.shape)
        assert tuple(value.shape) == (3, *own), key.name
        if key.of_step:
            assert not value[::2].any(), key.name
            assert torch.equal(value[1], root[key.name][1]), key.name


def test_the_tables_of_the_documentation_are_the_table():
    text = DodgeballEnv.__doc__ or ""
    assert all(line in text for line in state_table().splitlines())
    section = egoskin.__doc__.split("DodgeballEnv` (")[1].split("\nfrom ")[0]
    rows = re.findall(r"^``(\w+)``\s+``\[\*(.*?)\]``.*?(\w+)$", section, re.M)
    assert len(rows) == 5
    for name, shape, reader in rows:
        own = ", ".join(str(n) for n in ("B", *ROWS[name].shape))
        assert shape == own
        assert reader in ("tactile", "sensors")
        assert "sensors" in ROWS[name].read_by
