"""The policies that come with the package: they load, and fit their environments."""

from __future__ import annotations

import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import egoskin
from egoskin.checkpoint import load_tensors, save_tensors
from egoskin.evaluation import evaluate, standard_task
from egoskin.policies import shipped_policies

ASSETS = Path(egoskin.__file__).parent / "assets" / "policies"


def test_all_files_of_the_folder_are_policies_known_by_name():
    assert shipped_policies() == sorted(path.stem for path in ASSETS.iterdir())
    assert "localization" in shipped_policies()


@pytest.mark.parametrize("name", shipped_policies())
def test_a_shipped_policy_acts_in_the_environment_it_was_trained_in(name, capsys):
    policy = egoskin.load_policy(name)
    # It has a seal, so there is nothing to be said of it.
    assert capsys.readouterr().err == ""
    assert policy.spec.frames > 0
    env = egoskin.make_worker_env(policy.env_config, policy.skin, num_envs=2, seed=0)
    td = policy(env.reset())
    assert td["action"].shape == env.action_spec.shape
    assert td["action"].isfinite().all()
    assert not env.step(td)["next", "diverged"].any()
    # Small enough to ship: a network of the paper's size, not a checkpoint.
    assert (ASSETS / f"{name}.safetensors").stat().st_size < 200_000


@pytest.mark.parametrize(
    "name", ["head.log_std", "head.body.inputs.0.weight", "norms.signal.mean"]
)
def test_a_file_that_lacks_a_tensor_is_refused(name, tmp_path):
    tensors, header = load_tensors(ASSETS / "field_proximity.safetensors")
    del tensors[f"agent/{name}"]
    save_tensors(tmp_path / "half.safetensors", tensors, header)
    with pytest.raises(ValueError, match=rf"half.*'{name}' of the networks is missing"):
        egoskin.load_policy(tmp_path / "half.safetensors")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sizes", {}),
        ("sizes", "many"),
        ("num_actions", "21"),
        ("frames", None),
        ("skin", {}),
    ],
)
def test_a_header_that_describes_no_policy_is_refused(field, value, tmp_path):
    tensors, header = load_tensors(ASSETS / "field_proximity.safetensors")
    header["policy"][field] = value
    save_tensors(tmp_path / "odd.safetensors", tensors, header)
    with pytest.raises(ValueError, match=r"odd.* holds no policy"):
        egoskin.load_policy(tmp_path / "odd.safetensors")


def test_a_header_without_a_policy_is_refused(tmp_path):
    tensors, _ = load_tensors(ASSETS / "field_proximity.safetensors")
    for header in ({}, {"policy": 5}, {"policy": None}):
        save_tensors(tmp_path / "odd.safetensors", tensors, header)
        with pytest.raises(ValueError, match=r"odd.* holds no policy"):
            egoskin.load_policy(tmp_path / "odd.safetensors")


def save_changed(path: Path, changes: dict[str, Any]) -> None:
    """Write a shipped policy with some tensors, or header fields, changed."""
    tensors, header = load_tensors(ASSETS / "field_proximity.safetensors")
    for name, change in changes.items():
        if name in header["policy"]:
            header["policy"][name] = change
        else:
            value = tensors[f"agent/{name}"]
            if isinstance(change, torch.dtype):
                tensors[f"agent/{name}"] = value.to(change)
            else:
                value.view(-1)[0] = change
    save_tensors(path, tensors, header)


@pytest.mark.parametrize(
    ("name", "number", "message"),
    [
        # Kept in float64, computed with in float32.
        ("norms.signal.mean", 1e300, "'norms.signal.mean' is not finite"),
        ("norms.observation.var", 1e300, "'norms.observation.var' is not finite"),
        ("norms.observation.var", -1.0, "'norms.observation.var' is negative"),
        ("head.log_std", float("nan"), "'head.log_std' is not finite"),
        ("head.log_std", 1e3, "actions need not be finite"),
        # Finite by themselves, not in use.
        ("head.body.inputs.0.weight", 3e38, "actions need not be finite"),
        ("head.body.inputs.1.weight", -3e38, "actions need not be finite"),
        ("head.body.tail.1.weight", 3e38, "actions need not be finite"),
        ("head.body.tail.3.bias", float("inf"), "'head.body.tail.3.bias' is not fini"),
        ("head.body.tail.3.weight", torch.float64, "got .21, 32. of float64"),
        ("norms.signal.mean", torch.float32, "expected .1. of float64, got .1. of"),
    ],
)
def test_numbers_that_give_no_finite_action_are_refused(
    name, number, message, tmp_path
):
    save_changed(tmp_path / "bad.safetensors", {name: number})
    with pytest.raises(ValueError, match=f"bad.safetensors.*{message}"):
        egoskin.load_policy(tmp_path / "bad.safetensors")


@pytest.mark.parametrize(
    "changes",
    [
        {"network": {"hidden": [10**7, 10**7]}},
        {"network": {"hidden": [32] * 10**5}},
        {"sizes": {"observation": 10**9, "signal": 64, "privileged_observation": 9}},
        {"num_actions": 10**12},
        {"num_actions": -1},
    ],
    ids=str,
)
def test_claims_of_a_header_take_no_memory(changes, tmp_path):
    path = tmp_path / "large.safetensors"
    if "network" in changes:
        _, header = load_tensors(ASSETS / "field_proximity.safetensors")
        changes = {"network": {**header["policy"]["network"], **changes["network"]}}
    save_changed(path, changes)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"large.*its header claims a size of"):
        egoskin.load_policy(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_sizes_that_the_tensors_do_not_have_are_refused(tmp_path):
    path = tmp_path / "other.safetensors"
    save_changed(path, {"num_actions": 22})
    with pytest.raises(ValueError, match=r"other.*expected \[22\] of .*, got \[21"):
        egoskin.load_policy(path)


def test_an_action_that_is_not_finite_ends_an_evaluation():
    policy = egoskin.load_policy("field_proximity")
    named = policy.named_parameters()
    (bias,) = (p for name, p in named if name.endswith("head.body.tail.3.bias"))
    with torch.no_grad():
        bias[4] = torch.nan
    config = standard_task(policy.env_config)
    with pytest.raises(ValueError, match="action is not finite at step 1"):
        evaluate(policy, config, policy.skin, bank_seed=0, episodes=4, num_workers=1)


def test_a_file_that_is_there_comes_before_a_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "localization").write_bytes(b"mine")
    with pytest.raises(ValueError, match="localization is"):
        egoskin.load_policy("localization")


@pytest.mark.parametrize(
    "name", ["localisation", "../localization", "localization.safetensors"]
)
def test_an_unknown_name_lists_those_there_are(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=rf"no policy {name}: .*localization"):
        egoskin.load_policy(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_policies())
def test_a_shipped_policy_loses_little_at_480_hz(name):
    # At 120 Hz a contact is as short as the solver lets it be: what a policy gains by
    # that alone is an exploit.
    policy = egoskin.load_policy(name)
    config = standard_task(policy.env_config)
    physics = replace(config.task.physics, substeps=8)
    finer = replace(config, task=replace(config.task, physics=physics))
    success = [
        evaluate(policy, c, policy.skin, bank_seed=0, episodes=1024).success.mean
        for c in (config, finer)
    ]
    assert success[0] - success[1] <= 0.05
