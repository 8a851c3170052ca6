"""The command line as a person meets it: child processes in an empty folder."""

from __future__ import annotations

import importlib
import re
import signal
import subprocess
import sys
import sysconfig
import time
import types
from pathlib import Path

import numpy as np
import pytest

import sgns.command_settings as typed
from mpm_warp import Excavation, MeshBody, Other
from mpm_warp.settings import described
from sgns import Run, __version__
from sgns.cli.commands import COMMANDS
from sgns.cli.help import _found, groups_of, options_of
from sgns.cli.settings import sweep_jobs
from sgns.config import UserError
from sgns_testing.commands import SHORT, call, composed, python, refusal
from sgns_testing.commands import sgns as run_sgns
from sgns_testing.meshes import box_corners, box_triangles, write_stl
from sgns_testing.runs import make_run, make_writer, random_frame


def call_process(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `sgns` with the arguments, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "sgns", *arguments], capture_output=True, text=True, timeout=100
    )


def call_fake(body: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `sgns train` with a module in place of the training's that only holds this body of `main(cfg)`."""
    module = types.ModuleType(COMMANDS["train"].module)
    exec(f"def main(cfg):\n    {body}", module.__dict__ | {"UserError": UserError}, module.__dict__)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, module.__name__, module)
        return call("train", *arguments)


def assert_one_line(result: subprocess.CompletedProcess[str], *parts: str) -> None:
    """Bad input: status 2 and one line on stderr with all the parts."""
    assert result.returncode == 2, result.stderr
    assert result.stderr.count("\n") == 1 and result.stderr.endswith("\n"), result.stderr
    assert "Traceback" not in result.stderr
    for part in parts:
        assert part in result.stderr


def test_the_console_script_runs_in_an_empty_folder(empty_folder: Path) -> None:
    script = Path(sysconfig.get_path("scripts")) / "sgns"
    if not script.exists():
        pytest.skip("the package is not installed in this environment")
    result = subprocess.run([script, "--version"], capture_output=True, text=True, timeout=100)
    assert (result.returncode, result.stdout) == (0, f"sgns {__version__}\n")
    assert not list(empty_folder.iterdir())


def test_help_lists_every_command_quickly() -> None:
    start = time.perf_counter()
    result = call_process("--help")
    assert time.perf_counter() - start < 5  # no torch, no warp: a fraction of a second on an idle machine
    assert result.returncode == 0 and call_process().stdout == call_process("help").stdout == result.stdout
    assert call_process("help", "check").stdout == call_process("check", "--help").stdout != result.stdout
    for name, command in COMMANDS.items():
        assert f"  {name} " in result.stdout and command.summary in result.stdout


def test_only_the_libraries_that_are_needed_are_loaded() -> None:
    code = (
        "import sys, sgns.cli; sys.argv = ['sgns', '--help']; sgns.cli.main(); print(sorted(sys.modules))\n"
    )
    code += "import sgns.simulator, sgns.evaluate.command; print(sorted(sys.modules))"
    *_, shown, loaded = python(code).stdout.splitlines()
    assert "'sgns.cli'" in shown
    for name in ("torch", "warp", "lightning", "hydra", "h5py", "numpy"):
        assert f"'{name}'" not in shown
    assert "'torch'" in loaded
    for name in ("torch_geometric", "lightning"):  # of networks and their training
        assert f"'{name}'" not in loaded


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command(command: str, empty_folder: Path) -> None:
    result = call(command, "--help")
    assert result.returncode == 0
    assert result.stdout.startswith(f"sgns {command}: ")
    assert "Examples:" in result.stdout and "$" not in result.stdout
    if command != "check":  # takes paths
        own = typed.COMMANDS[command]
        keys = [name for name, *_ in described(own) if name not in ("error", "limits", "names")]
        assert all(re.search(rf"^  {name} +\S", result.stdout, re.M) for name in keys)
    for group, default in groups_of(command).items():
        if options_of(group):
            assert f"  {group} " in result.stdout
        if default is not None:
            assert (f"{default} (default)" in result.stdout) == (command != "rollout")
    assert not list(empty_folder.iterdir())


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_of_every_group_composes(command: str) -> None:
    for group in groups_of(command):
        for option in options_of(group):
            found = composed(f"{group}={option}", command=command)[group]
            assert found is not None or group == "experiment"


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["foo"], ["unknown command 'foo'", *COMMANDS]),
        (["-m", "train"], ["unknown command '-m'"]),
        (["train", "foo=1"], ["foo: no such key", "keys: checkpoint, dataset, device"]),
        (["train", "reduction.num_mode=3"], ["did you mean reduction.num_modes"]),
        (["train", "num_modes=3"], ["did you mean reduction.num_modes"]),
        (["simulate", "material.phi=30"], ["did you mean material.friction_angle"]),
        (["simulate", "scene.rakee=30"], ["did you mean scene.rake? keys of"]),
        (
            ["simulate", "scene.tool.file=a.obj"],
            [
                "scene.tool: no such key; the excavation scene has a plate",
                "scene=body scene/tool=mesh scene.tool.file=",
            ],
        ),
        (
            ["simulate", "scene=body", "scene.tool.file=a.obj"],
            ["scene.tool.file: no such key; scene.tool has the keys friction", "scene/tool=mesh"],
        ),
        (
            ["simulate", "dataset=quick", "scene.depth=0.05"],
            [
                "scene.depth has no effect: dataset=quick draws it (4 values)",
                "'dataset.draw={depth: [...], ...}'",
            ],
        ),
        (
            ["simulate", "dataset=quick", "dataset.draw.depth=[0.02,0.05]"],
            ["a list of grids", "'dataset.draw={depth: [0.02,0.05], ...}'"],
        ),
        (["train", "dataset=nope"], ["dataset=nope", "allowed:", "quick"]),
        (["train", "scene=excavation"], ["no group 'scene'"]),
        (["train", "reduction"], ["cannot read 'reduction'", "key=value"]),
        (["train", "seed=[1"], ["cannot read 'seed=[1'", "quotes"]),
        (["train", "seed=1,2"], ["add -m for a sweep"]),
        (["train", "seed=${nope}"], ["Interpolation key 'nope' not found"]),
        (["train", "~nope"], ["Could not delete"]),
        (["train", "--nope"], ["unrecognized arguments: --nope"]),
        (["train", "--cfg", "nope"], ["invalid choice: 'nope'", "job"]),
        (["train", "--cfg", "job", "-m"], ["only one of"]),
        (["train", "--config-name", "simulate"], ["--config-dir"]),
        (["train", "--config-dir", "nope"], ["nope' not found"]),
        (["train", "--config-path", "."], ["unrecognized arguments: --config-path"]),
        (["train", "--experimental-rerun", "a.pickle"], ["unrecognized arguments: --experimental-rerun"]),
        (["train", "--exp", "a.pickle"], ["unrecognized arguments: --exp"]),
        (["train", "-sc", "install=bash"], ["unrecognized arguments: -sc"]),
        (["train", "--hydra-help"], ["unrecognized arguments: --hydra-help"]),
        (["train", "--cfg", "job", "--package", "nope"], ["--package nope: no such key"]),
        (["train", "--package", "seed"], ["go with --cfg job"]),
        (["train", "output=größe"], ["'ö' needs quotes, as in 'output=\"größe\"'"]),
        (["train", "output=a~b"], ["'~' needs quotes, as in 'output=\"a~b\"'"]),
        (["train", "output=[a&b]"], ["'&' needs quotes, as in 'output=[\"&\"]'"]),
        (["simulate", "-m", "seed=range(0,1e12)"], ["has 1e+12 jobs; at most 10000"]),
        (["simulate", "-m", "seed=range(0,200)", "scene.depth=range(0,0.1,0.001)"], ["has 2e+04 jobs"]),
        (["simulate", "-m", "scene.speed=range(0,1,1e-300)"], ["has 1e+300 jobs"]),
        (["simulate", "-m", "seed=range(0,10,0)"], ["seed=range(0,10,0): a range needs"]),
        (["simulate", "-m", "seed=range(nan,3)"], ["a range needs numbers"]),
        (["simulate", "-m", "seed=1,2", "hydra.sweep.dir=/proc/x"], ["/proc/x: ", "choose another output"]),
        (["rollout"], ["missing for checkpoint", "checkpoint=..."]),
        (["rollout", "checkpoint=null"], ["checkpoint is null"]),
        (["rollout", "checkpoint=best.ckpt", "scene=quick_excavation"], ["no checkpoint at best.ckpt"]),
        (
            ["rollout", "checkpoint=a.ckpt", "scene=wheel", "solver.precision=float64"],
            ["solver: no such key"],
        ),
        (["rollout", "checkpoint=a.ckpt", "scene.slip=0.3"], ["no checkpoint at a.ckpt"]),
        (["rollout", "-m", "checkpoint=a.ckpt,b.ckpt", "scene.slip=0.3"], ["no checkpoint at a.ckpt"]),
        (["evaluate", "checkpoint=a.ckpt", "dataset=null"], ["dataset is null; allowed: ", "quick"]),
        (["simulate", "experiment=x"], ["experiment=x: --config-dir is missing"]),
        (["evaluate", "checkpoint=a.ckpt", "~dataset"], ["dataset is missing", "allowed:", "quick"]),
        (["evaluate", "checkpoint=a.ckpt", "dataset.path=nope"], ["no checkpoint at a.ckpt"]),
        (["simulate", "dataset=published"], ["dataset=published has no scene: its runs come from elsewhere"]),
        (["simulate", "shards=4"], ["give dataset=..."]),
        (["simulate", "effects.gravity=true"], ["effects.gravity: no such key"]),
        (["simulate", "scene.depth=0.5"], ["leaves the bin"]),
        (
            ["simulate", "scene.courant=1e-3", "material.youngs_modulus=1e12"],
            ["lower material.youngs_modulus"],
        ),
        (["simulate", "scene.path=nowhere.csv"], ["scene.path"]),
        (["simulate", "scene=body"], ["scene.path=..."]),
        (["simulate", "scene=body", "scene/tool=mesh"], ["scene.tool.file=..."]),
        (["simulate", "scene=body", "scene/tool=cone"], ["scene/tool=cone: no such option"]),
        (
            ["simulate", "-m", "scene=excavation,wheel", "scene.load=80"],
            ["the job with scene=excavation: scene.load: no such key", "make sweeps of their own"],
        ),
        (["train", "dataset=data/mine"], ["dataset=data/mine: no such option; a ", "dataset.path=data/mine"]),
        (["train", "dataset=.."], ["dataset=..: no such option", "dataset.path=.."]),
        (
            ["simulate", "scene=./my.yaml"],
            ["scene=./my.yaml: ", "FOLDER/scene/my.yaml", "--config-dir FOLDER"],
        ),
        (
            ["simulate", "scene=wheel", "scene.tool.file=a.obj"],
            ["a mesh, whose height the path prescribes: "],
        ),
        (["simulate", "scene=paths/a.csv"], ["a path is scene.path=paths/a.csv"]),
        (
            ["simulate", "scene=body", "scene/tool=a/b.stl"],
            ["scene=body scene/tool=mesh scene.tool.file=a/b.stl"],
        ),
        (
            ["simulate", "scene=wheel", "scene.grousers=3"],
            ["scene.grouser_height is 0.0; it must be above 0 m"],
        ),
        (["check"], ["missing for files", "sgns check run.h5"]),
        (["check", "nope.h5"], ["nope.h5: no such file"]),
    ],
    ids=" ".join,
)
def test_bad_input_gives_one_line_and_leaves_nothing(
    arguments: list[str], parts: list[str], empty_folder: Path
) -> None:
    assert_one_line(call(*arguments), *parts)
    assert not list(empty_folder.iterdir())


@pytest.mark.parametrize(
    ("rows", "part"),
    [
        ("1,0.2,nan,0.15,0,0,0,1", "not finite in line 3 of path.csv, column 3"),
        ("1,0.2,0.3", "line 3 of path.csv is '1,0.2,0.3': 3 values instead of 8"),
        ("1,left,0.3,0.15,0,0,0,1", "'left' is not a number"),
    ],
)
def test_a_bad_blade_path_gives_one_line_and_leaves_nothing(rows: str, part: str, empty_folder: Path) -> None:
    Path("path.csv").write_text(f"t,x,y,z,qx,qy,qz,qw\n0,0.15,0.3,0.1925,0,0,0,1\n{rows}\n")
    path_keys = ["scene=quick_excavation", "scene.motion=path", "scene.path=path.csv"]
    assert_one_line(call("simulate", *path_keys, "output=new.h5"), part)
    assert [found.name for found in empty_folder.iterdir()] == ["path.csv"]


def test_a_command_says_what_is_wrong(empty_folder: Path) -> None:
    result = call_fake("raise UserError('x.h5: not an HDF5 file;\\nwrite it again')")
    assert_one_line(result, "sgns train: x.h5: not an HDF5 file; write it again\n")
    assert not list(empty_folder.iterdir())


def test_the_solver_says_what_is_wrong(empty_folder: Path) -> None:
    assert_one_line(call_fake("import mpm_warp; raise mpm_warp.SolverStopped('too fast')"), "too fast")


def test_a_job_of_a_sweep_says_what_is_wrong(empty_folder: Path) -> None:
    result = call_fake("if cfg.seed == 2: raise UserError('bad')", "-m", "seed=1,2,3", "output=sweep")
    assert_one_line(result, "sgns train: job 1 (seed=2): bad\n")
    assert {path.name for path in Path("sweep").iterdir()} == {"multirun.yaml", "0"}


def test_all_jobs_of_a_sweep_are_looked_at_before_the_first(empty_folder: Path) -> None:
    for words, job in (
        (["scene.depth=0.04,9", "scene.duration=0.02"], "job 1 (scene.depth=9): the plate leaves the bin"),
        (["scene=wheel", "scene.slip=0,5,0.6"], "job 1 (scene.slip=5): scene.slip is 5"),
        (["seed=1,-1"], "job 1 (seed=-1): seed is -1"),
    ):
        done = call("simulate", "-m", *words)
        assert_one_line(done, job, "; no job has begun")
        assert not list(empty_folder.iterdir())


def test_a_sweeps_lines_name_what_differs_between_its_jobs(empty_folder: Path) -> None:
    done = call_fake("return 0.5", "-m", "seed=1,2", "device=cpu", "output=sweep")
    assert "#1 : seed=2\n" in done.stdout
    assert [job for job in sweep_jobs(["a=1,2", "b={c: 3}", "d=range(0,2)"])] == [
        [f"a={a}", "b={c:3}", f"d={d}"] for a in (1, 2) for d in (0, 1)
    ]


def test_an_interrupted_sweep_of_files_says_what_stays(empty_folder: Path, monkeypatch) -> None:
    def stop(cfg: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module(COMMANDS["simulate"].module), "main", stop)
    done = call("simulate", "-m", "seed=1,2", "scene.duration=0.02")
    assert done.returncode == 130
    assert re.search(
        r"job 0 \(seed=1\): interrupted; nothing new is kept; finished jobs stay in multirun/simulate/[^;]*; the same "
        "sweep would begin anew in another folder",
        done.stderr,
    )


def test_a_sweep_ends_with_a_table(empty_folder: Path) -> None:
    body = """import json; from pathlib import Path
    found = {"position_rmse": 0.002 * cfg.seed, "force_nrmse": 0.3, "seconds": 4.0}
    Path(cfg.output, "training.json").write_text(json.dumps(found))
    return 0.5"""
    result = call_fake(body, "-m", "seed=1,2", "device=cpu", "output=sweep")
    assert result.returncode == 0, result.stderr
    names = ["seed", "soil_error_mm", "force_nrmse", "training_s", "output", "skill"]
    rows = [[str(n), str(2.0 * n), "0.3", "4.0", f"sweep/{n - 1}/best.ckpt", "0.5"] for n in (1, 2)]
    assert [row.split(",") for row in Path("sweep/sweep.csv").read_text().splitlines()] == [names, *rows]
    *_, head, one, two, last = (line.split() for line in result.stdout.splitlines())
    assert head == names and last[-1] == "sweep/sweep.csv"
    assert [one, two] == [[c.removesuffix(".0") for c in row] for row in rows]


def test_the_table_of_a_sweep_of_runs_has_their_forces(empty_folder: Path, monkeypatch) -> None:
    def main(cfg) -> float:
        if cfg.seed < 3:
            make_run(cfg.output, seed=cfg.seed)
        return 4.0

    monkeypatch.setattr(importlib.import_module(COMMANDS["simulate"].module), "main", main)
    done = call("simulate", "-m", "seed=1,2,3", "scene.duration=0.2", "hydra.sweep.dir=swept")
    assert done.returncode == 0, done.stderr
    names, *rows = (row.split(",") for row in Path("swept/sweep.csv").read_text().splitlines())
    assert names == ["seed", "mean_draft_N", "mean_vertical_force_N", "output", "wall_s_per_simulated_s"]
    for row in rows[:2]:
        with Run(row[3]) as run:
            x, _, z = run.force[1:].mean(axis=0)
        assert [float(cell) for cell in row[1:3]] == pytest.approx([-x, z], rel=1e-6)
    assert rows[2][:3] == ["3", "", ""]
    assert done.stdout.splitlines()[-5].split() == names


def test_the_table_has_the_forces_of_a_run_with_a_further_mesh(tmp_path: Path) -> None:
    file = write_stl(tmp_path / "box.stl", box_corners((0.1, 0.1, 0.1)), box_triangles())
    stone = Other(tool=MeshBody(file=str(file)), position=(0.4, 0.3, 0.3))
    scene, frames = Excavation(others=(stone,)), [random_frame(number) for number in range(2)]
    further = np.eye(7)[None, 6], np.zeros((1, 3)), np.zeros((1, 3))
    with make_writer(tmp_path / "a.h5", scene=scene.to_dict(), meshes=scene.meshes) as writer:
        for frame in frames:
            writer.append(**frame, more=further)
        writer.finish(1.0)
    assert _found(str(tmp_path / "a.h5"))["mean_draft_N"] == pytest.approx(-frames[1]["force"][0])


def test_wrong_key_in_a_sweep(empty_folder: Path) -> None:
    assert_one_line(
        call("train", "-m", "reduction.num_mode=1,2", "output=x"), "did you mean reduction.num_modes"
    )


def test_a_sweep_over_groups_takes_the_keys_of_their_options(empty_folder: Path) -> None:
    for words in (
        ["dataset=quick,quick_wheel", "dataset.runs=4"],
        ["scene=wheel,quick_wheel", "scene.load=80"],
    ):
        done = call("simulate", "-m", *words, "limits.disk=1e-9")
        assert "limits.disk is 1e-09 GB" in done.stderr, done.stderr


@pytest.mark.parametrize(
    ("name", "draw", "keys"),
    [
        ("quick", "draw={depth: [0.04, 0.06, 0.08]}", "depth"),
        ("quick_wheel", "draw=[{slip: [0.2, 0.3]}, {load: [60, 80]}]", "slip,load"),
        ("quick_wheel", "draw={slip: [0.2, 0.3, 0.4]}", "slip"),
        ("quick_wheel", "draw.slip=[0.2, 0.3]", "gravity,slip,load,friction_angle"),
    ],
)
def test_given_grids_take_the_place_of_the_datasets(
    name: str, draw: str, keys: str, empty_folder: Path
) -> None:
    where = [f"dataset={name}", "dataset.path=here", "dataset.runs=null"]
    done = call("simulate", *where, f"dataset.{draw}", "limits.disk=1e-9")
    assert "limits.disk is 1e-09 GB" in done.stderr, done.stderr
    assert Path("here", "runs.csv").read_text().startswith(f"run,split,{keys}\n")


def test_drawing_in_a_sweep(empty_folder: Path) -> None:
    sweep = ["dataset=quick,quick_wheel", "dataset.draw={slip: [0.2]}", "limits.disk=1e-9"]
    done = call("simulate", "-m", *sweep)
    assert_one_line(done, "job 0 (dataset=quick): ", "draw gives 1 runs")


def test_a_bug_keeps_its_traceback(empty_folder: Path) -> None:
    with pytest.raises(AttributeError, match="no_such_setting"):  # looks like an error in the settings
        call_fake("cfg.no_such_setting")
    code = "import sys, sgns.data.check, sgns.cli; del sgns.data.check.main; sys.exit(sgns.cli.main())"
    result = python(code, "check", "a.h5")
    assert result.returncode == 1 and "Traceback" in result.stderr


def test_an_output_that_cannot_be_written(empty_folder: Path) -> None:
    Path("taken").touch()
    assert_one_line(call_fake("pass", "output=taken"), "taken: File exists")


@pytest.mark.parametrize(
    ("arguments", "folders"),
    [
        ([], ["outputs/train/"]),
        (["output=here/now"], ["here/now"]),
        (["-m", "seed=1,2"], ["outputs/train/", "outputs/train/"]),
        (["-m", "seed=1,2", "output=here"], ["here/0", "here/1"]),
    ],
    ids=["default", "given", "sweep", "sweep given"],
)
def test_output_is_the_run_folder(arguments: list[str], folders: list[str], empty_folder: Path) -> None:
    result = call_fake("print('output:', cfg.output); return 1.0", *arguments)
    assert result.returncode == 0, result.stderr
    found = [line.split()[1] for line in result.stdout.splitlines() if line.startswith("output: ")]
    assert len(found) == len(set(found)) == len(folders)
    for folder, start in zip(found, folders, strict=True):
        assert folder.startswith(start)
        assert [path.name for path in Path(folder).iterdir()] == [".hydra"]


def test_settings_before_and_after_flags(empty_folder: Path) -> None:
    result = call("train", "seed=3", "--cfg", "job", "device=cuda")
    assert result.returncode == 0, result.stderr
    assert "seed: 3" in result.stdout and "device: cuda" in result.stdout


def test_the_arguments_of_a_process_that_lightning_starts(empty_folder: Path) -> None:
    """It takes this one's arguments and adds settings of Hydra's."""
    result = call_fake("import sys; print(sys.argv[1:])", "seed=3")
    assert result.stdout == "['train', 'seed=3']\n"
    added = ['hydra.run.dir="a/b"', "hydra.job.name=train_ddp_process_1", "hydra.output_subdir=null"]
    child = call("train", "--cfg", "job", *added)
    assert child.returncode == 0 and "num_modes:" in child.stdout


@pytest.mark.parametrize(
    "name",
    ["run.h5", "a b.h5", "it's.h5", "a,b[1].h5", "x=1.h5", "${seed}.h5", 'say "hi".h5', "back\\slash.h5"],
)
def test_check_takes_plain_paths(name: str, empty_folder: Path) -> None:
    Path(name).touch()
    result = call("check", name)
    assert_one_line(result, "1 of 1 files checked is not good")
    assert result.stdout.startswith(name)


def test_log_lines(empty_folder: Path) -> None:
    body = "import logging as l; l.info('%d s', 3); l.warning('slow'); l.getLogger('h5py').info('no')"
    result = call_fake(body)
    assert (result.stdout, result.stderr) == ("3 s\nwarning: slow\n", "")


@pytest.mark.parametrize("sweep", [[], ["-m", "seed=1,2"]], ids=["alone", "in a sweep"])
@pytest.mark.parametrize("written", [True, False], ids=["something written", "nothing written"])
def test_an_interruption_says_how_to_go_on(written: bool, sweep: list[str], empty_folder: Path) -> None:
    write = "open(cfg.output + '/last.ckpt', 'w').close(); " if written else ""
    before = signal.signal(
        signal.SIGINT, signal.SIG_DFL
    )  # a shell's background job, such as a CI's, ignores it
    try:
        result = call_fake(f"{write}import signal; signal.raise_signal(signal.SIGINT)", *sweep, "output=here")
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.returncode == 130
    said = result.stderr
    assert said.count("\n") == 1 and said.startswith("sgns train: ") and "interrupted; " in said
    assert (
        said.endswith("with output=here\n")
        == written
        == (Path("here") / ("0" if sweep else "last.ckpt")).exists()
    )


@pytest.mark.parametrize("streams", ["2>&-", ">&-", "<&- >&- 2>&-", "2>&1 | true", "> /dev/full"])
def test_standard_streams_that_lead_nowhere(streams: str, empty_folder: Path) -> None:
    """Neither a traceback nor another exit status."""
    command = f"{sys.executable} -m sgns check nope.h5 {streams}; exit ${{PIPESTATUS[0]}}"
    result = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=100)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr and "Exception" not in result.stderr
    assert ("no such file" in result.stderr) == (streams in (">&-", "> /dev/full"))


def test_settings_that_nobody_reads(empty_folder: Path) -> None:
    command = f"{sys.executable} -m sgns train --cfg all | true; exit ${{PIPESTATUS[0]}}"
    result = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=100)
    assert (result.returncode, result.stderr) == (0, "")


def test_a_home_folder_in_quotes_is_the_home_folder(
    empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(empty_folder / "home"))
    shown = call("train", 'output="~/first"', "checkpoint='~/a.ckpt'", "--cfg", "job").stdout
    assert (
        f"output: {empty_folder}/home/first" in shown and f"checkpoint: {empty_folder}/home/a.ckpt" in shown
    )
    shown = call("evaluate", 'new_rollouts=["~/a.h5","b~.h5"]', "checkpoint=a.ckpt", "--cfg", "job").stdout
    assert f"- {empty_folder}/home/a.h5\n- b~.h5\n" in shown
    done = call("train", 'output="~/first"', "training.max_steps=-1")
    assert done.returncode == 2 and not (empty_folder / "~").exists()


def test_a_whole_number_may_have_an_exponent(tmp_path) -> None:
    assert run_sgns(tmp_path, "simulate", *SHORT, "seed=1e3", "output=run.h5").returncode == 0
    with Run(tmp_path / "run.h5") as run:
        assert run.seed == 1000


def test_a_value_that_refers_to_itself_is_named(tmp_path) -> None:
    line = refusal(tmp_path, "simulate", "scene.speed=${scene.speed}")
    assert line == "sgns simulate: scene.speed=${scene.speed}: this refers to itself; give a value\n"


def test_wrong_values_of_a_dataset_are_named(tmp_path) -> None:
    assert "format" in refusal(tmp_path, "train", "dataset.format=[[1, 2], [3]]")
    assert "dataset.draw.a is 1; it must be a list" in refusal(
        tmp_path, "evaluate", "checkpoint=x.ckpt", "dataset.draw={a: 1}"
    )
