"""The command `egoskin`: fast help, suggested names, and scripts that call it."""

from __future__ import annotations

import functools
import inspect
import os
import re
import resource
import runpy
import signal
import subprocess
import sys
from importlib import import_module
from importlib.metadata import EntryPoint

import pytest
from setuptools.config.pyprojecttoml import read_configuration

from calling import SCRIPTS, fail, succeed
from egoskin import __version__, commands
from egoskin.commands import COMMANDS
from egoskin.commands.pages import ARGUMENTS, PAGES, WITH_SUBCOMMANDS, page
from egoskin.commands.train import main as train

ROOT = SCRIPTS.parent
# Scripts that are not commands: development tools and examples.
OWN = {"fit_shell", "deploy_mujoco", "reuse_gymnasium", "reuse_recording"}
OWN |= {"reuse_urdf_arm", "train_sb3"}


@functools.cache
def described(*words: str) -> str:
    """Return the help of a command or subcommand."""
    return succeed(*words, "--help")


def egoskin(monkeypatch, *args: str) -> None:
    """Call the function that `[project.scripts]` names, as the command does."""
    project = read_configuration(ROOT / "pyproject.toml")["project"]
    name, group = "egoskin", "console_scripts"
    monkeypatch.setattr(sys, "argv", [name, *args])
    EntryPoint(name, project["scripts"][name], group).load()()


def test_help_comes_at_once_and_lists_the_commands():
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "egoskin", "--help"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    for name, text in COMMANDS.items():
        assert re.search(rf"^  {name} +{text}$", done.stdout, re.MULTILINE)
    assert not heavy(done.stderr)
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before < 1


@pytest.mark.parametrize("args", [("--help",), ("train", "--help")])
def test_help_that_nobody_reads_is_no_error(args: tuple[str, ...]):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "egoskin", *args]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, cwd=ROOT)
    os.close(writer)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, b"")


def heavy(import_times: str) -> set[str]:
    """Return the slow packages that a report of ``-X importtime`` lists."""
    imported = {line.split()[-1].split(".")[0] for line in import_times.splitlines()}
    assert "egoskin" in imported
    return imported & {"torch", "numpy", "mujoco", "torchrl", "tyro"}


@pytest.mark.parametrize(
    "command", [("-m", "egoskin", "train"), (str(SCRIPTS / "ppo.py"),)]
)
def test_the_first_page_of_a_command_comes_at_once(command):
    done = subprocess.run(
        [sys.executable, "-X", "importtime", *command, "--seed", "3", "--help"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    assert done.stdout == page("train") + "\n"
    assert not heavy(done.stderr)


def test_every_command_has_a_first_page(monkeypatch, capsys):
    assert list(PAGES) == list(COMMANDS)
    for name in COMMANDS:
        with pytest.raises(SystemExit) as ended:
            egoskin(monkeypatch, name, "-h")
        assert ended.value.code == 0
        assert capsys.readouterr().out == page(name) + "\n"


@pytest.mark.parametrize("name", [n for n in COMMANDS if n not in WITH_SUBCOMMANDS])
def test_the_first_page_says_what_the_options_are(name):
    """Names, choices and defaults are the same as in the parser."""
    usage, options = re.split(r"\boptions  *[-─ ]", described(name), maxsplit=1)
    assert usage.startswith(f"usage: egoskin {name} ")
    # Of the parser's usage: positionals, in brackets if optional; required options.
    parsed = " ".join(usage.split("\n\n")[0].split()[3:])
    parsed = re.sub(r"\[(-h|OPTIONS|--[^]]*)\] ?", "", parsed)
    own = ARGUMENTS.get(name, "")
    assert (own[:1] == "[", bool(own)) == (parsed[:1] == "[", bool(parsed)), parsed
    assert re.findall(r"--\S+", own) == re.findall(r"--\S+", parsed)
    whole = " ".join(options.replace("│", " ").split())
    first = re.split(r"\n  (?=--)", PAGES[name].split("\n\n  egoskin")[0])[1:]
    assert len(first) <= 10
    for text in first:
        option, choices = re.match(r"(\S+) ?(\{[\w,]+\})?", text).groups()
        told = re.search(rf" {option}[ ,](.*?)\((?:default: (.*?)|required)\)", whole)
        assert told, option
        assert (choices or "") in told[1].replace("{None}|", "").replace("None,", "")
        default = re.search(r"\((\S[^:()]*)\)$", text.strip())
        if default:
            assert default[1] == told[2]
        else:
            assert told[2] in ("None", "False", None)


def test_the_pages_of_commands_with_subcommands_name_them_all():
    for name in WITH_SUBCOMMANDS:
        usage, *_ = described(name).split("}")
        first, subcommands = usage.split("{")
        assert first.startswith(f"usage: egoskin {name} ")
        named = re.findall(rf"^  egoskin {name} (\S+)", PAGES[name], re.MULTILINE)
        assert named == subcommands.split(",")


@pytest.mark.parametrize("name", COMMANDS)
def test_the_examples_of_a_page_have_options_that_there_are(name):
    assert max(map(len, PAGES[name].splitlines())) <= 88
    # A backslash continues an example on the next line.
    pattern = rf"^  egoskin {name} (.*(?:(?<=\\)\n.*)*)"
    found = re.findall(pattern, PAGES[name], re.MULTILINE)
    assert found or name == "replay"
    for example in found:
        words = example.split(" > ")[0].split()
        subcommand = words[:1] if name in WITH_SUBCOMMANDS else []
        text = described(name, *subcommand)
        for option in filter(lambda word: word.startswith("--"), words):
            assert re.search(rf"{option}[ ,\n│]", text), example


@pytest.mark.parametrize("args", [(), ("-h",), ("--help",)])
def test_without_a_command_there_is_help(args, monkeypatch, capsys):
    egoskin(monkeypatch, *args)
    assert capsys.readouterr().out.startswith("usage: egoskin COMMAND")


def test_the_command_says_its_version(monkeypatch, capsys):
    egoskin(monkeypatch, "--version")
    assert capsys.readouterr().out == f"egoskin {__version__}\n"


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("evalute", "evaluate"),
        ("upperbound", "upper-bound"),
        ("--hepl", "--help"),
        # Names of scripts, and former names of commands.
        ("render", "film"),
        ("ppo", "train"),
        ("ceiling", "upper-bound"),
    ],
)
def test_a_mistyped_command_is_answered_with_the_nearest(
    name, nearest, monkeypatch, capsys
):
    with pytest.raises(SystemExit) as ended:
        egoskin(monkeypatch, name)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"no command {name!r}, did you mean {nearest!r}?" in line


def test_a_name_like_none_lists_all(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        egoskin(monkeypatch, "xyz")
    error = capsys.readouterr().err
    assert "did you mean" not in error
    assert ", ".join(COMMANDS) in error


@pytest.mark.parametrize(
    ("args", "nearest"),
    [
        (("study", "plna"), "'plan'"),
        (("skin", "improt"), "'import'"),
        (("bench", "lop"), "'loop'"),
        (("evaluate", "blind", "--epsiodes", "3"), "--episodes"),
        (("train", "--sensor.signl", "binary"), "--sensor.signal"),
    ],
)
def test_a_mistyped_subcommand_or_option_is_answered_with_the_nearest(args, nearest):
    assert nearest in fail(*args)


def test_a_command_runs_as_if_it_were_a_program(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(commands, "end_quietly", lambda: None)
    egoskin(monkeypatch, "skin", "place", "--num-sensors", "2", "--out", "a.json")
    assert "a.json: 2 sensors" in capsys.readouterr().out
    assert sys.argv[0] == "egoskin skin"


def test_a_script_is_a_command_or_has_a_reason():
    found = {}
    for path in SCRIPTS.glob("*.py"):
        text = path.read_text()
        body = re.fullmatch(
            r'"""[^"]+"""\n\nfrom __future__ import annotations\n\n'
            r"from egoskin.commands import run\n\n"
            r'if __name__ == "__main__":\n    run\("([\w-]+)"\)\n',
            text,
        )
        if body:
            found[path.stem] = body[1]
    assert set(found.values()) == set(COMMANDS) - {"train"}
    assert {path.stem for path in SCRIPTS.glob("*.py")} == {*found, "ppo", *OWN}
    for name in found.values():
        module = import_module(f"egoskin.commands.{name.replace('-', '_')}")
        assert callable(module.main)


def test_the_main_job_is_the_same_code_as_the_command():
    # The script is meant to be read and copied, so it contains the code itself.
    script = runpy.run_path(str(SCRIPTS / "ppo.py"))["main"]
    assert inspect.getsource(script) == inspect.getsource(train)


def test_too_little_memory_to_import_is_one_line():
    limit = 900_000_000
    done = subprocess.run(
        [sys.executable, "-m", "egoskin", "evaluate", "field_proximity"],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: too little memory")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "command", [("-m", "egoskin", "evaluate", "blind"), (str(SCRIPTS / "ppo.py"),)]
)
def test_an_opengl_that_is_not_installed_is_one_line_of_any_command(command):
    done = subprocess.run(
        [sys.executable, *command],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "MUJOCO_GL": "no_such_backend"},
    )
    assert done.returncode == 2
    assert "MUJOCO_GL='no_such_backend'" in done.stderr
    assert done.stderr.endswith(", or unset MUJOCO_GL\n")
    assert done.stderr.count("\n") == 1
