"""Thrown balls, simulated by MuJoCo, pass through the points they are aimed at."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from egoskin.envs.dodgeball import DodgeballConfig, DodgeballEnv
from egoskin.envs.physics import MujocoPhysics, PhysicsConfig, Scene
from egoskin.envs.throws import Release, ThrowConfig, Thrower
from egoskin.rng import Stream, uniform
from egoskin.robots.builtin import H1_2
from egoskin.robots.kinematics import LinkKinematics, rotate
from egoskin.robots.surface import distance_to, sample_surface
from egoskin.rounding import pad_rows

N = 64
# The default physics step; one in each control step, to look at every state.
PHYSICS = PhysicsConfig(control_hz=120, substeps=1)
FLIGHTS = ["ballistic", "straight"]
DEFAULT = torch.from_numpy(H1_2.default_joint_pos).float()


def make(config: ThrowConfig) -> Thrower:
    return Thrower(config, H1_2, PHYSICS.timestep)


def draw(thrower: Thrower, n: int = N, seed: int = 0):
    zeros = torch.zeros(n, dtype=torch.int64)
    return thrower.draw(seed, torch.arange(n), zeros, zeros)


def poses(n: int = N, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Return base poses and joint positions of leaning robots all over the floor."""
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(n, 4, generator=generator) * torch.tensor([1, 0.1, 0.1, 1])
    position = 4 * torch.rand(n, 3, generator=generator) - 2
    position[:, 2] = H1_2.default_base_height
    quat = torch.nn.functional.normalize(quat, dim=-1)
    noise = 0.2 * torch.randn(n, len(DEFAULT), generator=generator)
    return torch.cat((position, quat), -1), DEFAULT + noise


def heading(base_pose: torch.Tensor) -> torch.Tensor:
    """Return the elevation of the base's x axis above the plane."""
    x = base_pose.new_tensor([1.0, 0, 0]).expand(len(base_pose), 3)
    forward = rotate(base_pose[:, 3:], x)
    return torch.atan2(forward[:, 1], forward[:, 0])


def aim_points(thrower: Thrower, drawn, base_pose, joint_pos) -> torch.Tensor:
    bearing = heading(base_pose) + drawn.azimuth
    side = torch.stack((bearing.cos(), bearing.sin()), -1)
    return thrower._target(drawn, base_pose, joint_pos, side)


def fly(release: Release, config: ThrowConfig, steps: int = 240) -> torch.Tensor:
    """Return ball positions in MuJoCo, without the robot, ``[steps + 1, n, 3]``."""
    scene = Scene(
        robot=H1_2,
        objects=config.balls[:1],
        config=PHYSICS,
        weightless_objects=config.flight == "straight",
        hold=True,
    )
    n = len(release.position)
    physics, rows = MujocoPhysics(scene, n), torch.arange(n)
    away = torch.tensor([100.0, 0, 3, 1, 0, 0, 0])
    joint_pos = DEFAULT.expand(n, -1)
    physics.reset(rows, away.expand(n, 7), joint_pos)
    physics.throw(rows, 0 * rows, release.position, release.velocity)
    path = [physics.read().object_pose[:, 0, :3]]
    for _ in range(steps):
        result = physics.step(joint_pos, torch.ones(n, 1, dtype=torch.bool))
        assert not result.object_hit.any()
        path.append(physics.read().object_pose[:, 0, :3])
    return torch.stack(path)


def closest(path: torch.Tensor, target: torch.Tensor, velocity: torch.Tensor):
    """Return the least distance of balls from points at constant velocity, ``[n]``."""
    time = torch.arange(len(path))[:, None, None] * PHYSICS.timestep
    gap = path - (target + velocity * time)
    a, b = gap[:-1], gap[1:]
    # The nearest point of the segment a b to the origin.
    along = (-(a * (b - a)).sum(-1) / (b - a).square().sum(-1)).clamp(0, 1)
    return (a + along[..., None] * (b - a)).norm(dim=-1).min(0).values


# --- aim ------------------------------------------------------------------------


@pytest.mark.parametrize("flight", FLIGHTS)
@pytest.mark.parametrize("aim", ["skin", "body", "box"])
@pytest.mark.parametrize("lead", [0.0, 0.5, 1.0])
def test_the_ball_passes_through_the_point_led_by_the_base(flight, aim, lead):
    config = ThrowConfig(flight=flight, aim=aim, lead=lead)
    thrower = make(config)
    drawn, (base_pose, joint_pos) = draw(thrower), poses()
    generator = torch.Generator().manual_seed(1)
    velocity = 2 * torch.rand(N, 3, generator=generator) - 1
    target = aim_points(thrower, drawn, base_pose, joint_pos)
    release = thrower.release(drawn, base_pose, velocity, joint_pos)
    # Only the planar velocity is led: a bobbing base does not keep rising.
    run = lead * velocity * torch.tensor([1.0, 1, 0])
    assert closest(fly(release, config), target, run).max() < 0.01


@pytest.mark.parametrize("flight", FLIGHTS)
@pytest.mark.parametrize("aim", ["skin", "body"])
def test_the_point_aimed_at_lies_on_the_link_that_is_named(flight, aim):
    # An independent view: the path meets the surface of that link's own shapes.
    config = ThrowConfig(flight=flight, aim=aim)
    thrower = make(config)
    drawn, (base_pose, joint_pos) = draw(thrower, 16), poses(16)
    release = thrower.release(drawn, base_pose, torch.zeros(16, 3), joint_pos)
    path = fly(release, config).double()
    position, rotation = LinkKinematics(H1_2.chain, H1_2.links).poses_b(joint_pos)
    for i, link in enumerate(thrower.aim_link(drawn)):
        k = H1_2.links.index(link)
        points = torch.stack(
            [a + s * (b - a) for a, b in zip(path[:-1, i], path[1:, i], strict=True)
             for s in np.linspace(0, 1, 8)]
        )  # fmt: skip
        quat = base_pose[i, 3:].double() * torch.tensor([1, -1, -1, -1])
        in_base = rotate(quat.expand(len(points), 4), points - base_pose[i, :3])
        in_link = (in_base - position[i, k]) @ rotation[i, k].double()
        distance = np.min(
            [
                distance_to(s, in_link.numpy())
                for s in H1_2.primitives
                if s.link == link
            ],
            axis=0,
        )
        assert distance.min() < 0.01


def test_the_body_is_aimed_at_without_shins_and_feet_and_the_skin_without_legs():
    body, skin = (
        set(make(config).aim_link(draw(make(config), 8192)))
        for config in (ThrowConfig(aim="body"), ThrowConfig(aim="skin"))
    )
    assert not any("knee" in name or "ankle" in name for name in body)
    assert any("hip" in name for name in body)
    # The torso, which carries the head, and the arms: all links that can have a skin
    # and that have a shape.
    solid = {shape.link for shape in H1_2.primitives}
    assert skin == set(H1_2.skin_links) & solid
    assert skin < body
    assert "torso_link" in skin
    assert not any("hip" in name or "pelvis" in name for name in skin)


@pytest.mark.parametrize("aim", ["skin", "body"])
def test_links_are_aimed_at_by_area(aim):
    thrower = make(ThrowConfig(aim=aim))
    aimed = thrower.aim_link(draw(thrower, 8192))
    targeted = [
        name
        for name in H1_2.links
        if (name in H1_2.skin_links)
        or (aim == "body" and name not in H1_2.untargeted_links)
    ]
    # Independent sample of the same surface; the aim itself is 4096 fixed points.
    points = sample_surface(H1_2, targeted, 50_000, seed=77)
    for name in targeted:
        share = (points.link == H1_2.links.index(name)).mean()
        found = np.mean([a == name for a in aimed])
        error = math.sqrt(share * (1 - share) * (1 / 4096 + 1 / 8192))
        assert found == pytest.approx(share, abs=5 * error + 1e-9)


def test_box_targets_fill_the_box_across_the_flight():
    config = ThrowConfig(aim="box", box_half_width=0.5, box_height=(0.4, 1.6))
    thrower = make(config)
    drawn, (base_pose, joint_pos) = draw(thrower, 256), poses(256)
    release = thrower.release(drawn, base_pose, torch.zeros(256, 3), joint_pos)
    path = fly(release, config)
    toward = (release.position - base_pose[:, :3])[:, :2]
    toward = toward / toward.norm(dim=-1, keepdim=True)
    gap = path[..., :2] - base_pose[:, :2]
    ahead = (gap * toward).sum(-1)
    across = gap[..., 1] * toward[:, 0] - gap[..., 0] * toward[:, 1]
    # The step in which the ball crosses the plane through the base.
    step = (ahead > 0).sum(0) - 1
    row = torch.arange(256)
    share = ahead[step, row] / (ahead[step, row] - ahead[step + 1, row])

    def crossing(x: torch.Tensor) -> torch.Tensor:
        return x[step, row] + share * (x[step + 1, row] - x[step, row])

    for value, (low, high) in (
        (crossing(across), (-0.5, 0.5)),
        (crossing(path[..., 2]), (0.4, 1.6)),
    ):
        assert low - 0.01 < value.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < value.max() < high + 0.01
        # Standard error of the mean of a uniform number: width / sqrt(12 n).
        middle = (low + high) / 2
        assert value.mean() == pytest.approx(middle, abs=5 * (high - low) / 55)


def test_points_of_the_skin_are_spread_over_the_shapes_of_its_links():
    # In each slice of the torso lie as many points as its surface has area there.
    thrower = make(ThrowConfig(aim="skin"))
    drawn, n = draw(thrower, 8192), 8192
    torso = torch.tensor([name == "torso_link" for name in thrower.aim_link(drawn)])
    base_pose = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]]).expand(n, 7)
    joint_pos = torch.zeros(n, len(DEFAULT))
    points = aim_points(thrower, drawn, base_pose, joint_pos)[torso]
    position, _ = LinkKinematics(H1_2.chain, H1_2.links).poses_b(joint_pos[:1])
    local = points - position[0, H1_2.links.index("torso_link")]
    other = sample_surface(H1_2, ["torso_link"], 50_000, seed=77).position
    for axis in range(3):
        low, high = other[:, axis].min(), other[:, axis].max()
        for bound in np.linspace(low, high, 7)[1:-1]:
            share = (other[:, axis] < bound).mean()
            found = (local[:, axis] < bound).float().mean().item()
            # The aim itself is some 2,400 fixed points of the torso.
            error = math.sqrt(share * (1 - share) * (1 / 2400 + 1 / len(local)))
            assert found == pytest.approx(share, abs=5 * error)


# --- draws ----------------------------------------------------------------------


def delays(config: ThrowConfig, n: int = 4096, *, seed=0, episode=0) -> torch.Tensor:
    row = torch.arange(n)
    return make(config).first_delay(seed, row, torch.full_like(row, episode))


def test_the_first_delay_is_uniform_over_its_range():
    value = delays(ThrowConfig(first_delay=(0.5, 1.7)))
    assert 0.5 <= value.min() < 0.5 + 0.012
    assert 1.7 - 0.012 < value.max() <= 1.7
    # Mean 1.1 and variance 1.2^2 / 12 of a uniform number.
    assert value.mean() == pytest.approx(1.1, abs=5 * 1.2 / math.sqrt(12 * 4096))
    assert value.var() == pytest.approx(1.2**2 / 12, rel=0.1)
    assert not delays(ThrowConfig(first_delay=(0.0, 0.0))).any()
    # By default 0 to 2 s.
    assert torch.allclose(delays(ThrowConfig()), (value - 0.5) * 2 / 1.2, atol=1e-5)


def test_the_first_delay_is_drawn_from_a_stream_of_its_own():
    config = ThrowConfig()
    value = delays(config)
    # Fixed, like the throws: one number for each seed, row and episode.
    row = torch.arange(4096)
    u = uniform(0, Stream.FIRST_DELAY, row, row * 0, row * 0, 1)[:, 0]
    assert torch.equal(value, 2 * u)
    assert int(Stream.FIRST_DELAY) == 3
    for other in (delays(config, seed=1), delays(config, episode=1)):
        assert np.corrcoef(value, other)[0, 1] == pytest.approx(0, abs=5 / 64)
    drawn = draw(make(config), 4096)
    values = [drawn.azimuth, drawn.distance, drawn.height, drawn.speed, drawn.interval]
    for other in (*values, *drawn.target.T):
        assert np.corrcoef(value, other)[0, 1] == pytest.approx(0, abs=5 / 64)
    # The throws do not depend on it.
    at_once = draw(make(ThrowConfig(first_delay=(0.0, 0.0))), 4096)
    for name in ("azimuth", "distance", "height", "speed", "interval", "target"):
        assert torch.equal(getattr(drawn, name), getattr(at_once, name)), name


def test_draws_fill_the_ranges_of_the_configuration():
    config = ThrowConfig(
        interval=(0.7, 0.9),
        height=(1.0, 1.5),
        distance=(3.0, 7.0),
        speed=(5.0, 6.0),
        azimuth_deg=(20.0, 80.0),
    )
    drawn = draw(make(config), 4096)
    for name in ("interval", "height", "distance", "speed", "azimuth"):
        if name == "azimuth":
            low, high = np.deg2rad(config.azimuth_deg)
        else:
            low, high = getattr(config, name)
        value, width = getattr(drawn, name), high - low
        assert low - 1e-6 <= value.min() < low + 0.01 * width
        assert high - 0.01 * width < value.max() <= high + 1e-6
        error = 5 * width / math.sqrt(12 * 4096)
        assert value.mean() == pytest.approx((low + high) / 2, abs=error)
    values = [drawn.interval, drawn.height, drawn.distance, drawn.speed, drawn.azimuth]
    correlation = np.corrcoef(np.stack([*values, *drawn.target.T]))
    assert np.abs(correlation - np.eye(7)).max() < 5 / math.sqrt(4096)


def test_a_throw_is_released_where_its_draw_says():
    thrower = make(ThrowConfig(azimuth_deg=(-40, 10)))
    drawn, (base_pose, joint_pos) = draw(thrower), poses()
    release = thrower.release(drawn, base_pose, torch.zeros(N, 3), joint_pos)
    gap = release.position[:, :2] - base_pose[:, :2]
    torch.testing.assert_close(gap.norm(dim=-1), drawn.distance)
    torch.testing.assert_close(release.position[:, 2], drawn.height)
    # The direction it comes from, relative to the robot's heading.
    angle = torch.atan2(gap[:, 1], gap[:, 0]) - heading(base_pose)
    angle = torch.rad2deg(torch.atan2(angle.sin(), angle.cos()))
    torch.testing.assert_close(angle, torch.rad2deg(drawn.azimuth), atol=1e-3, rtol=0)
    assert -40.001 < angle.min() < -38
    assert 8 < angle.max() < 10.001


@pytest.mark.parametrize("lead", [0.0, 1.0])
@pytest.mark.parametrize("flight", FLIGHTS)
@pytest.mark.parametrize("base_speed", [0.0, 1.0, 20.0])
def test_the_speed_is_horizontal_if_ballistic_and_whole_if_straight(
    flight, lead, base_speed
):
    # Even for a base that outruns the ball: led as if it were slower.
    thrower = make(ThrowConfig(flight=flight, lead=lead))
    drawn, (base_pose, joint_pos) = draw(thrower), poses()
    generator = torch.Generator().manual_seed(2)
    velocity = base_speed * torch.randn(N, 3, generator=generator)
    release = thrower.release(drawn, base_pose, velocity, joint_pos)
    used = release.velocity[:, :2] if flight == "ballistic" else release.velocity
    torch.testing.assert_close(used.norm(dim=-1), drawn.speed, rtol=1e-3, atol=0)
    assert release.velocity.isfinite().all()


@pytest.mark.parametrize("flight", FLIGHTS)
@pytest.mark.parametrize(("share", "led"), [(0.8, 0.8), (3.0, 0.9)])
def test_a_base_is_led_up_to_nine_tenths_of_the_speed_of_the_ball(flight, share, led):
    thrower = make(ThrowConfig(flight=flight))
    drawn, (base_pose, joint_pos) = draw(thrower), poses()
    angle = torch.linspace(0, 2 * math.pi, N)
    way = torch.stack((angle.cos(), angle.sin()), -1)
    run = torch.nn.functional.pad(drawn.speed[:, None] * way, (0, 1))
    release = thrower.release(drawn, base_pose, share * run, joint_pos)
    # Seen from a point that moves at the speed led, the ball flies straight to it.
    gap = aim_points(thrower, drawn, base_pose, joint_pos) - release.position
    seen = release.velocity - led * run
    used = 2 if flight == "ballistic" else 3
    one, other = (torch.nn.functional.normalize(x[:, :used]) for x in (gap, seen))
    torch.testing.assert_close(one, other, atol=1e-3, rtol=0)


# 4 m away, to a target at the height of release.
LEVEL = ThrowConfig(
    flight="ballistic",
    aim="box",
    box_half_width=0.0,
    box_height=(2.0, 2.0),
    height=(2.0, 2.0),
    distance=(4.0, 4.0),
)


def test_a_vertical_fall_of_the_height_by_hand():
    # A robot at rest, ball 4 m ahead at 4 m/s: 1 s of flight. To a target at
    # the height of release: vz = g (T + dt) / 2 = 9.81 (1 + 1/120) / 2 = 4.945875.
    config = replace(LEVEL, speed=(4.0, 4.0), azimuth_deg=(0.0, 0.0))
    thrower = make(config)
    base_pose = torch.tensor([[1.0, 2, 1, 1, 0, 0, 0]])
    release = thrower.release(
        draw(thrower, 1), base_pose, torch.zeros(1, 3), DEFAULT[None]
    )
    torch.testing.assert_close(release.position, torch.tensor([[5.0, 2, 2]]))
    torch.testing.assert_close(release.velocity, torch.tensor([[-4.0, 0, 4.945875]]))
    # It comes down with vz = 4.945875 - 9.81 = -4.864125: speed sqrt(16 + 23.660).
    height, speed = thrower.at_standing_robot(draw(thrower, 1))
    torch.testing.assert_close(height, torch.tensor([2.0]))
    torch.testing.assert_close(speed, torch.tensor([6.297600]))


# --- invariances ----------------------------------------------------------------


@pytest.mark.parametrize("flight", FLIGHTS)
def test_turning_the_robot_turns_the_throw(flight):
    thrower = make(ThrowConfig(flight=flight))
    drawn, (base_pose, joint_pos) = draw(thrower), poses()
    generator = torch.Generator().manual_seed(3)
    velocity = torch.randn(N, 3, generator=generator)
    release = thrower.release(drawn, base_pose, velocity, joint_pos)
    half = torch.tensor(0.4)
    yaw = torch.stack((half.cos(), half * 0, half * 0, half.sin())).expand(N, 4)
    shift = torch.tensor([3.0, -1.0, 0.0])
    w, x, y, z = base_pose[:, 3:].unbind(-1)
    c, s = half.cos(), half.sin()
    turned = (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)
    position = rotate(yaw, base_pose[:, :3]) + shift
    moved = torch.cat((position, torch.stack(turned, -1)), -1)
    again = thrower.release(drawn, moved, rotate(yaw, velocity), joint_pos)
    expected = rotate(yaw, release.position) + shift
    torch.testing.assert_close(again.position, expected, atol=1e-5, rtol=1e-5)
    expected = rotate(yaw, release.velocity)
    torch.testing.assert_close(again.velocity, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("flight", FLIGHTS)
def test_a_padded_subset_is_thrown_to_the_same_bits(flight):
    thrower = make(ThrowConfig(flight=flight))
    drawn, (base_pose, joint_pos) = draw(thrower), poses()
    velocity = torch.ones(N, 3)
    whole = thrower.release(drawn, base_pose, velocity, joint_pos)
    generator = torch.Generator().manual_seed(4)
    for n in (1, 3, 16, 17, 40):
        rows = torch.randperm(N, generator=generator)[:n]
        padded = pad_rows(rows)
        zeros = torch.zeros_like(padded)
        some = thrower.release(
            thrower.draw(0, padded, zeros, zeros),
            base_pose[padded],
            velocity[padded],
            joint_pos[padded],
        )
        assert torch.equal(some.position[:n], whole.position[rows])
        assert torch.equal(some.velocity[:n], whole.velocity[rows])


# --- the rigid robot ------------------------------------------------------------


@pytest.mark.parametrize("aim", ["skin", "body"])
@pytest.mark.parametrize("flight", FLIGHTS)
def test_every_throw_hits_a_rigid_robot(flight, aim, request, capsys):
    throws = ThrowConfig(flight=flight, aim=aim, first_delay=(0.0, 0.0))
    config = DodgeballConfig(throws=throws)
    env = DodgeballEnv(H1_2, config, num_envs=64, seed=0, hold=True)
    td = env.reset()
    zero = torch.zeros(64, len(DEFAULT))
    alive, survival = torch.ones(64, dtype=torch.bool), torch.zeros(64)
    while alive.any() and survival.max() < 2:
        step, td = env.step_and_maybe_reset(td.set("action", zero))
        step = step["next"]
        survival += alive / 60
        ended = alive & step["done"][:, 0]
        # Only by the first ball, which counts as arrived, not as avoided.
        assert step["hit"][ended].all()
        assert not step["fallen"][ended].any()
        assert (step["balls_arrived"][ended] == torch.tensor([1.0, 0])).all()
        assert not step["balls_avoided"][ended].any()
        alive &= ~ended
    assert not alive.any()
    with capsys.disabled():
        case = request.node.callspec.id
        print(f" [{case}: rigid robot survives {survival.mean():.2f} s]", end="")


# --- errors ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"interval": (2.0, 1.0)},
            r"interval must be \(low, high\) with low <= high, got \(2.0, 1.0\)",
        ),
        ({"azimuth_deg": (10.0, -10.0)}, r"azimuth_deg must be \(low, high\) with"),
        ({"height": (0.0, 1.0)}, "height must be positive"),
        ({"first_delay": (2.0, 1.0)}, r"first_delay must be \(low, high\) with low <="),
        (
            {"first_delay": (-0.5, 1.0)},
            r"first_delay must not be negative, got \(-0.5, 1.0\)",
        ),
        ({"first_delay": (math.nan, math.nan)}, "first_delay must be a finite number"),
        ({"first_delay": (0.0, math.inf)}, "first_delay must be a finite number"),
        ({"interval": (1.0, math.inf)}, "interval must be a finite number"),
        ({"num_balls": 2**31}, "num_balls must be at most 100, got 2147483648"),
        ({"distance": (-1.0, 1.0)}, "distance must be positive"),
        ({"speed": (0.0, 0.0)}, "speed must be at least 0.01"),
        ({"box_height": (math.nan, 1.0)}, "box_height must be"),
        ({"num_balls": 0}, "num_balls must be at least 1, got 0"),
        ({"lead": -0.1}, "lead must not be negative, got -0.1"),
        ({"box_half_width": 0.0}, "box_half_width has no effect without aim=box"),
        ({"box_height": (1.0, 1.0)}, "box_height has no effect without aim=box"),
        ({"size": (0.1,)}, "size has no effect with shape=sphere: use radius"),
        (
            {"shape": "box", "size": (0.1, 0.1, 0.1), "radius": 0.2},
            "radius has no effect with shape=box: use size",
        ),
        ({"shape": "box"}, r"a box needs 3 sizes, got \[\]"),
        ({"shape": "capsule", "size": (0.1, 0.2, 0.3)}, "a capsule needs 2 sizes"),
        ({"shape": "box", "size": (0.1, 0.0, 0.1)}, "size must be at least 0.001"),
        ({"shape": "cube", "size": (0.1,)}, "shape must be one of sphere, .*'cube'"),
    ],
)
def test_throws_that_cannot_be_thrown_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        ThrowConfig(**changes)


@pytest.mark.parametrize("radius", [0.0, 1e-6])
def test_a_ball_too_small_for_the_simulator_is_refused(radius):
    with pytest.raises(ValueError, match="radius must be at least 0"):
        ThrowConfig(radius=radius)
