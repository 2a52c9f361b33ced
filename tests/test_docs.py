"""Documentation: its code runs as printed, its tables match the code."""

from __future__ import annotations

import csv
import doctest
import fnmatch
import io
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import egoskin
from calling import call, succeed
from egoskin.agents.ppo import PPOConfig
from egoskin.envs.dodgeball import DodgeballConfig
from egoskin.envs.randomization import RandomizationConfig
from egoskin.envs.throws import ThrowConfig
from egoskin.make import EnvConfig, make_worker_env
from egoskin.policies.export import export_onnx, observation_parts
from egoskin.robots.builtin import H1_2
from egoskin.runs.config import TrainConfig, parse_config
from egoskin.sensors.config import SensorConfig
from egoskin.sensors.imperfections.models import (
    Bias,
    DeadSensors,
    Drift,
    Dropout,
    FalsePositives,
    Latency,
    Noise,
    Quantisation,
    RangeLimits,
    SampleAndHold,
)
from egoskin.sensors.imperfections.presets import PRESETS
from egoskin.storage.serialization import to_plain
from egoskin.study.findings import FINDINGS
from egoskin.study.manifest import resolve
from egoskin.study.shipped import PAPER
from owning import write_robot

DOCS = Path(__file__).parents[1] / "docs"
DEPLOY = DOCS / "deploy.md"
SLOW = pytest.mark.slow
CODE = re.findall(r"```python\n(.*?)```", DEPLOY.read_text(), re.DOTALL)

DRIVER = '''
from types import SimpleNamespace

import numpy as np


class Driver:
    """A robot that stands still; after three steps its skin stays silent."""

    def __init__(self, joints, kp, kd):
        assert len(joints) == len(kp) == len(kd) == 21
        self.targets = []

    def read_body(self):
        still = np.zeros(21)
        quat = np.array([1.0, 0.0, 0.0, 0.0])
        return SimpleNamespace(
            quat=quat, ang_vel=np.zeros(3), pos=still, vel=still, age=0.002
        )

    def read_skin(self):
        age = 0.02 if len(self.targets) < 3 else 0.5
        return SimpleNamespace(distance=np.full(64, np.inf), age=age)

    def send(self, target):
        assert target.shape == (21,)
        self.targets.append(target)

    def sleep_until_next(self, period):
        assert 0 < period < 0.1

    def damp(self):
        print(len(self.targets), "targets")
'''


def test_the_document_has_its_examples():
    assert len(CODE) == 5


ALL = [0, *(pytest.param(number, marks=SLOW) for number in (1, 2, 4))]


@pytest.mark.parametrize("number", ALL)
def test_an_example_runs_as_given(number, tmp_path):
    (tmp_path / "my_robot.py").write_text(DRIVER)
    policy = egoskin.load_policy("field_proximity")
    (tmp_path / "policy.onnx").write_bytes(export_onnx(policy)[0])
    (tmp_path / "example.py").write_text(CODE[number])
    done = subprocess.run(
        [sys.executable, "example.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    said = re.findall(r"print\(.*#(.*)", CODE[number])
    if number == 0:
        said = ["4 targets", "the distances of the skin are 0.5 s old"]
    lines = [line.strip() for line in done.stdout.splitlines() if "torchrl" not in line]
    assert lines == [line.strip() for line in said]


def test_the_loop_damps_the_motors_also_after_an_exception(tmp_path):
    # The driver delivers 20 of 21 velocities.
    (tmp_path / "my_robot.py").write_text(
        DRIVER.replace("vel=still,", "vel=still[1:],")
    )
    policy = egoskin.load_policy("field_proximity")
    (tmp_path / "policy.onnx").write_bytes(export_onnx(policy)[0])
    done = subprocess.run(
        [sys.executable, "-c", CODE[0]], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout == "0 targets\n"
    *_, last = done.stderr.splitlines()
    assert last == "ValueError: joint_vel must have the shape [21], got [20]"


def test_cleanrl_is_told_of_many_robots_what_it_wants():
    names: dict[str, Any] = {"__name__": "example"}
    exec(compile(CODE[3], "deploy", "exec"), names)
    envs = names["make_envs"]("egoskin.gym:egoskin/Dodgeball-v0", 4, 0.99)
    plain = gymnasium.make_vec("egoskin.gym:egoskin/Dodgeball-v0", 4, num_workers=1)
    seen, (raw, _) = [envs.reset(seed=1)[0]], plain.reset(seed=1)
    told, returns, lengths, infos = [raw], np.zeros(4), np.zeros(4), {}
    while "final_info" not in infos:
        action = np.full((4, 21), 100.0, dtype=np.float32)
        observations, rewards, *_, infos = envs.step(action)
        raw, unscaled, *_ = plain.step(np.minimum(action, plain.action_space.high))
        seen.append(observations)
        told.append(raw)
        returns, lengths = returns + unscaled, lengths + 1
        assert (np.abs(rewards) <= 10).all()
        assert (rewards != unscaled).any()
    over, episode = infos["final_info"]["_episode"], infos["final_info"]["episode"]
    assert over.any()
    np.testing.assert_allclose(episode["r"][over], returns[over])
    np.testing.assert_array_equal(episode["l"][over], lengths[over])
    assert np.abs(seen).max() <= 10
    # Scaled by the statistics of all robots until then.
    rows = np.concatenate(told)
    scaled = (told[-1] - rows.mean(0)) / np.sqrt(rows.var(0) + 1e-8)
    np.testing.assert_allclose(seen[-1], np.clip(scaled, -10, 10), atol=0.02)
    envs.close()
    plain.close()


# --- Tutorials --------------------------------------------------------------------

# Parts of a tutorial: files (```json name), programs, commands with output.
BLOCK = re.compile(r"^```(\w+)(?: (\S+))?\n(.*?)^```$", re.DOTALL | re.MULTILINE)
# A command after "$ ", and what it prints.
COMMAND = re.compile(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", re.MULTILINE)
TUTORIALS = [
    "tutorial-sensors",
    "tutorial-gentact",
    pytest.param("tutorial-study", marks=SLOW),
    "tutorial-deploy",
    "tutorial-train",
    pytest.param("sensors", marks=SLOW),
    pytest.param("your-robot", marks=SLOW),
]


def agree(expected: str, found: str) -> bool:
    """Whether a text matches the expected one, in which ... matches anything."""
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    return doctest.OutputChecker().check_output(expected, found, options)


def said_by(code: str) -> str:
    """Expected output of a program: comments after print(...) or on lines below."""
    return "".join(
        f"{text}\n"
        for text in re.findall(r"(?:print\(.*  |^)# (.*)", code, re.MULTILINE)
    )


@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_runs_as_given(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "tutorial"}
    blocks = BLOCK.findall((DOCS / f"{name}.md").read_text())
    assert blocks
    for language, file, text in blocks:
        if file:
            Path(file).parent.mkdir(exist_ok=True)
            Path(file).write_text(text)
        elif language == "python":
            with redirect_stdout(io.StringIO()) as out:
                exec(compile(text, name, "exec"), names)
            assert agree(said_by(text), out.getvalue()), out.getvalue()
        else:
            for command, answer in COMMAND.findall(text):
                program, *words = shlex.split(command)
                assert program == "egoskin"
                found = succeed(*words)
                assert agree(answer or "...", found), found


# --- Tables -----------------------------------------------------------------------


def table(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the first table below a heading that begins so."""
    text = (DOCS / page).read_text()
    _, _, below = text.partition(f"\n## {heading}")
    found = re.search(r"(?:^\|.*\n)+", below, re.MULTILINE)
    assert found, heading
    rows = found[0].splitlines()[2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


def numbers(text: str) -> list[float]:
    """Return the numbers in a text."""
    found = re.findall(r"-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?", text)
    return [float(number.replace(",", "")) for number in found]


def code(text: str) -> list[str]:
    """Return the texts in back quotes."""
    return re.findall("`(.*?)`", text)


def test_the_observation_is_what_the_actor_reads():
    policy = egoskin.load_policy("field_proximity")
    parts = [(p["name"], p["width"], p["unit"]) for p in observation_parts(policy)]
    rows = table("task.md", "What the actor observes")
    assert [(code(n)[0], int(w), u) for n, w, u, _ in rows] == parts


def test_the_signals_are_as_wide_as_they_say():
    text = (DOCS / "task.md").read_text()
    said = dict(re.findall(r"^\| (`.*?) \| (\d+) \| .*\|$", text, re.MULTILINE))
    kinds = {
        "`field`; `proximity`, `closeness` or `binary`": SensorConfig(),
        "`ray`, all beams": SensorConfig(coverage="ray"),
        "`ray`, `--sensor.reduce min`": SensorConfig(coverage="ray", reduce="min"),
        "`localization`, any sensors": SensorConfig(signal="localization"),
    }
    for words, sensor in kinds.items():
        size = EnvConfig(sensor=sensor).pipeline().signal_size
        assert int(said[words]) == size, words
    env = make_worker_env(
        EnvConfig(sensor=SensorConfig(coverage="oracle")), num_envs=1, seed=0
    )
    assert int(said["`oracle`"]) == env.observation_spec["signal"].shape[-1]
    assert said["`none`"] == "0"


def test_the_joints_have_the_gains_and_limits_they_say():
    task = DodgeballConfig()
    kp, kd = H1_2.joint_gains(task.physics.gains)
    limit, left = H1_2.torque_limit, set(H1_2.joints)
    for names, *said in table("task.md", "Action"):
        for pattern in code(names):
            stiffness, damping, torque, scale = map(float, said)
            matching = fnmatch.filter(H1_2.joints, f"{pattern}_joint")
            assert matching, pattern
            for joint in matching:
                i = H1_2.joints.index(joint)
                assert (kp[i], kd[i], limit[i]) == (stiffness, damping, torque), joint
                assert abs(task.action_scale * limit[i] / kp[i] - scale) < 5e-4
                left.discard(joint)
    assert not left


def test_the_reward_has_the_weights_it_says():
    rows = table("task.md", "Reward")
    assert {code(n)[0]: float(w) for n, w, _ in rows} == asdict(
        DodgeballConfig().reward
    )


def test_throws_and_ends_are_as_they_say():
    throws, task = ThrowConfig(), DodgeballConfig()
    expected = [
        [throws.radius],
        [throws.num_balls],
        *map(list, (throws.first_delay, throws.interval, throws.height)),
        *map(list, (throws.distance, throws.speed, throws.azimuth_deg)),
    ]
    rows = table("task.md", "Throws")
    assert [numbers(value) for _, value in rows[:8]] == expected
    assert (throws.aim, throws.flight) == ("skin", "straight")
    text = " ".join((DOCS / "task.md").read_text().split())
    for claim in (
        f"Physics runs at {1 / task.physics.timestep:g} Hz",
        f"the policy acts at {task.physics.control_hz:g} Hz",
        f"scale = {task.action_scale:g} x torque limit / kp",
        f"each joint within {task.start_joint_noise:g} rad",
        f"by time (`truncated`) {task.episode_length_s:g} s after",
        f"*Success* means surviving for {task.success_s:g} s",
        f"{len(H1_2.joints)} joints, {H1_2.model.body_mass.sum():.0f} kg",
    ):
        assert claim in text, claim


def test_the_critic_is_told_what_they_say():
    env = make_worker_env(EnvConfig(), num_envs=1, seed=0)
    told = env.observation_spec["privileged_observation"].shape[-1]
    assert sum(int(width) for _, width, _ in table("task.md", "The critic")) == told


def test_learning_has_the_numbers_they_say():
    run, ppo = TrainConfig(), PPOConfig()
    net = ppo.network
    rollouts = run.total_frames / run.frames_per_batch
    assert [numbers(value) for _, value in table("task.md", "Learning")] == [
        [run.num_envs, ppo.rollout_steps, run.frames_per_batch],
        [rollouts, round(run.total_frames / 1e6, 1)],
        [net.hidden[1]],
        [ppo.ppo_epochs, ppo.num_mini_batches],
        [ppo.gamma],
        [ppo.gae_lambda, ppo.value_lambda],
        [ppo.clip_epsilon],
        [ppo.learning_rate, ppo.desired_kl],
        [ppo.entropy_coeff, ppo.entropy_frames],
        [net.init_std, *net.std_bounds],
        [ppo.noise_correlation, ppo.noise_correlation_start],
    ]
    assert net.hidden == (32, 32)


def test_the_presets_of_real_sensors_are_made_of_the_numbers_they_say():
    rows = table("sensor-models.md", "Presets")
    # Without the numbers of sources and zones.
    plain = re.compile(r"\[\d\]|8 x 8 zones")
    said = {name: [numbers(plain.sub("", cell)) for cell in row] for name, *row in rows}

    def mm(x: float) -> float:
        return x / 1000

    def percent(x: float) -> float:
        return x / 100

    def row(name: str) -> Iterator[list[float]]:
        return iter(said.pop(name))

    (far,), (far_cm,), none = row("maximum range")
    (near_cm,), *others = row("minimum range")
    assert [none, *others] == [[], [], []]
    (step,), *others = row("resolution")
    assert others == [[], []]
    (light,), (charge,), (sound,) = row("rate")
    (light_late,), (charge_late,), (sound_late,) = row("latency")
    (least, share), (square,), (least_cm, sound_share, motion) = row("noise, std")
    nothing, (common,), others = row("common noise, std")
    assert nothing == others == []
    (offset, gain), (charge_gain,), (offset_cm, sound_gain) = row("bias, std")
    nothing, (drift,), others = row("drift, std after 1 s")
    assert nothing == others == []
    (lost,), nothing, (at_rest, moving, speed) = row("drop-out")
    assert (nothing, at_rest) == ([], 0)
    (false, up_to), nothing, (sound_false, sound_up_to) = row("false positives")
    assert nothing == []
    (dead,), (charge_dead,), (sound_dead,) = row("dead sensors")
    assert not said
    expected = {
        "time_of_flight": (
            Bias(offset_std=mm(offset), gain_std=percent(gain)),
            Noise(constant=mm(least), linear=percent(share)),
            Dropout(per_metre=percent(lost)),
            FalsePositives(probability=false, max_range=up_to),
            DeadSensors(probability=percent(dead)),
            RangeLimits(minimum=near_cm / 100, maximum=far),
            Quantisation(step=mm(step)),
            SampleAndHold(rate_hz=light),
            Latency(seconds=mm(light_late)),
        ),
        "capacitive": (
            Bias(gain_std=percent(charge_gain)),
            Noise(quadratic=square),
            Noise(quadratic=common, common=True),
            Drift(quadratic=drift),
            DeadSensors(probability=percent(charge_dead)),
            RangeLimits(maximum=far_cm / 100),
            SampleAndHold(rate_hz=charge),
            Latency(seconds=mm(charge_late)),
        ),
        "acoustic": (
            Bias(offset_std=offset_cm / 100, gain_std=percent(sound_gain)),
            Noise(
                constant=least_cm / 100,
                linear=percent(sound_share),
                per_speed=percent(motion),
            ),
            Dropout(per_speed=percent(moving) / speed),
            FalsePositives(probability=sound_false, max_range=sound_up_to),
            DeadSensors(probability=percent(sound_dead)),
            SampleAndHold(rate_hz=sound),
            Latency(seconds=mm(sound_late)),
        ),
    }
    assert PRESETS.keys() == expected.keys()
    for name, models in expected.items():
        for one, other in zip(PRESETS[name](), models, strict=True):
            assert type(one) is type(other)
            if isinstance(one, Latency):
                # It is told in whole milliseconds.
                assert one.seconds == pytest.approx(other.seconds, abs=0.0005)
            else:
                assert one == other


def test_every_column_of_the_metrics_is_explained(trained):
    with (trained / "metrics.csv").open() as file:
        logged = next(csv.reader(file))
    rows = table("metrics.md", "Every column of metrics.csv")
    assert [code(name)[0] for name, _, _ in rows] == logged


PAPER_PAGE = (DOCS / "paper.md").read_text()


def test_the_training_nearest_to_the_paper_is_one_of_its_study():
    (command,) = re.findall("^    egoskin train (.*)$", PAPER_PAGE, re.MULTILINE)
    found = parse_config(shlex.split(command))
    cells = {cell.name: cell.config for cell in resolve(PAPER).cells}
    expected = cells["field-proximity-2m"]
    assert (found.env, found.ppo) == (expected.env, expected.ppo)
    assert found.total_frames == expected.total_frames
    assert found.num_envs == expected.num_envs


def test_the_page_of_the_paper_names_options_that_there_are():
    values = {"--skin.seed": "1", "--sensor.range": "1", "--sensor.corruption": "none"}
    options = {text for text in code(PAPER_PAGE) if text.startswith("--")}
    assert options > {*values}
    for option in options:
        args = [*shlex.split(option.replace(" N", " 2")), values.get(option)]
        # An unknown name or value exits.
        parse_config([arg for arg in args if arg is not None])


def test_the_page_of_the_paper_names_every_finding():
    rows = table("paper.md", "Findings")
    named = {word for _, where in rows for word in re.findall(r"\b\w+\b", where)}
    assert {finding.label for finding in FINDINGS} <= named


# --- The site ---------------------------------------------------------------------


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


PAGES = sorted(DOCS.glob("*.md"))


@pytest.mark.parametrize("page", [*PAGES, DOCS.parent / "README.md"], ids=str)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if link.startswith("https://"):
            continue
        file, _, anchor = link.partition("#")
        target = page.parent / file if file else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", [*PAGES, DOCS.parent / "README.md"], ids=str)
def test_nothing_is_installed_from_where_it_is_not(page):
    # Only a clone can be: the package is not on PyPI.
    assert not re.search(r"pip install '?egoskin", page.read_text())


def test_every_page_is_in_the_contents():
    index = (DOCS / "index.md").read_text()
    listed = re.findall(r"^(?:.*<)?([\w-]+)>?$", index, re.MULTILINE)
    assert {page.stem for page in PAGES} - {"index", *listed} == set()


def test_pictures_are_small():
    for path in (*DOCS.glob("*.jpg"), *DOCS.glob("*.svg"), *DOCS.glob("pictures/*")):
        assert path.stat().st_size < 200_000, path


@pytest.mark.slow
def test_the_site_is_built_without_warnings_and_read_offline(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q"]
    subprocess.run([*command, str(DOCS), str(tmp_path)], check=True)
    built = list(tmp_path.rglob("*.html"))
    assert len(built) > len(PAGES)
    # Resources that a browser fetches by itself; links are not fetched.
    fetched = re.compile(r"<(?:script|img|link|iframe)[^>]+?=\"(?:https?:)?//[^\"]+")
    for path in built:
        assert not fetched.search(path.read_text()), path
    for path in tmp_path.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(?:https?:)?//|@import", path.read_text()), (
            path
        )


def option_names(content: dict[str, Any], group: str = "") -> set[str]:
    """Return the options of a plain configuration, as `sensor.field.half-angle-deg`."""
    names = set()
    for name, value in content.items():
        names.add(option := f"{group}{name}".replace("_", "-"))
        if isinstance(value, dict):
            names |= option_names(value, f"{option}.")
    return names


def test_pages_name_options_and_fields_that_there_are():
    content = to_plain(TrainConfig())
    known = option_names({**content, **content["env"]})
    groups = "(?:task|sensor|ppo|skin)"
    for page in (*PAGES, DOCS.parent / "README.md", DOCS.parent / "CONTRIBUTING.md"):
        text = page.read_text()
        options = re.findall(rf"--({groups}\.[\w.-]*\w)", text)
        # Of studies.
        fields = re.findall(rf'"({groups}\.[\w.]+)"', text)
        named = {*options, *(name.replace("_", "-") for name in fields)}
        assert named <= known, (page.name, named - known)


YOUR_ROBOT = (DEPLOY.parent / "your-robot.md").read_text()


def test_the_tutorial_of_your_robot_quotes_an_error(tmp_path, monkeypatch):
    (toml,) = re.findall(r"```toml .*\n([^`]*)```", YOUR_ROBOT)
    write_robot(tmp_path / "walker", toml.replace('"*_foot"]', '"left_fot"]', 1))
    monkeypatch.chdir(tmp_path)
    error = r"walker/robot\.toml:3: no link 'left_fot', did you mean 'left_foot'\?"
    assert re.search(error, YOUR_ROBOT)
    assert re.search(error, call("robot", "check", "walker").stderr)


def test_the_tutorial_names_options_that_there_are():
    options = re.findall(
        r"--(task\.randomization[\w.-]+) ([\d.]+) ([\d.]+)", YOUR_ROBOT
    )
    assert len(options) == 6
    args = [text for name, *pair in options for text in (f"--{name}", *pair)]
    found = parse_config(args).env.task.randomization
    assert found == RandomizationConfig(
        link_mass=(0.8, 1.2),
        friction=(0.4, 1.0),
        gains=(0.8, 1.2),
        torque_limit=(0.6, 1.0),
        delay_steps=(0, 2),
        push_speed=(0.3, 0.6),
    )
