"""Networks of a policy or run, trained further in another run: ``--init-from``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
import torch

import egoskin
from egoskin.agents.networks import NetworkConfig
from egoskin.robots.builtin import H1_2
from egoskin.robots.portable import portable
from egoskin.runs.config import parse_config
from egoskin.runs.run import Run
from egoskin.runs.trainer import Trainer, open_trainer, train
from egoskin.storage.formats import read_sealed
from egoskin.storage.tensor_file import load_tensors
from making import blind_run, remove_critic


def networks_of(file: Path) -> dict[str, torch.Tensor]:
    """Return the tensors of the networks in a policy or checkpoint."""
    tensors, _ = load_tensors(file)
    return {name: value for name, value in tensors.items() if "agent/" in name}


def test_a_run_goes_on_from_the_networks_of_another(finished: Trainer, tmp_path: Path):
    first = finished.run.path
    config = blind_run(tmp_path / "run", 64)
    run = Run.create(replace(config, init_from=first, seed=5))
    with open_trainer(run) as trainer:
        assert trainer.frames == 0
        # Nothing else is taken.
        assert trainer.ppo.state() == {}
        assert trainer.ppo.learning_rate == config.ppo.learning_rate
        start = networks_of(run.checkpoint_path)
        train(trainer)
    before = networks_of(first / "checkpoint.safetensors")
    assert any(name.startswith("agent/critic.") for name in before)
    torch.testing.assert_close(start, before, rtol=0, atol=0)
    now = networks_of(run.checkpoint_path)
    assert all((now[n] != before[n]).any() for n in before if n.endswith("weight"))


def test_a_policy_has_what_its_run_had(finished: Trainer):
    run = finished.run
    policy = networks_of(run.policy_path(64))
    torch.testing.assert_close(policy, networks_of(run.checkpoint_path), rtol=0, atol=0)


def test_an_old_policy_has_no_critic_to_go_on_from(
    finished: Trainer, tmp_path: Path, capfd
):
    policy = tmp_path / "old.safetensors"
    remove_critic(finished.run.policy_path(64), policy)
    runs = {
        name: Run.create(replace(blind_run(tmp_path / name, 64), init_from=path))
        for name, path in {"new": None, "on": policy}.items()
    }
    for run in runs.values():
        with open_trainer(run):
            pass
    note, *others = capfd.readouterr().err.splitlines()
    assert "old.safetensors is of an older version and has no critic" in note
    assert not others
    new, on = (networks_of(run.checkpoint_path) for run in runs.values())
    critic = {name for name in on if name.startswith("agent/critic.")}
    assert critic == on.keys() - networks_of(policy).keys()
    for name, value in {**networks_of(policy), **{n: new[n] for n in critic}}.items():
        assert torch.equal(on[name], value), name


def test_an_initial_deviation_is_not_that_of_networks_to_start_from(
    finished: Trainer, tmp_path: Path, capfd
):
    config = replace(blind_run(tmp_path / "run", 64), init_from=finished.run.path)
    ppo = replace(config.ppo, network=NetworkConfig(init_std=0.3))
    run = Run.create(replace(config, ppo=ppo))
    with open_trainer(run):
        pass
    (note,) = capfd.readouterr().err.splitlines()
    assert note.startswith("note: ppo.network.init_std has no effect with init_from")
    start, before = map(
        networks_of, (run.checkpoint_path, finished.run.policy_path(64))
    )
    assert torch.equal(start["agent/head.log_std"], before["agent/head.log_std"])


def test_the_deviation_of_networks_to_start_from_is_within_the_bounds_of_the_run(
    finished: Trainer, tmp_path: Path
):
    before = networks_of(finished.run.policy_path(64))["agent/head.log_std"]
    assert (before.exp() > 0.6).any()
    config = blind_run(tmp_path / "run", 64)
    network = NetworkConfig(init_std=0.3, std_bounds=(0.1, 0.6))
    ppo = replace(config.ppo, network=network)
    run = Run.create(replace(config, ppo=ppo, init_from=finished.run.path))
    with open_trainer(run):
        pass
    start = networks_of(run.checkpoint_path)["agent/head.log_std"]
    torch.testing.assert_close(start.exp(), before.exp().clamp(max=0.6))


def test_a_resumed_run_needs_no_longer_what_it_started_from(
    finished: Trainer, tmp_path: Path
):
    policy = tmp_path / "policy.safetensors"
    policy.write_bytes(finished.run.policy_path(64).read_bytes())
    config = blind_run(tmp_path / "run", 128)
    run = Run.create(replace(config, init_from=policy))
    with open_trainer(run) as trainer:
        trainer.iterate()
        trainer.save()
    policy.unlink()
    resumed = Run(run.path, parse_config(["--resume", str(run.path)]))
    with open_trainer(resumed) as trainer:
        assert trainer.frames == 64
        train(trainer)
        now = networks_of(run.checkpoint_path)
    policy.write_bytes(finished.run.policy_path(64).read_bytes())
    whole = Run.create(
        replace(config, init_from=policy, run_dir=tmp_path / "undisturbed")
    )
    with open_trainer(whole) as trainer:
        train(trainer)
    torch.testing.assert_close(now, networks_of(whole.checkpoint_path), rtol=0, atol=0)


def test_other_networks_than_those_of_the_run_are_refused(
    finished: Trainer, tmp_path: Path
):
    policy = tmp_path / "policy.safetensors"
    policy.write_bytes(finished.run.policy_path(64).read_bytes())
    config = replace(blind_run(tmp_path / "run", 64), init_from=policy)
    run = Run.create(config)
    # Another policy with the same name, before the first checkpoint.
    policy.write_bytes(finished.run.policy_path(0).read_bytes())
    with (
        pytest.raises(ValueError, match=r"policy\.safetensors is not what .*run was"),
        open_trainer(Run.open(run.path)),
    ):
        pass
    # The run that has read the first one starts from it.
    with open_trainer(run):
        started = networks_of(run.checkpoint_path)
    for name, value in networks_of(finished.run.policy_path(64)).items():
        assert torch.equal(started[name], value), name
    again = [
        "--config",
        str(run.path / "config.json"),
        "--run-dir",
        str(tmp_path / "2"),
    ]
    with pytest.raises(ValueError, match=r"policy\.safetensors has changed since"):
        Run.create(parse_config(again))
    other = [*again, "--init-from", str(finished.run.policy_path(0))]
    Run.create(parse_config(other))
    new = Run.create(
        parse_config([*again[:3], str(tmp_path / "3"), "--init-from=None"])
    )
    assert "init_sha256" not in read_sealed(new.path / "config.json")[0]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--ppo.network.hidden", "16"], r"has layers of \[32, 32\], not of \[16\]"),
        (["--robot", "g1"], "is a policy for h1_2, not for g1"),
        (
            ["--history", "2"],
            "reads 48 values of 'observation', but here there are 96; it was trained "
            "with history 1$",
        ),
        (
            ["--init-from", "localization", "--sensor.range", "1"],
            "reads 3 values of 'signal', but here there are 64; it was trained with "
            "sensor.range 2.0, sensor.signal localization$",
        ),
        # It reads what the new one does not have.
        (["--sensor.coverage", "none"], "64 values of 'signal', but here there are 0"),
        (["--privileged", "velocity"], "reads 50 values of 'privileged_observation'"),
        (["--init-from", "nowhere"], "no policy nowhere"),
        # As many values with another meaning.
        (
            ["--init-from", "field_binary"],
            "reads the signal binary, not proximity: add --sensor.signal binary$",
        ),
        (["--sensor.signal", "closeness"], "reads the signal proximity, not closeness"),
    ],
)
def test_networks_that_do_not_fit_are_refused_before_anything_is_made(
    options, text, tmp_path: Path
):
    folder = tmp_path / "run"
    args = ["--init-from", "field_proximity", "--num-envs", "64", "--run-dir"]
    with pytest.raises(ValueError, match=text):
        Run.create(parse_config([*args, str(folder), *options]))
    assert not folder.exists()


def test_a_robot_of_the_same_name_with_its_joints_in_another_order_is_refused(
    finished: Trainer, tmp_path: Path
):
    tree = ElementTree.parse(Path(egoskin.__file__).parent / "assets/h1_2.xml")
    pelvis = tree.getroot().find("worldbody/body")
    assert pelvis is not None
    for body in pelvis.findall("body")[::-1]:
        pelvis.remove(body)
        pelvis.append(body)
    tree.write(tmp_path / "h1_2.xml")
    robot = portable(replace(H1_2, model_path=tmp_path / "h1_2.xml"))
    config = blind_run(tmp_path / "run", 64)
    config = replace(
        config,
        env=replace(config.env, robot=robot),
        init_from=finished.run.policy_path(64),
    )
    with pytest.raises(ValueError, match="h1_2 with other joints, or in another order"):
        Run.create(config)


def test_a_repeated_run_may_have_another_robot(finished: Trainer, tmp_path: Path):
    file = finished.run.path / "config.json"
    options = ["--config", str(file), "--robot", "g1", "--run-dir"]
    run = Run.create(parse_config([*options, str(tmp_path / "g1")]))
    assert run.config.env.robot == "g1"


@pytest.mark.parametrize("content", [{"total_frames": 1000}, {"env": {"history": 2}}])
def test_a_part_of_a_configuration_is_not_one(content, tmp_path: Path):
    file = tmp_path / "c.json"
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"c\.json is not the config\.json of a run"):
        parse_config(["--config", str(file)])
