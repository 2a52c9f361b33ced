"""The engine against a simple form of its contract: whole rollouts, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.physics import MujocoPhysics, PhysicsConfig
from egoskin.envs.randomization import RandomizationConfig
from egoskin.envs.throws import ThrowConfig
from egoskin.robots.builtin import H1_2
from simple_physics import SimplePhysics

# Balls from all sides, early and often.
OFTEN = ThrowConfig(first_delay=(0.0, 0.6), interval=(0.2, 0.4), distance=(1.5, 2.5))
RANDOM = RandomizationConfig(
    link_mass=(0.7, 1.4),
    friction=(0.3, 1.2),
    gains=(0.7, 1.3),
    torque_limit=(0.2, 1.2),
    delay_steps=(0, 2),
    push_speed=(0.5, 2.0),
    push_interval=(0.1, 0.3),
)
STIFF = PhysicsConfig(gains="real", target_velocity="finite_difference", substeps=3)


@pytest.mark.parametrize(
    ("config", "hold", "ends"),
    [
        (DodgeballConfig(throws=OFTEN), False, {"hit", "fallen"}),
        (
            DodgeballConfig(throws=OFTEN, episode_length_s=0.35),
            True,
            {"hit", "truncated"},
        ),
        (
            DodgeballConfig(
                throws=replace(OFTEN, flight="ballistic", num_balls=3),
                physics=STIFF,
                self_contact_ends=True,
            ),
            False,
            {"hit", "self_contact"},
        ),
        (
            DodgeballConfig(throws=OFTEN, randomization=RANDOM),
            False,
            {"hit", "fallen"},
        ),
    ],
    ids=["default", "rigid", "stiff", "random"],
)
def test_an_engine_of_a_loop_over_single_simulations_gives_the_same_bits(
    config, hold, ends
):
    kwargs = {"num_envs": 8, "seed": 1, "row_offset": 3, "hold": hold}
    fast, simple = (
        DodgeballEnv(H1_2, config, engine=engine, **kwargs)
        for engine in (MujocoPhysics, SimplePhysics)
    )
    # Half of the robots are driven to the ground, the others flail.
    down = torch.tensor(["hip_pitch" in name for name in H1_2.joints]).float()
    bias = -3 * down * (torch.arange(8) < 4)[:, None]
    generator = torch.Generator().manual_seed(0)
    roots, seen = [fast.reset(), simple.reset()], set()
    for number in range(50):
        action = bias + 0.8 * torch.randn(8, len(H1_2.joints), generator=generator)
        steps = []
        for i, env in enumerate((fast, simple)):
            step, roots[i] = env.step_and_maybe_reset(roots[i].set("action", action))
            steps.append(step["next"])
        for one, other in (steps, roots):
            for key in one.keys():
                assert torch.equal(one[key], other[key]), (number, key)
        seen |= {key for key in ends if steps[0][key].any()}
        if number == 25:
            # Each continues from the state that the other saved.
            saved, other = (env.simulation_state() for env in (fast, simple))
            for key, value in saved.items():
                assert torch.equal(value, other[key]), key
            fast.physics.load_state(other["physics"])
            simple.physics.load_state(saved["physics"])
    assert seen == ends
