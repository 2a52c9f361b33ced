"""The policies that come with the package: they load, and fit their environments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

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
    [("sizes", {}), ("sizes", "many"), ("num_actions", "21"), ("frames", None)],
)
def test_a_header_that_describes_no_policy_is_refused(field, value, tmp_path):
    tensors, header = load_tensors(ASSETS / "field_proximity.safetensors")
    header["policy"][field] = value
    save_tensors(tmp_path / "odd.safetensors", tensors, header)
    with pytest.raises(ValueError, match=r"odd.* holds no policy"):
        egoskin.load_policy(tmp_path / "odd.safetensors")


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
