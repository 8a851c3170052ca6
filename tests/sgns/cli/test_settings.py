"""Settings that try to run something, or to open a file for writing, are refused in one line."""

from __future__ import annotations

import importlib
import subprocess
from pathlib import Path

import joblib
import pytest
from hydra.core.plugins import Plugins

from sgns_testing.commands import call, refused

CALL = "{_target_: joblib.load, filename: hostile.pickle}"
MADE = "${oc.create:'{_target_: joblib.load, filename: hostile.pickle}'}"
HANDLER = "hydra: {job_logging: {handlers: {x: {%s}}, root: {handlers: [x]}}}"
FILES = {
    "callback": f"hydra: {{callbacks: {{x: {CALL}}}}}",
    "callback made by a resolver": f'hydra: {{callbacks: {{x: "{MADE}"}}}}',
    "callbacks made by a resolver": "hydra: {callbacks: \"${oc.create:'{x: {_target_: joblib.load}}'}\"}",
    "callback elsewhere": 'hydra: {callbacks: {x: "${scene.name}"}}',
    "launcher": f"hydra: {{launcher: {CALL}}}",
    "launcher made by a resolver": f'hydra: {{launcher: "{MADE}"}}',
    "launcher of a plugin that is not there": "hydra: {launcher: {_target_: hydra_plugins.a.B}}",
    "sweeper with more": f"hydra: {{sweeper: {{+x: {CALL}}}}}",
    "sweeper's values made by a resolver": f'hydra: {{sweeper: {{params: "{MADE}"}}}}',
    "sweeper's value made by a resolver": f'hydra: {{sweeper: {{params: {{seed: "{MADE}"}}}}}}',
    "arguments": "hydra: {sweeper: {_args_: [1]}}",
    "partial": "hydra: {sweeper: {_partial_: true}}",
    "recursive": "hydra: {sweeper: {_recursive_: false}}",
    "all of hydra": 'hydra: "${scene}"',
    "log file": HANDLER % "class: logging.FileHandler, mode: w, filename: precious",
    "log file of logging.handlers": HANDLER
    % "class: logging.handlers.RotatingFileHandler, filename: precious",
    "log file by interpolation": HANDLER % "class: '${oc.decode:logging.FileHandler}', filename: precious",
    "handler from a factory": HANDLER % "(): logging.FileHandler, filename: precious, mode: w",
    "external object": HANDLER % "class: logging.StreamHandler, stream: 'ext://hostile_module.x'",
    "configured object": HANDLER % "class: logging.StreamHandler, stream: 'cfg://root'",
    "attributes": HANDLER % "class: logging.StreamHandler, .: {stream: x}",
    "formatter": "hydra: {job_logging: {formatters: {line: {(): joblib.load, filename: hostile.pickle}}}}",
    "formatter's class": "hydra: {job_logging: {formatters: {line: {class: hostile_module.x}}}}",
    "filter": "hydra: {job_logging: {filters: {x: {(): joblib.load, filename: hostile.pickle}}}}",
    "logging made by a resolver": f'hydra: {{job_logging: {{handlers: "{MADE}"}}}}',
    "all of the logging": 'hydra: {hydra_logging: "${scene}"}',
    "another logging": "defaults: [override /hydra/job_logging: default]",
    "hydra's logging": "defaults: [override /hydra/hydra_logging: hydra_debug]",
    "environment": "hydra: {job: {env_set: {LD_PRELOAD: ./x.so, PYTHONPATH: .}}}",
    "copied environment": "hydra: {job: {env_copy: [PATH]}}",
    "record over another folder": "hydra: {output_subdir: ..}",
    "record in a folder": "hydra: {output_subdir: conf}",
    "packages": "hydra: {searchpath: ['pkg://hostile_module']}",
    "packages in a sweep": (
        "hydra: {mode: MULTIRUN, sweeper: {params: {hydra.searchpath: '[pkg://hostile_module]'}}}"
    ),
    "logging in a sweep": (
        "hydra: {mode: MULTIRUN, sweeper: {params: {hydra/job_logging: default, seed: '1,2'}}}"
    ),
    "task": f"scene: {{x: [{CALL}]}}",
}
OVERRIDES = [
    f"+hydra.callbacks.x={CALL}",
    "+hydra.callbacks.x=${oc.create:${oc.env:HOSTILE}}",
    "hydra.launcher={_target_: joblib.load, filename: hostile.pickle}",
    "+hydra.launcher._args_=[1]",
    "hydra/job_logging=default",
    "++hydra.job_logging.handlers.console={class: logging.FileHandler, filename: precious, mode: w}",
    "++hydra.hydra_logging.formatters.line.()=joblib.load",
    "+hydra.job.env_set.LD_PRELOAD=x.so",
    "hydra.searchpath=[pkg://hostile_module]",
    "hydra.output_subdir=..",
    "hydra.output_subdir=a/b",
    "hydra.output_subdir=.",
]


@pytest.fixture
def hostile(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a module and a pickle that leave a canary, and a file that may not be emptied."""
    (empty_folder / "precious").write_text("precious")
    (empty_folder / "hostile_module.py").write_text("open('canary', 'w')")
    (empty_folder / "conf" / "experiment").mkdir(parents=True)
    joblib.dump(Touch(), "hostile.pickle")
    monkeypatch.syspath_prepend(empty_folder)
    monkeypatch.setenv("HOSTILE", CALL)
    monkeypatch.setattr("sgns.simulate.command.main", lambda cfg: Path("canary").touch())
    return empty_folder


class Touch:
    """Leaves the canary when it is unpickled."""

    def __reduce__(self):
        return (Path.touch, (Path("canary"),))


def refuse(*arguments: str) -> None:
    """`sgns simulate` refuses in one line, and nothing is made, run or emptied."""
    refused("simulate", *arguments)
    assert not Path("canary").exists() and Path("precious").read_text() == "precious"


def with_file(text: str) -> tuple[str, ...]:
    """Arguments for a file of settings."""
    Path("conf/experiment/x.yaml").write_text(f"# @package _global_\n{text}\n")
    return ("--config-dir", "conf", "experiment=x")


@pytest.mark.parametrize("name", FILES)
def test_files_of_settings_run_nothing(name, hostile) -> None:
    refuse(*with_file(FILES[name]))


DOUBLED = "\n".join(f"b{i}: &b{i} [{', '.join([f'*b{i - 1}'] * 9)}]" for i in range(1, 15))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("scene: &s {a: *s}", "x.yaml is no file of settings: alias s has no value yet"),
        (f"b0: &b0 [x]\n{DOUBLED}", "x.yaml is no file of settings: it stands for more than"),
        ("- 1", "x.yaml is no file of settings: it holds no keys with values"),
        ("a text", "x.yaml is no file of settings: it holds no keys with values"),
        ("nosuch: 1", "nosuch: no such key; keys of sgns simulate: continue_from, dataset,"),
    ],
    ids=["of itself", "multiplies", "list", "text", "unknown key"],
)
def test_files_that_are_no_settings(text, words, hostile) -> None:
    assert words in refused("simulate", *with_file(text))


@pytest.mark.parametrize("name", ["callback made by a resolver", "log file", "environment", "launcher"])
def test_files_of_settings_run_nothing_in_a_sweep(name, hostile) -> None:
    refuse(*with_file(FILES[name]), "-m", "seed=1,2")


@pytest.mark.parametrize("override", OVERRIDES)
def test_overrides_run_nothing(override, hostile) -> None:
    refuse(override)


LAUNCHER = """
import dataclasses, pathlib, typing
from hydra.core.config_store import ConfigStore
from hydra._internal.core_plugins.basic_launcher import BasicLauncher


class Slurm(BasicLauncher):
    def __init__(self, setup, partition, name, nodes):
        super().__init__()
        pathlib.Path("launched").write_text(repr((setup, partition, nodes)))


@dataclasses.dataclass
class Conf:
    _target_: str = "hydra_plugins.elsewhere.Slurm"
    setup: typing.Optional[typing.List[str]] = None
    partition: typing.Optional[str] = None
    name: str = "${hydra.job.name}"
    nodes: int = 1


ConfigStore.instance().store(group="hydra/launcher", name="elsewhere", node=Conf, provider="elsewhere")
"""


def test_commands_of_a_launcher_are_taken_from_the_command_line_only(hostile, monkeypatch) -> None:
    plugin = hostile.parent / "path" / "hydra_plugins" / "elsewhere"
    plugin.mkdir(parents=True)
    (plugin / "__init__.py").write_text(LAUNCHER)
    monkeypatch.syspath_prepend(plugin.parents[1])
    Plugins.instance().register(importlib.import_module("hydra_plugins.elsewhere").Slurm)
    monkeypatch.setattr("sgns.simulate.command.main", lambda cfg: None)

    def launch(text: str, *overrides: str) -> subprocess.CompletedProcess[str]:
        head = "defaults: [override /hydra/launcher: elsewhere]\nhydra: {launcher: {%s}}"
        return call("simulate", "-m", "seed=1", *with_file(head % text), *overrides)

    for text in ("setup: [touch canary]", 'partition: "a\\ntouch canary"'):
        done = launch(text)
        assert done.returncode == 2 and "files of settings cannot set this" in done.stderr, done.stderr
    done = launch("nodes: 2", 'hydra.job.name="a\\ntouch canary"'.replace("\\n", "\n"))
    assert done.returncode == 2 and "hydra.launcher.name" in done.stderr, done.stderr
    assert not Path("launched").exists()
    done = launch("nodes: 2, partition: gpu-long", "output=x.h5", "hydra.launcher.setup=[module load x]")
    assert done.returncode == 0, done.stderr
    assert Path("launched").read_text() == "(['module load x'], 'gpu-long', 2)"


@pytest.mark.parametrize(
    ("arguments", "seeds"),
    [
        (["hydra.verbose=true"], [0]),
        (["hydra.verbose=[sgns]"], [0]),
        (["hydra.run.dir=here"], [0]),
        (["hydra.output_subdir=record", "hydra.run.dir=here"], [0]),
        (["-m", "seed=1,2", "hydra.sweep.dir=here", "hydra.sweeper.max_batch_size=1"], [1, 2]),
        (["-m", "seed=1,2", "hydra/job_logging=disabled", "hydra/hydra_logging=none"], [1, 2]),
        (["--config-dir", "conf", "experiment=good"], [3]),
        (["-m", "--config-dir", "conf", "experiment=good,sweep"], [3, 4]),
        (["--config-dir", "conf", "experiment=sweep"], [4, 5]),
    ],
    ids=str,
)
def test_what_stays_allowed(arguments, seeds, hostile, monkeypatch) -> None:
    shared = "model: {history: 3}"  # for sgns train
    Path("conf/experiment/good.yaml").write_text(f"# @package _global_\nseed: 3\n{shared}\n")
    sweep = "hydra: {mode: MULTIRUN, sweeper: {params: {seed: '4,5'}}}"
    Path("conf/experiment/sweep.yaml").write_text(f"# @package _global_\nseed: 4\n{sweep}\n")
    found = []
    monkeypatch.setattr("sgns.simulate.command.main", lambda cfg: found.append(cfg.seed))
    done = call("simulate", "output=x.h5", *arguments)
    assert done.returncode == 0, done.stderr
    assert found == seeds


@pytest.mark.parametrize("kind", ["job", "hydra", "all"])
@pytest.mark.parametrize("resolve", [[], ["--resolve"]])
def test_settings_are_shown(kind, resolve, hostile) -> None:
    done = call("train", "--cfg", kind, *resolve)
    assert done.returncode == 0, done.stderr
    said = done.stdout
    assert ("num_modes:" in said) == (kind != "hydra") and ("hydra:" in said) == (kind != "job")
    assert ("${" in said) == (not resolve)
