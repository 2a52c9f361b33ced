"""The policies that come with the package: they load, and fit their environments."""

from __future__ import annotations

import copy
import functools
import math
import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import TransformedEnv
from torchrl.modules import AdditiveGaussianModule, SafeSequential

import egoskin
from egoskin.agents.networks import NetworkConfig
from egoskin.evaluation.throw_set import evaluate, standard_task
from egoskin.parallel import WorkerPool
from egoskin.policies.policy import Policy, PolicySpec, shipped_policies
from egoskin.sensors import MASK_ALL
from egoskin.sensors.config import SensorConfig
from egoskin.storage.tensor_file import load_tensors, save_tensors

ASSETS = Path(egoskin.__file__).parent / "assets" / "policies"


@pytest.fixture(scope="module")
def policy() -> Policy:
    return egoskin.load_policy("field_proximity")


def test_all_files_of_the_folder_are_policies_known_by_name():
    assert shipped_policies() == sorted(path.stem for path in ASSETS.iterdir())
    assert "localization" in shipped_policies()


@pytest.mark.parametrize("name", shipped_policies())
def test_a_shipped_policy_acts_in_the_environment_it_was_trained_in(name, capsys):
    policy = egoskin.load_policy(name)
    # It has a seal, so there is no note about it.
    assert capsys.readouterr().err == ""
    assert policy.policy_spec.frames > 0
    env = egoskin.make_worker_env(policy.env_config, policy.skin, num_envs=2, seed=0)
    td = policy(env.reset())
    assert td["action"].shape == env.action_spec.shape
    assert td["action"].isfinite().all()
    assert not env.step(td)["next", "diverged"].any()
    # Small enough to ship: a network of the paper's size, not a checkpoint.
    assert (ASSETS / f"{name}.safetensors").stat().st_size < 200_000


def test_a_shipped_policy_dodges_what_its_skin_senses(policy):
    config = standard_task(policy.env_config)
    task = replace(config.task, episode_length_s=config.task.success_s)
    config = replace(config, task=task)
    which = {"throw_set": 0, "episodes": 64}
    success, masked = (
        evaluate(policy, config, policy.skin, mask=mask, **which).success.mean
        for mask in ((), MASK_ALL)
    )
    # Measured: 53 % with the skin, 0 % without.
    assert success >= 0.4
    assert masked <= success / 2


# --- in TorchRL code of others ----------------------------------------------------


def given(*batch: int, seed: int = 0) -> TensorDict:
    """Random inputs of the policy."""
    generator = torch.Generator().manual_seed(seed)
    return TensorDict(
        {
            "observation": torch.randn(*batch, 48, generator=generator),
            "signal": torch.rand(*batch, 64, generator=generator),
        },
        batch,
    )


def test_a_policy_is_a_tensordict_module(policy):
    assert isinstance(policy, TensorDictModuleBase)
    assert policy.in_keys == ["observation", "signal"]
    assert policy.out_keys == ["action"]
    assert policy.spec["action"].shape == (21,)
    # As TorchRL calls any module: a TensorDict, or the tensors that it reads.
    td = given(5)
    action = policy(td)["action"]
    assert torch.equal(policy(td["observation"], td["signal"]), action)
    assert torch.equal(
        policy(signal=td["signal"], observation=td["observation"]), action
    )


@pytest.mark.parametrize("batch", [(), (1,), (0,), (6,), (2, 3), (2, 1, 3), (3, 0, 2)])
def test_a_policy_takes_a_batch_of_any_dimensions(policy, batch):
    td = given(*batch)
    rows = policy(given(math.prod(batch)))["action"]
    action = policy(td)["action"]
    assert action.shape == (*batch, 21)
    torch.testing.assert_close(action.reshape(-1, 21), rows)


def test_the_action_is_that_of_its_own_row_in_any_float_type(policy):
    td = given(6)
    action = policy(td)["action"]
    for row in range(6):
        torch.testing.assert_close(policy(td[row].clone())["action"], action[row])
    # Simulators give float64; the network stays what it is.
    double = policy(given(6).double())["action"]
    assert double.dtype == torch.float32
    torch.testing.assert_close(double, action)
    exact = copy.deepcopy(policy).double()
    assert exact.spec["action"].dtype == torch.float64
    torch.testing.assert_close(
        exact(given(6))["action"], action.double(), atol=1e-5, rtol=1e-5
    )


def test_copies_of_a_policy_act_alike_and_are_its_own(policy, tmp_path):
    action = policy(given(4))["action"]
    torch.save(policy, tmp_path / "policy.pt")
    copies = {
        "deepcopy": copy.deepcopy(policy),
        "pickle": pickle.loads(pickle.dumps(policy)),
        "torch.save": torch.load(tmp_path / "policy.pt", weights_only=False),
        "another load": egoskin.load_policy("field_proximity"),
    }
    for name, other in copies.items():
        assert torch.equal(other(given(4))["action"], action), name
        assert other.env_config == policy.env_config, name
        assert other.skin.to_dict() == policy.skin.to_dict(), name
        # It contains nothing unused, such as an untrained critic.
        assert other.state_dict().keys() == policy.state_dict().keys(), name
        for key, value in policy.state_dict().items():
            assert torch.equal(value, other.state_dict()[key]), (name, key)
        for parameter in other.parameters():
            parameter.data.zero_()
    assert torch.equal(policy(given(4))["action"], action)


def test_a_policy_compiles_as_one_graph(policy):
    compiled = torch.compile(policy, fullgraph=True, backend="eager")
    for batch in [(5,), (2, 3)]:
        expected = policy(given(*batch))["action"]
        torch.testing.assert_close(compiled(given(*batch))["action"], expected)


def test_a_policy_works_under_vmap_and_with_other_parameters(policy):
    action = policy(given(5))["action"]
    torch.testing.assert_close(torch.vmap(policy)(given(5))["action"], action)
    parameters = {k: torch.zeros_like(v) for k, v in policy.state_dict().items()}
    idle = torch.func.functional_call(policy, parameters, (given(5),))["action"]
    assert torch.equal(idle, torch.zeros(5, 21))
    # Gradients reach its inputs, not its parameters.
    td = given(5)
    td["signal"].requires_grad_()
    policy(td)["action"].sum().backward()
    assert td["signal"].grad.abs().sum() > 0
    assert not any(p.requires_grad for p in policy.parameters())


def test_what_a_policy_cannot_read_is_said(policy):
    with pytest.raises(KeyError, match="observation, signal; 'signal' is missing"):
        policy(given(3).select("observation"))
    for wrong, shape in ((torch.ones(3, 32), r"\[3, 32\]"), (torch.ones(3), r"\[3\]")):
        text = rf"trained with 'signal' \[\*B, 64\], got {shape}.*make_env"
        with pytest.raises(ValueError, match=text):
            policy(given(3).set("signal", wrong))


FORMS = {
    "proximity": {},
    "blind": {"sensor": SensorConfig(coverage="none")},
    "localization": {"sensor": SensorConfig(signal="localization")},
    "history": {"history": 3, "previous_action": True},
    "ray": {"sensor": SensorConfig(coverage="ray")},
}


@pytest.fixture(params=FORMS)
def form(request) -> Iterator[tuple[Policy, TransformedEnv]]:
    """An untrained policy of this form, and its environment."""
    config = egoskin.EnvConfig(**FORMS[request.param])
    skin = config.skin.build(config.robot_config)
    env = egoskin.make_worker_env(config, skin, num_envs=3, seed=0)
    spec = PolicySpec.of(config, skin, NetworkConfig(hidden=(8,)), env, {})
    yield Policy(spec.build_agent(), spec), env
    env.close(raise_if_closed=False)


def test_torchrls_rollouts_and_collectors_run_a_policy(form):
    policy, env = form
    rollout = env.rollout(4, policy)
    assert rollout["action"].shape == (3, 4, 21)
    # On the stored batch [B, T] it does what it did step by step.
    again = policy(rollout.exclude("action"))["action"]
    torch.testing.assert_close(again, rollout["action"])
    collector = Collector(
        env,
        policy,
        frames_per_batch=6,
        total_frames=12,
        auto_register_policy_transforms=False,
    )
    batches = list(collector)
    collector.shutdown()
    assert [batch.shape for batch in batches] == [(3, 2), (3, 2)]
    for batch in batches:
        given = batch.select(*policy.in_keys)
        torch.testing.assert_close(policy(given)["action"], batch["action"])


def make_pool(seed: int) -> WorkerPool:
    config = egoskin.EnvConfig()
    return egoskin.make_env(config, num_envs=4, seed=seed, num_workers=2)


@pytest.mark.slow
def test_torchrls_collectors_of_several_processes_run_pools_of_workers(policy):
    seeds = (0, 1)
    collector = MultiSyncCollector(
        [functools.partial(make_pool, seed) for seed in seeds],
        policy,
        frames_per_batch=80,
        total_frames=160,
        cat_results="stack",
        auto_register_policy_transforms=False,
    )
    batches = torch.cat(list(collector), -1)
    collector.shutdown()
    assert batches.shape == (2, 2, 2, 20)
    for seed, batch in zip(seeds, batches, strict=True):
        env = make_pool(seed)
        alone = env.rollout(20, policy, break_when_any_done=False)
        env.close()
        # The collector's processes compute what this one does.
        for key in ("action", "signal", ("next", "reward")):
            torch.testing.assert_close(batch[key], alone[key], rtol=0, atol=0)


def test_exploration_noise_goes_on_top_of_a_policy(policy):
    env = egoskin.make_worker_env(policy.env_config, policy.skin, num_envs=2, seed=0)
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.1, sigma_end=0.1)
    explorer = SafeSequential(policy, noise)
    rollout = env.rollout(3, explorer)
    mean = policy(rollout.select(*policy.in_keys))["action"]
    assert 0.01 < (rollout["action"] - mean).std() < 0.2
    env.close()


# --- files ------------------------------------------------------------------------


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
    with pytest.raises(ValueError, match=r"odd.* is not a policy"):
        egoskin.load_policy(tmp_path / "odd.safetensors")


def test_a_header_without_a_policy_is_refused(tmp_path):
    tensors, _ = load_tensors(ASSETS / "field_proximity.safetensors")
    for header in ({}, {"policy": 5}, {"policy": None}):
        save_tensors(tmp_path / "odd.safetensors", tensors, header)
        with pytest.raises(ValueError, match=r"odd.* is not a policy"):
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
        ("head.log_std", 1e3, "actions may not be finite"),
        # Finite as stored, but not when used.
        ("head.body.inputs.0.weight", 3e38, "actions may not be finite"),
        ("head.body.inputs.1.weight", -3e38, "actions may not be finite"),
        ("head.body.tail.1.weight", 3e38, "actions may not be finite"),
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
    with pytest.raises(
        ValueError, match=r"large.*(its header claims a size of|hidden must be at most)"
    ):
        egoskin.load_policy(path)


def test_a_policy_says_by_which_engine_it_was_trained(tmp_path):
    save_changed(tmp_path / "warp.safetensors", {"engine": "warp"})
    assert (
        egoskin.load_policy(tmp_path / "warp.safetensors").policy_spec.engine == "warp"
    )


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
        evaluate(policy, config, policy.skin, throw_set=0, episodes=4)


def test_a_file_that_is_there_comes_before_a_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "localization").write_bytes(b"mine")
    with pytest.raises(ValueError, match="localization is"):
        egoskin.load_policy("localization")


def test_a_folder_without_a_checkpoint_is_explained(tmp_path):
    def told() -> str:
        with pytest.raises(ValueError, match="checkpoint") as error:
            egoskin.load_policy(tmp_path)
        return str(error.value).removeprefix(f"{tmp_path} ")

    assert told() == "is not a run folder: it has no checkpoint.safetensors"
    (tmp_path / "config.json").touch()
    assert told().startswith("has no checkpoint yet: its training is starting, or was")
    assert told().endswith(f"egoskin train --resume {tmp_path})")
    (tmp_path / "policies").mkdir()
    for frames in ("000000000000", "000065536000"):
        (tmp_path / "policies" / f"{frames}.safetensors").touch()
    latest = tmp_path / "policies" / "000065536000.safetensors"
    assert told() == f"has no checkpoint; its latest policy is {latest}"


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
        evaluate(policy, c, policy.skin, throw_set=0, episodes=1024).success.mean
        for c in (config, finer)
    ]
    assert success[0] - success[1] <= 0.05


def test_a_policy_loads_whatever_the_default_type_is(policy):
    try:
        torch.set_default_dtype(torch.float64)
        loaded = egoskin.load_policy("field_proximity")
        assert torch.get_default_dtype() == torch.float64
    finally:
        torch.set_default_dtype(torch.float32)
    td = given(5)
    assert torch.equal(loaded(td.clone())["action"], policy(td.clone())["action"])
