"""File formats: damage is detected, older files load, newer ones are refused."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save

import egoskin
from egoskin.commands.verify import run_hash
from egoskin.envs.randomization import RandomizationConfig
from egoskin.envs.throws import ThrowConfig
from egoskin.make import EnvConfig
from egoskin.runs.config import TrainConfig, parse_config
from egoskin.runs.run import Run
from egoskin.runs.trainer import open_trainer, train
from egoskin.storage.formats import (
    FORMAT,
    content_hash,
    migrate,
    read_sealed,
    seal,
    sealed_json,
    unseal,
)
from egoskin.storage.serialization import to_plain
from egoskin.storage.tensor_file import load_tensors, save_tensors
from making import blind_run

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run of two rollouts of 64 frames; tests copy it."""
    run = Run.create(blind_run(tmp_path_factory.mktemp("formats") / "run", 128))
    with open_trainer(run) as trainer:
        train(trainer)
    return run.path


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "run"))


def rewrite(file: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a sealed JSON file and seal it again."""
    content, _ = read_sealed(file)
    change(content)
    file.write_bytes(sealed_json(content))


def resume(path: Path) -> None:
    """Resume a finished run: no training is left."""
    config = parse_config(["--resume", str(path)])
    with open_trainer(Run(path, config)) as trainer:
        train(trainer)


# --- damage -----------------------------------------------------------------------


def damage(content: bytes, draw: random.Random) -> bytes:
    """Flip bits, cut, zero, overwrite with noise, delete or repeat a part."""
    spoilt = bytearray(content)
    start = draw.randrange(len(spoilt))
    end = min(len(spoilt), start + draw.choice([1, 8, 100, 4096]))
    kind = draw.choice(["bit", "bit", "zeros", "noise", "cut", "lost", "twice"])
    if kind == "bit":
        spoilt[start] ^= 1 << draw.randrange(8)
    elif kind == "zeros":
        spoilt[start:end] = bytes(end - start)
    elif kind == "noise":
        spoilt[start:end] = draw.randbytes(end - start)
    elif kind == "cut":
        del spoilt[start:]
    elif kind == "lost":
        del spoilt[start:end]
    else:
        spoilt[start:start] = spoilt[start:end]
    return bytes(spoilt)


def policy_content(path: Path) -> Any:
    policy = egoskin.load_policy(path)
    tensors = {k: v.tolist() for k, v in policy.state_dict().items()}
    return policy.policy_spec.header(), tensors


def checkpoint_content(path: Path) -> Any:
    tensors, header = Run.open(path.parent).load_checkpoint()
    return header, content_hash(None, tensors)


def skin_content(path: Path) -> Any:
    return Run.open(path.parent).load_skin().to_dict()


READERS: dict[str, Callable[[Path], Any]] = {
    "checkpoint.safetensors": checkpoint_content,
    "policies/000000000128.safetensors": policy_content,
    "config.json": lambda path: Run.open(path.parent).config,
    "skin.json": skin_content,
    "versions.json": lambda path: Run.open(path.parent).starts(),
    "metrics.csv": lambda path: Run.open(path.parent).metrics(),
}


def test_every_file_of_a_run_is_read_by_a_test_of_damage(trained: Path):
    files = {str(p.relative_to(trained)) for p in trained.rglob("*") if p.is_file()}
    others = {f for f in files if f == "lock" or f.startswith("events.out.tfevents")}
    # Nothing reads the lock; each record of the events has its own checksum.
    assert files - others - {"policies/000000000000.safetensors"} == READERS.keys()


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_of_a_run_never_loads_changed(name: str, run: Path):
    file, read = run / name, READERS[name]
    content, expected = file.read_bytes(), read(run / name)
    draw, refused = random.Random(0), 0
    for _ in range(200):
        spoilt = damage(content, draw)
        file.write_bytes(spoilt)
        found, refusal = expected, None
        try:
            found = read(file)
        except ValueError as error:
            refusal = str(error)
        # White space in JSON may change without effect; the log of metrics is restored
        # from the checkpoint.
        assert found == expected, spoilt
        assert refusal is None or file.name in refusal
        refused += refusal is not None
    assert name == "metrics.csv" or refused > 150


def rewrite_header(run: Path, **changes: Any) -> None:
    tensors, header = load_tensors(run / "checkpoint.safetensors")
    save_tensors(run / "checkpoint.safetensors", tensors, {**header, **changes})


@pytest.mark.parametrize("name", ["config", "starts", "policy"])
@pytest.mark.parametrize("value", [5, "x", None])
def test_what_a_checkpoint_holds_must_be_of_its_kind(name, value, run: Path):
    rewrite_header(run, **{name: value})
    with pytest.raises(
        ValueError, match=r"checkpoint\.safetensors (is damaged|is not a policy)"
    ):
        egoskin.load_policy(run) if name == "policy" else Run.open(
            run
        ).load_checkpoint()


@pytest.mark.parametrize("content", [{}, {"starts": 5}, {"starts": None}])
def test_a_log_of_starts_that_holds_none_is_named(content, run: Path):
    (run / "versions.json").write_bytes(sealed_json(content))
    with pytest.raises(
        ValueError, match=r"versions\.json is damaged .* starts must be"
    ):
        Run.open(run).starts()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("num_envs", 10**9, "num_envs must be at most"),
        ("seed", 10**400, "seed must fit into 64 bits"),
        ("checkpoint_interval", 10**400, "a number with hundreds of digits"),
    ],
    ids=["agents", "whole", "float"],
)
def test_a_number_too_large_in_a_stored_configuration_is_named(
    field, value, message, run: Path
):
    rewrite(run / "config.json", lambda content: content.update({field: value}))
    with pytest.raises(ValueError, match=rf"config\.json: {message}"):
        Run.open(run)


def test_json_nested_too_deep_is_named(run: Path):
    for content in ("[" * 100_000 + "]" * 100_000, '{"a":' * 900 + "1" + "}" * 900):
        (run / "config.json").write_text(content)
        with pytest.raises(ValueError, match=r"config\.json"):
            Run.open(run)


def test_no_order_of_keys_matters():
    content = {"b": [1, 2.5, "x"], "a": {"d": None, "c": True}}
    tensors = {"y": torch.ones(2), "x": torch.zeros(3, dtype=torch.int64)}
    turned = {"a": {"c": True, "d": None}, "b": [1, 2.5, "x"]}
    assert content_hash(content, tensors) == content_hash(
        turned, dict(reversed(tensors.items()))
    )


@pytest.mark.parametrize(
    "other",
    [
        {"x": torch.zeros(3)},
        {"y": torch.zeros(2)},
        {"x": torch.zeros(2, dtype=torch.int32)},
        {"x": torch.zeros(2, 1)},
        {"x": torch.tensor([0.0, -0.0])},
        {},
    ],
    ids=["size", "name", "type", "shape", "bytes", "none"],
)
def test_whatever_differs_of_a_tensor_differs_in_the_hash(other):
    assert content_hash(None, {"x": torch.zeros(2)}) != content_hash(None, other)


@pytest.mark.parametrize("key", ["sha256", "format", "egoskin"])
def test_a_seal_that_lost_a_part_is_none(key: str):
    content = seal({"x": 1})
    del content[key]
    with pytest.raises(ValueError, match=r"my\.json is damaged or was edited"):
        unseal(content, "my.json")


# --- older and newer files ----------------------------------------------------------


def test_a_newer_format_names_the_egoskin_it_needs(run: Path):
    for file in (run / "config.json", run / "checkpoint.safetensors"):
        content = file.read_bytes()
        # Both hold JSON; in a header its quotes are escaped.
        for quote in (b'"', b'\\"'):
            now = b"format" + quote + b": %d" % FORMAT
            content = content.replace(now, b"format" + quote + b": 9")
        file.write_bytes(content)
    message = r"config\.json has format 9, .* use egoskin 0\.1\.0 or later"
    with pytest.raises(ValueError, match=message):
        Run.open(run)
    with pytest.raises(ValueError, match=r"checkpoint\.safetensors has format 9"):
        egoskin.load_policy(run)


def unsealed(run: Path) -> None:
    """Rewrite the files of a run as they were in format 1."""
    config, _ = read_sealed(run / "config.json")
    del config["skin_sha256"]
    throws = config["env"]["task"]["throws"]
    throws.update(aim="body")
    del throws["first_delay"]
    config["env"]["sensor"]["numb"] = False
    config.update(core_frames=[0, 0], slow_start=0.4, compile_kernels=True)
    (run / "config.json").write_text(json.dumps(config))
    starts = Run(run, TrainConfig()).starts()
    (run / "versions.json").write_text(json.dumps(starts))
    tensors, header = load_tensors(run / "checkpoint.safetensors")
    del tensors["log/metrics"], header["config"], header["starts"]
    content = save(tensors, metadata={"egoskin": json.dumps(header)})
    (run / "checkpoint.safetensors").write_bytes(content)


def test_a_configuration_of_format_1_throws_as_it_did_and_is_noted_once(
    run: Path, capsys
):
    unsealed(run)
    Run.open(run)
    throws = Run.open(run).config.env.task.throws
    assert throws.first_delay == (0.0, 0.0) != ThrowConfig().first_delay
    assert throws.aim == "body"
    for _ in range(2):
        assert len(Run.open(run).starts()) == 1
    lines = capsys.readouterr().err.splitlines()
    for line, name in zip(lines, ("config.json", "versions.json"), strict=True):
        assert line.startswith(f"note: {run / name} was written by an egoskin without")


def test_a_run_of_format_1_goes_on_and_is_sealed(run: Path, capsys):
    metrics = (run / "metrics.csv").read_bytes()
    unsealed(run)
    # A row from after the checkpoint, and a truncated one.
    with open(run / "metrics.csv", "ab") as file:
        file.write(metrics.splitlines(keepends=True)[-1].replace(b"128", b"192", 1))
        file.write(b"256,1.")
    resume(run)
    notes = capsys.readouterr().err.splitlines()
    assert len(notes) == 3
    assert all("without checksums" in note for note in notes)
    assert (run / "metrics.csv").read_bytes() == metrics
    resume(run)
    assert len(Run.open(run).starts()) == 3
    assert capsys.readouterr().err == ""


def test_an_option_that_is_no_more_is_refused_where_it_had_an_effect(run: Path):
    unsealed(run)
    config = json.loads((run / "config.json").read_text())
    config["core_frames"] = [0, 7]
    (run / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"config\.json was made with core_frames="):
        Run.open(run)


def test_a_migration_leaves_alone_what_is_there_and_makes_no_parts():
    throws = {"aim": "box", "first_delay": [0, 1], "shape": "sphere", "size": []}
    given = {"env": {"task": {"throws": throws}}}
    same, _ = migrate(given, 1)
    assert same["env"]["task"].pop("randomization")["gains"] == [1.0, 1.0]
    assert same == given
    assert migrate({"ppo": {"gamma": 0.9}}, 1) == ({"ppo": {"gamma": 0.9}}, {})
    bare, _ = migrate({"env": {}}, 1)
    throws = {"aim": "body", "first_delay": [0.0, 0.0], "shape": "sphere", "size": []}
    assert bare["env"]["task"]["throws"] == throws
    now = {"env": {}, "core_frames": [0, 0]}
    assert migrate(now, FORMAT) == (now, {})


def rewrite_as_format(
    number: int, run: Path, field: str, value: Any, monkeypatch, *, in_policy: bool
):
    """Write a run in an older format, which lacks a field ("a.b") of this value."""
    config, checkpoint = run / "config.json", run / "checkpoint.safetensors"
    content, _ = read_sealed(config)
    tensors, header = load_tensors(checkpoint)
    holders = [content, header["config"]]
    holders += [header["policy"]] * in_policy
    *path, name = field.split(".")
    for part in holders:
        for inner in path:
            part = part[inner]
        assert part.pop(name) == value
    with monkeypatch.context() as patch:
        patch.setattr("egoskin.storage.formats.FORMAT", number)
        config.write_bytes(sealed_json(content))
        save_tensors(checkpoint, tensors, header)
    assert read_sealed(config)[1] == number


def test_a_run_of_format_4_was_simulated_by_mujoco(run: Path, monkeypatch):
    rewrite_as_format(4, run, "engine", "mujoco", monkeypatch, in_policy=True)
    resume(run)
    assert Run.open(run).config.engine == "mujoco"
    assert egoskin.load_policy(run).policy_spec.engine == "mujoco"


def test_a_run_of_format_5_started_from_new_networks(run: Path, monkeypatch):
    rewrite_as_format(5, run, "init_from", None, monkeypatch, in_policy=False)
    resume(run)


def test_in_a_run_of_format_6_spheres_were_thrown(run: Path, monkeypatch):
    field = "env.task.throws.shape"
    rewrite_as_format(6, run, field, "sphere", monkeypatch, in_policy=True)
    resume(run)
    policy = egoskin.load_policy(run)
    assert policy.env_config.task.throws.shape == "sphere"


@pytest.mark.parametrize(
    ("number", "name", "gone", "effect"),
    [
        (1, "core_frames", [0, 0], [0, 7]),
        (1, "drift_frames", [0, 0], [10, 20]),
        (1, "slow_start_frames", 0, 7),
        (1, "told_next_first", False, True),
        (1, "env.sensor.numb", False, True),
        (2, "env.sensor.field.measure", "surface", "centre"),
        (2, "env.sensor.ray.fov", "diagonal", "axes"),
        (2, "env.sensor.ray.beams", "centres", "edges"),
        (2, "env.sensor.ray.sub_beams", 1, 4),
        (2, "env.sensor.per_object", False, True),
        (2, "env.sensor.validity", False, True),
        (2, "env.sensor.localization.over_range", False, True),
        (2, "env.sensor.localization.frame", "base", "world"),
    ],
)
def test_an_older_file_that_measured_or_learnt_otherwise_is_not_read_as_one_of_today(
    number, name, gone, effect
):
    *path, key = name.split(".")
    for value, retired in ((gone, {}), (effect, {name: effect})):
        config: dict[str, Any] = {"env": {"sensor": {"range": 1.0}}}
        inner: Any = config
        for part in path:
            inner = inner.setdefault(part, {})
        inner[key] = value
        present, found = migrate(config, number)
        assert found == retired
        assert present["env"]["sensor"]["range"] == 1.0
        inner = present
        for part in path:
            inner = inner.get(part, {})
        assert key not in inner


def test_before_there_was_randomisation_there_was_none():
    old, _ = migrate({"env": {}}, 3)
    ranges = old["env"]["task"]["randomization"].items()
    config = RandomizationConfig(**{name: tuple(value) for name, value in ranges})
    assert not config.varies_robot
    assert not config.pushes
    assert config.delay_steps == (0, 0)


@pytest.mark.parametrize(
    ("name", "gone", "effect"),
    [
        ("task.one_action_scale", None, 0.2),
        ("task.clip_targets", False, True),
        ("task.physics.self_collision", True, False),
        ("task.physics.solver_iterations", 10, 100),
        ("task.throws.mass", 0.4, 1.0),
        ("task.throws.speed_is", "horizontal", "total"),
        ("task.throws.on_ground", "inactive", "bounce"),
    ],
)
def test_an_option_of_format_2_goes_and_is_told_where_it_had_an_effect(
    name, gone, effect
):
    for value, retired in ((gone, {}), (effect, {f"env.{name}": effect})):
        config = {"env": to_plain(EnvConfig())}
        *path, key = name.split(".")
        inner = config["env"]
        for part in path:
            inner = inner[part]
        assert key not in inner
        inner[key] = value
        assert migrate(config, 2) == ({"env": to_plain(EnvConfig())}, retired)


def test_sensor_options_of_format_2_go_or_have_another_name():
    position = {"hold": True, "frame": "base", "over_range": False}
    sensor = {"validity": False, "ray": {"sub_beams": 1, "grid": [4, 4]}}
    old = {"env": {"sensor": {**sensor, "localization": position}}}
    sensor = {"keep_last": True, "ray": {"grid": [4, 4]}}
    present, retired = migrate(old, 2)
    assert (present["env"]["sensor"], retired) == (sensor, {})
    position["frame"] = "torso"
    assert migrate(old, 2)[1] == {"env.sensor.localization.frame": "torso"}


def test_stored_policies_without_a_seal_load_and_say_so(capsys):
    path = (
        ROOT / "studies/version-1/results/blind-seed0/policies/000065536000.safetensors"
    )
    throws = egoskin.load_policy(path).env_config.task.throws
    assert (throws.first_delay, throws.aim) == ((0.0, 0.0), "body")
    egoskin.load_policy(path)
    assert len(capsys.readouterr().err.splitlines()) == 1


# --- edited files -------------------------------------------------------------------


def test_an_edited_file_of_a_run_is_not_gone_on_with(run: Path):
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**config, "seed": 1}))
    with pytest.raises(ValueError, match=r"config\.json is damaged or was edited"):
        resume(run)


def test_a_configuration_that_was_sealed_again_is_not_what_was_trained(run: Path):
    rewrite(run / "config.json", lambda content: content.update(seed=1))
    message = r"config\.json is not what .*checkpoint.* trained with.*\(changed: seed\)"
    with pytest.raises(ValueError, match=message):
        resume(run)


def test_an_edited_skin_is_not_gone_on_with(run: Path):
    file = run / "skin.json"
    skin = json.loads(file.read_text())
    skin["sensors"][3]["position"][0] += 0.001
    file.write_text(json.dumps(skin))
    with pytest.raises(ValueError, match=r"skin\.json is damaged or was edited"):
        resume(run)
    # The hash in config.json is updated as well; the checkpoint has its own.
    rewrite(run / "config.json", lambda c: c.update(skin_sha256=content_hash(skin)))
    message = r"skin\.json is not the skin that .*checkpoint.* was trained with"
    with pytest.raises(ValueError, match=message):
        resume(run)


def test_a_skin_is_checked_before_there_is_a_checkpoint(run: Path):
    for name in ("checkpoint.safetensors", "metrics.csv"):
        (run / name).unlink()
    skin = json.loads((run / "skin.json").read_text())
    skin["sensors"].pop()
    (run / "skin.json").write_text(json.dumps(skin))
    with pytest.raises(ValueError, match=r"skin\.json is damaged or was edited"):
        resume(run)


# --- what may change at a resume ----------------------------------------------------


def test_machine_settings_may_change_at_a_resume_and_change_nothing(
    trained: Path, run: Path
):
    machine = {
        "num_workers": 2,
        "learner_threads": 2,
        "checkpoint_interval": 5.0,
        "snapshot_frames": 64,
    }
    args = [f"--{k.replace('_', '-')}={v}" for k, v in machine.items()]
    args += ["--resume", str(run), "--total-frames", "192"]
    config = parse_config(args)
    assert {k: getattr(config, k) for k in machine} == machine
    with open_trainer(Run(run, config)) as trainer:
        train(trainer)
    assert Run.open(run).config.num_workers == 2
    # The same result as resuming without changes.
    other = Path(shutil.copytree(trained, run.with_name("other")))
    plain = parse_config(["--resume", str(other), "--total-frames", "192"])
    with open_trainer(Run(other, plain)) as trainer:
        train(trainer)
    assert run_hash(Run.open(run)) == run_hash(Run.open(other))


@pytest.mark.parametrize(
    ("args", "names"),
    [
        (["--device", "cuda"], "device"),
        (["--num-envs", "8"], "num_envs"),
        (["--seed", "1", "--sensor.range", "1"], "sensor.range, seed"),
    ],
)
def test_what_changes_results_may_not(args: list[str], names: str, run: Path):
    with pytest.raises(ValueError, match=f"changed: {names}. Only .*--num-workers"):
        parse_config(["--resume", str(run), *args])


def test_a_library_user_cannot_change_results_either(run: Path):
    config = replace(Run.open(run).config, seed=3)
    with (
        pytest.raises(ValueError, match="changed: seed"),
        open_trainer(Run(run, config)),
    ):
        pass


# --- logs ---------------------------------------------------------------------------


def test_a_removed_or_damaged_log_is_made_again(run: Path, capsys):
    metrics = (run / "metrics.csv").read_bytes()
    before = Run.open(run).starts()
    (run / "metrics.csv").unlink()
    (run / "versions.json").unlink()
    resume(run)
    assert (run / "metrics.csv").read_bytes() == metrics
    assert Run.open(run).starts()[:1] == before
    assert capsys.readouterr().err == ""
    (run / "metrics.csv").write_bytes(b"\0" + metrics[1:])
    (run / "versions.json").write_text("{}")
    resume(run)
    assert (run / "metrics.csv").read_bytes() == metrics
    assert (run / "metrics-damaged-1.csv").read_bytes() == b"\0" + metrics[1:]
    assert Run.open(run).starts()[:1] == before
    assert len(Run.open(run).starts()) == 3
    assert (run / "versions-damaged-1.json").read_text() == "{}"
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_a_log_removed_while_a_run_trains_is_made_again(run: Path):
    args = ["--resume", str(run), "--total-frames", "192"]
    with open_trainer(Run(run, parse_config(args))) as trainer:
        (run / "metrics.csv").unlink()
        train(trainer)
    assert len((run / "metrics.csv").read_text().splitlines()) == 4


def test_the_header_of_a_file_of_tensors_is_sealed_with_them(tmp_path: Path):
    path = tmp_path / "x.safetensors"
    save_tensors(path, {"a": torch.zeros(3)}, {"frames": 3})
    content = path.read_bytes()
    path.write_bytes(content.replace(b'frames\\": 3', b'frames\\": 4'))
    with pytest.raises(ValueError, match=r"x\.safetensors is damaged or was edited"):
        load_tensors(path)


def test_a_plain_configuration_is_what_comes_back(run: Path):
    content, number = read_sealed(run / "config.json")
    assert number == FORMAT
    del content["skin_sha256"]
    assert content == to_plain(Run.open(run).config)
