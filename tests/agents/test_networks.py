"""Networks: joined inputs, normalisers, bounded deviation, what the actor samples."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import IndependentNormal

from egoskin.agents.networks import (
    Agent,
    KeyedMLP,
    NetworkConfig,
    SharedStdNormal,
)
from egoskin.agents.normalizers import RunningNorm, SignalNorm

SIZES = {"observation": 6, "signal": 5, "privileged_observation": 4}
ACTOR = ["observation", "signal"]
CRITIC = [*ACTOR, "privileged_observation"]


def make_agent(**changes: object) -> Agent:
    torch.manual_seed(0)
    return Agent(SIZES, ACTOR, CRITIC, 3, NetworkConfig(**changes))


def make_batch(n: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    return TensorDict(
        {k: torch.randn(n, s, generator=generator) for k, s in SIZES.items()}, [n]
    )


def test_separate_inputs_equal_one_layer_of_their_concatenation():
    torch.manual_seed(0)
    net = KeyedMLP([4, 3], [8, 8], 2, 1.0)
    x, y = torch.randn(5, 4), torch.randn(5, 3)
    joined = torch.nn.Linear(7, 8)
    with torch.no_grad():
        joined.weight.copy_(torch.cat([layer.weight for layer in net.inputs], 1))
        joined.bias.copy_(net.inputs[0].bias)
    torch.testing.assert_close(net(x, y), net.tail(joined(torch.cat((x, y), 1))))


def test_layers_begin_orthogonal_and_all_inputs_as_one_layer():
    torch.manual_seed(0)
    net = KeyedMLP([4, 7], [8, 8], 2, 0.5)
    *parts, second, last = (x for n, x in net.named_parameters() if "weight" in n)
    first = torch.cat(parts, 1)
    assert first.shape == (8, 11)
    # The squared gains are 2, and 0.25 in the last layer.
    for weight, square in ((first, 2), (second, 2), (last, 0.25)):
        torch.testing.assert_close(weight @ weight.mT, square * torch.eye(len(weight)))
    biases = [value for name, value in net.named_parameters() if "bias" in name]
    assert len(biases) == 3
    assert not any(bias.any() for bias in biases)


def test_the_first_actions_are_small_and_the_first_values_are_not():
    agent, batch = make_agent(), make_batch()
    out = agent.critic(agent.actor(agent.encode(batch)))
    assert out["loc"].abs().max() < 0.05
    assert out["state_value"].std() > 0.5


def test_running_norm_equals_the_statistics_of_all_data():
    norm = RunningNorm(3)
    parts = [torch.randn(n, 3) * 5 + 2 for n in (7, 100, 1)]
    for part in parts:
        norm.update(part)
    data = torch.cat(parts).double()
    torch.testing.assert_close(norm.mean, data.mean(0))
    torch.testing.assert_close(norm.var, data.var(0, unbiased=False))
    expected = (parts[1].double() - norm.mean) / norm.var.sqrt()
    torch.testing.assert_close(norm(parts[1]).double(), expected, atol=1e-4, rtol=1e-4)


def test_a_forward_pass_leaves_the_normaliser_as_it_is():
    agent, batch = make_agent(), make_batch()
    before = agent.norms["observation"].mean.clone()
    agent.critic(agent.actor(agent.encode(batch)))
    assert torch.equal(agent.norms["observation"].mean, before)


def test_networks_read_what_is_normalised():
    agent, batch = make_agent(normalize="body"), make_batch()
    agent.norms["observation"].update(5 + 3 * batch["observation"])
    inputs = agent.encode(batch)["inputs"]
    assert set(inputs.keys()) == set(CRITIC)
    expected = agent.norms["observation"](batch["observation"])
    assert torch.equal(inputs["observation"], expected)
    assert not torch.equal(inputs["observation"], batch["observation"])
    assert torch.equal(inputs["signal"], batch["signal"])


def test_signals_are_normalised_unless_asked_not_to():
    assert set(make_agent().norms) == set(SIZES)
    body = make_agent(normalize="body").norms
    assert set(body) == {"observation", "privileged_observation"}


@pytest.mark.parametrize("size", [3, 64, 4096])
def test_signals_weigh_as_much_however_many_they_are(size: int):
    sizes = {**SIZES, "signal": size}
    agent = Agent(sizes, ACTOR, CRITIC, 3, NetworkConfig())
    generator = torch.Generator().manual_seed(0)
    # One sensor in twenty detects something; sensors differ.
    seen = torch.rand(2_000, size, generator=generator) < 0.05
    near = torch.linspace(0.2, 0.8, size).expand_as(seen)
    batch = TensorDict({"signal": torch.where(seen, near, 1.0)}, [2_000])
    agent.norms["signal"].update(batch["signal"])
    signal = agent.encode(batch)["inputs", "signal"]
    variance = (signal - signal.mean()).square().mean() * size
    assert variance == pytest.approx(SignalNorm.WEIGHT, rel=0.05)
    # Differences are preserved.
    assert len(signal.unique()) == size + 1


def test_a_rare_detection_among_many_beams_is_not_clipped():
    norm = SignalNorm(4096)
    signal = torch.ones(2_000, 1)
    signal[0] = 0.2
    norm.update(signal)
    std = signal.double().std(correction=0)
    expected = (0.2 - signal.double().mean()) / std * (64 / 4096) ** 0.5
    assert expected < -5
    assert float(norm(signal)[0]) == pytest.approx(float(expected), rel=1e-3)


def test_the_actor_does_not_see_what_only_the_critic_observes():
    agent, batch = make_agent(), make_batch()
    changed = batch.clone()
    changed["privileged_observation"] += 1.0
    one, other = (agent.critic(agent.actor(agent.encode(b))) for b in (batch, changed))
    assert torch.equal(one["loc"], other["loc"])
    assert not torch.equal(one["state_value"], other["state_value"])


def test_the_actor_samples_with_its_standard_deviation():
    # TorchRL's default would be the mean: every action equal to loc.
    agent = make_agent(init_std=0.5)
    with torch.no_grad():
        out = agent.actor(agent.encode(make_batch(20000)))
    noise = (out["action"] - out["loc"]) / out["scale"]
    assert noise.std() == pytest.approx(1.0, abs=0.02)
    normal = torch.distributions.Normal(out["loc"], out["scale"])
    expected = normal.log_prob(out["action"]).sum(-1)
    torch.testing.assert_close(out["action_log_prob"], expected)


def test_the_standard_deviation_stays_in_its_bounds():
    agent = make_agent(std_bounds=(0.2, 0.8))
    with torch.no_grad():
        agent.head.log_std.copy_(torch.tensor([-5.0, 0.0, 5.0]))
    agent.head.bound_std()
    torch.testing.assert_close(agent.head.log_std.exp(), torch.tensor([0.2, 0.8, 0.8]))


@pytest.mark.parametrize(
    ("field", "text"),
    [
        ({"init_std": 2.0}, "init_std"),
        ({"std_bounds": (0.0, 1.0)}, "std_bounds"),
        ({"hidden": ()}, "hidden"),
    ],
)
def test_bad_sizes_are_refused(field: dict, text: str):
    with pytest.raises(ValueError, match=text):
        NetworkConfig(**field)


def test_the_distribution_is_that_of_torch():
    generator = torch.Generator().manual_seed(0)
    loc, action = torch.randn(2, 50, 3, generator=generator)
    scale = torch.tensor([0.3, 1.0, 2.0]).expand(50, 3)
    ours, theirs = SharedStdNormal(loc, scale), IndependentNormal(loc, scale)
    torch.testing.assert_close(ours.log_prob(action), theirs.log_prob(action))
    torch.testing.assert_close(ours.entropy(), theirs.entropy())
    torch.manual_seed(1)
    drawn = ours.sample()
    torch.manual_seed(1)
    assert torch.equal(drawn, theirs.sample())
