"""PPO: bootstrapping by hand, contents of a rollout, improvement by updates."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase

from egoskin.agents.networks import Agent, NetworkConfig
from egoskin.agents.ppo import (
    PPO,
    NonFiniteError,
    PPOConfig,
    add_advantages,
    gaussian_kl,
)
from egoskin.agents.rollout import collect


class CountingEnv(EnvBase):
    """Observes its age; row 0 times out at age 2, row 1 terminates at age 3."""

    batch_locked = True  # pyright: ignore - a property there, read as this

    def __init__(self) -> None:
        super().__init__(batch_size=[2])
        self.observation_spec = Composite(
            observation=Unbounded(shape=(2, 1)), shape=(2,)
        )
        self.action_spec = Unbounded(shape=(2, 1))
        self.reward_spec = Unbounded(shape=(2, 1))
        self.age = torch.zeros(2, 1)

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _reset(
        self, tensordict: TensorDictBase | None = None, **_: object
    ) -> TensorDict:
        mask = torch.ones(2, 1, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            mask = tensordict["_reset"]
        self.age = torch.where(mask, 0.0, self.age)
        return TensorDict({"observation": self.age.clone()}, [2])

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.age = self.age + 1
        truncated = self.age >= torch.tensor([[2.0], [99.0]])
        terminated = self.age >= torch.tensor([[99.0], [3.0]])
        return TensorDict(
            {
                "observation": self.age.clone(),
                "reward": torch.ones(2, 1),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
            [2],
        )


class StillEnv(EnvBase):
    """256 rows in which nothing ever happens."""

    batch_locked = True  # pyright: ignore - a property there, read as this

    def __init__(self) -> None:
        super().__init__(batch_size=[256])
        self.observation_spec = Composite(
            observation=Unbounded(shape=(256, 3)), shape=(256,)
        )
        self.action_spec = Unbounded(shape=(256, 2))
        self.reward_spec = Unbounded(shape=(256, 1))

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _reset(
        self, tensordict: TensorDictBase | None = None, **_: object
    ) -> TensorDict:
        return TensorDict({"observation": torch.zeros(256, 3)}, [256])

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        never = torch.zeros(256, 1, dtype=torch.bool)
        return TensorDict(
            {
                "observation": torch.zeros(256, 3),
                "reward": torch.zeros(256, 1),
                "terminated": never,
                "truncated": never.clone(),
                "done": never.clone(),
            },
            [256],
        )


def counting_agent() -> Agent:
    """An agent whose value of an observation x is 10 x + 1."""
    agent = Agent(
        {"observation": 1}, ["observation"], ["observation"], 1, NetworkConfig()
    )
    agent.norms.clear()
    critic = torch.nn.Linear(1, 1)
    with torch.no_grad():
        critic.weight.fill_(10.0)
        critic.bias.fill_(1.0)
    agent.critic.module = critic
    return agent


def column(values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)


def truncating_spec(env: EnvBase) -> EnvBase:
    env.add_truncated_keys()
    return env


def test_a_timeout_bootstraps_from_its_terminal_observation():
    env, agent = truncating_spec(CountingEnv()), counting_agent()
    rollout, root, infos = collect(env, agent, env.reset(), 4)
    # Ages seen by row 0: 0 1 | 0 1 ; its time-outs end at age 2, so V = 21 is what
    # both second steps bootstrap from, not V(0) = 1 of the episode after the reset.
    assert rollout["state_value"][:, 0, 0].tolist() == [1.0, 11.0, 1.0, 11.0]
    assert rollout["next_state_value"][:, 0, 0].tolist() == [11.0, 21.0, 11.0, 21.0]
    # Row 1: ages 0 1 2 | 0; its end at age 3 is a termination; the last step goes on
    # to age 1, V = 11.
    assert rollout["state_value"][:, 1, 0].tolist() == [1.0, 11.0, 21.0, 1.0]
    assert rollout["next_state_value"][[0, 1, 3], 1, 0].tolist() == [11.0, 21.0, 11.0]
    assert rollout["terminated"][:, 1, 0].tolist() == [False, False, True, False]
    assert root["observation"].tolist() == [[0.0], [1.0]]
    assert len(infos) == 4
    # Only the values of the next states are kept.
    assert "next" not in rollout.keys()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_an_agent_learns_on_its_device_from_an_environment_on_the_cpu(device: str):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    env = truncating_spec(CountingEnv())
    keys = ["observation"]
    agent = Agent({"observation": 1}, keys, keys, 1, NetworkConfig()).to(device)
    rollout, root, _ = collect(env, agent, env.reset(), 4)
    assert rollout.device is not None
    assert rollout.device.type == rollout["action_log_prob"].device.type == device
    assert root["observation"].device.type == "cpu"
    metrics = PPO(agent, PPOConfig(num_mini_batches=2)).update(rollout)
    assert 0 < metrics["kl"] < 1


def test_advantages_of_a_timeout_and_a_termination_by_hand():
    env, agent = truncating_spec(CountingEnv()), counting_agent()
    rollout, _, _ = collect(env, agent, env.reset(), 4)
    add_advantages(rollout, gamma=0.5, gae_lambda=0.5)
    # delta = r + 0.5 V' - V; advantage = delta + 0.25 advantage', cut at an end.
    # Row 0: 1 + 5.5 - 1 = 5.5; time-out 1 + 10.5 - 11 = 0.5; then the same again.
    #   advantages 5.5 + 0.25 * 0.5 = 5.625, 0.5; targets A + V: 6.625, 11.5.
    # Row 1: 5.5; 1 + 10.5 - 11 = 0.5; termination 1 + 0 - 21 = -20; 1 + 5.5 - 1 = 5.5
    #   advantages -20; 0.5 - 5 = -4.5; 5.5 - 1.125 = 4.375; 5.5.
    target = rollout["value_target"][..., 0]
    assert target[:, 0].tolist() == [6.625, 11.5, 6.625, 11.5]
    assert target[:, 1].tolist() == [5.375, 6.5, 1.0, 6.5]
    raw = target - rollout["state_value"][..., 0]
    expected = (raw - raw.mean()) / (raw.std() + 1e-8)
    torch.testing.assert_close(rollout["advantage"][..., 0], expected)


def test_the_critic_may_learn_from_another_estimate_than_the_actor():
    env, agent = truncating_spec(CountingEnv()), counting_agent()
    rollout, _, _ = collect(env, agent, env.reset(), 4)
    add_advantages(rollout, gamma=0.5, gae_lambda=0.0, value_lambda=0.5)
    target = rollout["value_target"][..., 0]
    assert target[:, 1].tolist() == [5.375, 6.5, 1.0, 6.5]  # as above
    # lambda = 0: the differences alone, by hand above.
    raw = torch.tensor([[5.5, 0.5, 5.5, 0.5], [5.5, 0.5, -20.0, 5.5]]).t()
    expected = (raw - raw.mean()) / (raw.std() + 1e-8)
    torch.testing.assert_close(rollout["advantage"][..., 0], expected)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_noise_is_as_wide_as_without_correlation_and_correlated(correlation: float):
    torch.manual_seed(0)
    env, agent = truncating_spec(StillEnv()), bandit_agent()
    rollout, _, _ = collect(env, agent, env.reset(), 64, (), correlation)
    noise = (rollout["action"] - rollout["loc"]) / rollout["scale"]
    assert noise.std() == pytest.approx(1.0, abs=0.02)
    for lag in (1, 3):
        found = (noise[lag:] * noise[:-lag]).mean()
        assert found == pytest.approx(correlation**lag, abs=0.03)
    assert (noise[..., 0] * noise[..., 1]).mean() == pytest.approx(0.0, abs=0.03)
    each = torch.distributions.Normal(rollout["loc"], rollout["scale"])
    torch.testing.assert_close(
        rollout["action_log_prob"], each.log_prob(rollout["action"]).sum(-1)
    )


def test_the_noise_is_white_at_first():
    config = PPOConfig(noise_correlation=0.5, noise_correlation_start=1000)
    found = [config.noise_correlation_at(n) for n in (0, 999, 1000, 5000)]
    assert found == [0.0, 0.0, 0.5, 0.5]
    assert PPOConfig(noise_correlation_start=0).noise_correlation_at(0) == 0.5


def test_the_entropy_bonus_falls_to_zero():
    config = PPOConfig(entropy_coeff=0.004, entropy_frames=1000)
    shares = [config.entropy_coeff_at(n) / 0.004 for n in (0, 250, 1000, 5000)]
    assert shares == pytest.approx([1.0, 0.75, 0.0, 0.0])
    steady = PPOConfig(entropy_coeff=0.004, entropy_frames=None)
    assert steady.entropy_coeff_at(10**9) == 0.004

    def learnt(frames: int) -> float:
        agent = bandit_agent()
        ppo = PPO(agent, replace(config, entropy_coeff=1.0))
        return ppo.update(bandit_rollout(agent), frames)["action_std"]

    assert learnt(0) > learnt(900) > learnt(1000)
    assert learnt(1000) == learnt(2000)


def test_gaussian_kl_equals_torch_distributions():
    generator = torch.Generator().manual_seed(0)
    loc0, loc1 = torch.randn(2, 5, 3, generator=generator)
    scale0, scale1 = torch.rand(2, 5, 3, generator=generator) + 0.1
    expected = torch.distributions.kl_divergence(
        torch.distributions.Normal(loc0, scale0),
        torch.distributions.Normal(loc1, scale1),
    ).sum(-1)
    torch.testing.assert_close(gaussian_kl(loc0, scale0, loc1, scale1), expected)


def bandit_rollout(agent: Agent) -> TensorDict:
    """One-step episodes whose reward is highest at the action (1, 1)."""
    rollout = TensorDict({"observation": torch.randn(16, 64, 3)}, [16, 64])
    with torch.no_grad():
        rollout.update(agent.critic(agent.actor(agent.encode(rollout))))
    miss = (rollout["action"] - 1).square().sum(-1, keepdim=True)
    rollout["reward"] = -miss
    rollout["next_state_value"] = torch.zeros(16, 64, 1)
    rollout["done"] = rollout["terminated"] = torch.ones(16, 64, 1, dtype=torch.bool)
    return rollout


def bandit_agent() -> Agent:
    torch.manual_seed(0)
    keys = ["observation"]
    return Agent({"observation": 3}, keys, keys, 2, NetworkConfig())


def test_updates_move_the_mean_action_to_the_best():
    agent = bandit_agent()
    ppo = PPO(agent, PPOConfig(num_mini_batches=2))
    for _ in range(20):
        metrics = ppo.update(bandit_rollout(agent))
    loc, _ = agent.head(torch.randn(1000, 3))
    assert (loc - 1).abs().mean() < 0.15
    assert metrics["action_std"] < 0.5


def broken_rollout(agent: Agent) -> TensorDict:
    """Episodes that end at random, some by a time limit, with values of any size."""
    rollout = bandit_rollout(agent)
    rollout["reward"] += torch.randn(16, 64, 1)
    rollout["next_state_value"] = torch.randn(16, 64, 1)
    rollout["done"] = torch.rand(16, 64, 1) < 0.2
    rollout["terminated"] = rollout["done"] & (torch.rand(16, 64, 1) < 0.5)
    return rollout


def estimate(rollout: TensorDict, gamma: float, decay: float) -> Tensor:
    """Generalised advantage estimates by the textbook's recursion, ``[T, N, 1]``."""
    advantage, ahead = torch.zeros(16, 64, 1), torch.zeros(64, 1)
    for i in reversed(range(16)):
        row = rollout[i]
        bootstrap = gamma * row["next_state_value"] * ~row["terminated"]
        delta = row["reward"] + bootstrap - row["state_value"]
        ahead = delta + gamma * decay * ahead * ~row["done"]
        advantage[i] = ahead
    return advantage


def plain_update(agent: Agent, rollout: TensorDict, config: PPOConfig) -> float:
    """Update an agent as PPO's paper says, in plain PyTorch; return the divergence."""
    advantage = estimate(rollout, config.gamma, config.gae_lambda)
    advantage = (advantage - advantage.mean()) / advantage.std()
    assert config.value_lambda is not None
    target = estimate(rollout, config.gamma, config.value_lambda)
    target = (target + rollout["state_value"]).flatten()
    inputs = rollout["inputs", "observation"].reshape(-1, 3)
    action = rollout["action"].reshape(-1, 2)
    before = rollout["action_log_prob"].flatten()
    networks = [[*m.parameters()] for m in (agent.actor, agent.critic)]
    adam = torch.optim.Adam(
        [*networks[0], *networks[1]], config.learning_rate, eps=1e-5
    )
    low, high = config.network.std_bounds
    for _ in range(config.ppo_epochs):
        order = torch.randperm(len(action))
        for index in order.tensor_split(config.num_mini_batches):
            new = torch.distributions.Normal(*agent.head(inputs[index]))
            ratio = (new.log_prob(action[index]).sum(-1) - before[index]).exp()
            gain = advantage.flatten()[index]
            clipped = ratio.clamp(1 - config.clip_epsilon, 1 + config.clip_epsilon)
            objective = torch.minimum(ratio * gain, clipped * gain).mean()
            state = TensorDict({"inputs": {"observation": inputs[index]}}, len(index))
            error = agent.critic(state)["state_value"].flatten() - target[index]
            loss = config.critic_coeff * error.square().mean() - objective
            loss = loss - config.entropy_coeff * new.entropy().sum(-1).mean()
            adam.zero_grad()
            loss.backward()
            for network in networks:
                torch.nn.utils.clip_grad_norm_(network, config.max_grad_norm)
            adam.step()
            with torch.no_grad():
                agent.head.log_std.clamp_(math.log(low), math.log(high))
    with torch.no_grad():
        after = torch.distributions.Normal(*agent.head(inputs))
    then = (rollout["loc"].reshape(-1, 2), rollout["scale"].reshape(-1, 2))
    old = torch.distributions.Normal(*then)
    return float(torch.distributions.kl_divergence(old, after).sum(-1).mean())


def test_there_are_as_many_minibatches_as_asked_for(monkeypatch):
    torch.manual_seed(0)
    network = NetworkConfig()
    agent = Agent({"observation": 3}, ["observation"], ["observation"], 2, network)
    rollout = broken_rollout(agent)
    ppo = PPO(agent, PPOConfig(ppo_epochs=1, num_mini_batches=rollout.numel() - 1))
    sizes, step = [], ppo.step
    monkeypatch.setattr(
        ppo, "step", lambda data, index: sizes.append(len(index)) or step(data, index)
    )
    ppo.update(rollout)
    assert sizes == [2] + [1] * (rollout.numel() - 2)


def test_an_update_is_that_of_plain_pytorch():
    network = NetworkConfig(std_bounds=(0.366, 2.0), init_std=0.37)
    # Minibatches and their shares of different sizes.
    config = PPOConfig(
        network=network, num_mini_batches=3, clip_epsilon=0.1, learning_rate=3e-3
    )
    torch.manual_seed(0)
    agent = Agent({"observation": 3}, ["observation"], ["observation"], 2, network)
    rollout, other = broken_rollout(agent), deepcopy(agent)
    torch.manual_seed(1)
    kl = plain_update(other, rollout, config)
    # 1.2: the rate grows by the square root, far from its limits.
    config = replace(config, desired_kl=1.2 * kl)
    torch.manual_seed(1)
    metrics = PPO(agent, config).update(rollout)
    for (name, value), expected in zip(
        agent.named_parameters(), other.parameters(), strict=True
    ):
        torch.testing.assert_close(value, expected, rtol=1e-3, atol=1e-5, msg=name)
    assert metrics["kl"] == pytest.approx(kl, rel=1e-3)
    assert metrics["learning_rate"] == pytest.approx(3e-3 * math.sqrt(1.2), rel=1e-3)
    assert 0.05 < metrics["clip_fraction"] < 0.95
    assert float(agent.head.log_std.detach().min().exp()) == pytest.approx(0.366)
    target = estimate(rollout, 0.995, 0.95) + rollout["state_value"]
    missed = (target - rollout["state_value"]).var() / target.var()
    assert metrics["explained_variance"] == pytest.approx(1 - float(missed), rel=1e-4)
    # The normalisers have seen this rollout, for the next one.
    norm = agent.norms["observation"]
    seen = rollout["observation"].reshape(-1, 3).double()
    torch.testing.assert_close(norm.mean, seen.mean(0), rtol=1e-3, atol=1e-3)


def test_the_learning_rate_follows_the_divergence_from_update_to_update():
    agent = bandit_agent()
    ppo = PPO(agent, PPOConfig(desired_kl=0.001, num_mini_batches=1))
    divergences = []
    for _ in range(20):
        before = ppo.learning_rate
        divergences.append(ppo.update(bandit_rollout(agent))["kl"])
        factor = ppo.learning_rate / before
        assert 1 / 1.501 < factor < 1.501
        assert (factor > 1) == (divergences[-1] < 0.001)
    assert 0.0005 < sum(divergences[10:]) / 10 < 0.002


@pytest.mark.parametrize(
    ("desired", "rate", "bound"), [(1e6, 9e-3, 1e-2), (1e-15, 1.2e-5, 1e-5)]
)
def test_an_adapted_learning_rate_stays_within_its_bounds(desired, rate, bound):
    agent = bandit_agent()
    config = PPOConfig(
        desired_kl=desired, learning_rate=rate, ppo_epochs=1, num_mini_batches=1
    )
    assert PPO(agent, config).update(bandit_rollout(agent))["learning_rate"] == bound


def test_the_divergence_of_an_update_is_that_of_the_policy_it_leaves():
    agent = bandit_agent()
    ppo = PPO(agent, PPOConfig())
    rollout = bandit_rollout(agent)
    observation = rollout["inputs", "observation"].clone()
    kl = ppo.update(rollout)["kl"]
    with torch.no_grad():
        new = agent.head(observation)
    expected = gaussian_kl(rollout["loc"], rollout["scale"], *new).mean()
    assert kl == pytest.approx(float(expected), rel=1e-4)


def test_there_are_no_more_threads_than_shares_of_a_minibatch():
    threads = [PPO(bandit_agent(), PPOConfig(), n).num_threads for n in (1, 3, 16)]
    assert threads == [1, 3, 4]


def test_without_a_desired_divergence_the_learning_rate_stays():
    agent = bandit_agent()
    ppo = PPO(agent, PPOConfig(desired_kl=None))
    metrics = ppo.update(bandit_rollout(agent))
    assert ppo.learning_rate == 1e-3
    assert metrics["kl"] > 0


def test_the_state_of_another_optimiser_is_refused():
    agent = bandit_agent()
    one = PPO(agent, PPOConfig())
    one.update(bandit_rollout(agent))
    state = one.state()
    state["0/exp_avg"] = state["0/exp_avg"][1:]
    with pytest.raises(ValueError, match="other networks"):
        PPO(agent, PPOConfig()).load_state(state, 1e-3)


def test_an_adapted_learning_rate_is_restored():
    agent = bandit_agent()
    ppo = PPO(agent, PPOConfig(desired_kl=1e-9))
    ppo.update(bandit_rollout(agent))
    again = PPO(agent, ppo.config)
    again.load_state(ppo.state(), ppo.learning_rate)
    for one in (ppo, again):
        rates = [group["lr"] for group in one.optimizer.param_groups]
        assert rates == pytest.approx([1e-3 / 1.5])


def test_gradients_of_actor_and_critic_are_clipped_separately():
    agent = bandit_agent()
    ppo = PPO(agent, PPOConfig(max_grad_norm=1e-3, ppo_epochs=1, num_mini_batches=1))
    ppo.update(bandit_rollout(agent))
    for module in (agent.head, agent.critic):
        grads = [p.grad for p in module.parameters() if p.grad is not None]
        norm = torch.stack([g.norm() for g in grads]).norm()
        assert norm == pytest.approx(1e-3, rel=1e-3)


def test_a_gradient_that_is_not_finite_is_left_to_be_named():
    agent = bandit_agent()
    ppo = PPO(agent, PPOConfig())
    bad = agent.head.body.tail[3].bias
    bad.register_hook(
        lambda gradient: gradient.index_fill(0, torch.tensor([1]), torch.nan)
    )
    with pytest.raises(NonFiniteError, match="actor gradient norm nan"):
        ppo.update(bandit_rollout(agent))
    found = [n for n, p in agent.named_parameters() if p.grad.isnan().any()]
    assert found == ["head.body.tail.3.bias"]


def test_a_loss_that_is_not_finite_stops_before_the_weights_change():
    agent = bandit_agent()
    ppo = PPO(agent, PPOConfig())
    rollout = bandit_rollout(agent)
    rollout["reward"][3, 5] = float("nan")
    before = {k: v.clone() for k, v in agent.state_dict().items()}
    with pytest.raises(NonFiniteError, match="gradient norm"):
        ppo.update(rollout)
    for key, value in agent.state_dict().items():
        assert torch.equal(value, before[key]), key


def test_shares_of_a_minibatch_add_up_to_the_whole():
    results = []
    for shares in (1, 4):
        agent = bandit_agent()
        ppo = PPO(agent, PPOConfig(ppo_epochs=1))
        ppo.shares = shares
        metrics = ppo.update(bandit_rollout(agent))
        results.append((metrics, agent.head.body.tail[3].weight.detach()))
    (whole, expected), (shared, weight) = results
    torch.testing.assert_close(weight, expected)
    assert shared["loss_critic"] == pytest.approx(whole["loss_critic"], rel=1e-5)
    assert shared["grad_norm_actor"] == pytest.approx(whole["grad_norm_actor"], 1e-4)


@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_changes_no_bit(threads: int):
    results = []
    for n in (1, threads):
        agent = bandit_agent()
        metrics = PPO(agent, PPOConfig(ppo_epochs=1), n).update(bandit_rollout(agent))
        results.append((metrics, agent.head.body.tail[3].weight.detach()))
    (one, expected), (several, weight) = results
    assert torch.equal(weight, expected)
    assert several == one


def test_a_loss_that_is_not_finite_stops_the_update_though_its_gradient_is_zero():
    config = PPOConfig(ppo_epochs=1)
    # The logarithm of a negative bound: such a loss is NaN, with a gradient of zero.
    object.__setattr__(config, "clip_epsilon", 1.5)
    agent = bandit_agent()
    with pytest.raises(NonFiniteError, match="loss_actor nan"):
        PPO(agent, config).update(bandit_rollout(agent))


@pytest.mark.parametrize(
    "field",
    [
        {"gamma": 1.5},
        {"value_lambda": -0.1},
        {"clip_epsilon": 0.0},
        {"desired_kl": -1.0},
        {"ppo_epochs": 0},
        {"noise_correlation": 1.0},
        {"noise_correlation_start": -1},
        {"entropy_frames": 0},
        {"learning_rate": 0.1},
        {"learning_rate": 1e-6},
        {"clip_epsilon": float("inf")},
        {"clip_epsilon": 1.5},
    ],
)
def test_values_outside_their_range_are_refused(field: dict):
    with pytest.raises(ValueError, match=next(iter(field))):
        PPOConfig(**field)
