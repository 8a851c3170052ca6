"""The command line: `sgns <command> [key=value ...] [-m]`.

One Hydra application serves all commands: the command's name becomes `--config-name`, so that its settings
are `conf/<command>.yaml`. Exit status: 0 done; 2 bad input, said in one line; 130 interrupted; 1 a bug, with
its traceback.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import logging
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from sgns import __version__
from sgns.cli.help import open_closed_streams, write_error, write_output
from sgns.config import Interrupted, UserError, heeded_signals, own_overrides, shared_overrides

if TYPE_CHECKING:
    from omegaconf import DictConfig


class Command(NamedTuple):
    """One command.

    Attributes:
        module: whose `main(cfg)` does it, or the `function` named below.
        summary: a line of help.
        output: what its `output` is: "file", "folder", or None where it has none.
        needs: dotted keys of paths that it cannot do without.
        result: the file in a folder of output that shows that the work is finished. It is not replaced without
            `overwrite=true`. None where finished work is kept and gone on from; files of output are looked after by
            the command, once it knows that the other settings are good.
        plain: keys that may be given as plain paths, in this order.
        value: what that function returns, as a column of a sweep's table.
        function: of the module.
    """

    module: str
    summary: str
    output: str | None
    needs: tuple[str, ...] = ()
    result: str | None = None
    plain: tuple[str, ...] = ()
    value: str | None = None
    function: str = "main"


COMMANDS = {
    "simulate": Command(
        "sgns.simulate.command",
        "simulate a scene or a dataset with the material point method",
        "file",
        ("output",),
        value="wall_s_per_simulated_s",
    ),
    "reduce": Command(
        "sgns.reduction.command",
        "fit the basis (PCA) on a dataset and reduce its runs",
        "folder",
        ("dataset.path",),
        "energy.csv",
    ),
    "train": Command(
        "sgns.train.command", "learn a simulator from a dataset", "folder", ("dataset.path",), value="skill"
    ),
    "rollout": Command(
        "sgns.rollout",
        "let a trained network play a scene",
        "file",
        ("checkpoint", "output"),
        value="wall_s_per_simulated_s",
    ),
    "export": Command(
        "sgns.export",
        "write a trained network as ONNX or .pt2, for C++ and other programs",
        "file",
        ("checkpoint", "output"),
        value="s_per_step",
    ),
    "evaluate": Command(
        "sgns.evaluate.command",
        "compare a trained network with true runs; write the report",
        "folder",
        ("dataset.path", "checkpoint"),
        "report.html",
        value="skill",
    ),
    "frontier": Command(
        "sgns.frontier.command", "measure what accuracy costs in time; table, figures and page", "folder"
    ),
    "advise": Command(
        "sgns.advise", "name the setting that is good and fast enough", None, value="wall_s_per_step"
    ),
    "check": Command("sgns.data.check", "read run files through and list what is wrong with them", None),
    "import": Command(
        "sgns.simulate.foreign",
        "make run files of what another simulator has computed",
        "file",
        ("output",),
        plain=("source", "output"),
    ),
    "convert": Command(
        "sgns.convert",
        "write a run as a file of other programs",
        "file",
        ("run", "output"),
        plain=("run", "output"),
    ),
    "plot": Command("sgns.plot", "one picture of a run", "file", ("run",), plain=("run", "output")),
    "render": Command(
        "sgns.plot",
        "a moving picture of a run",
        "file",
        ("run",),
        plain=("run", "output"),
        function="render",
    ),
    "view": Command(
        "sgns.view.server",
        "see a run, or drive a tool through a network's soil, on a page in the browser",
        "file",
        plain=("run", "prediction"),
    ),
}


# What the system says when results cannot be written where they should go.
_UNWRITABLE = (
    errno.EACCES,
    errno.EEXIST,
    errno.EISDIR,
    errno.ENAMETOOLONG,
    errno.ENOTDIR,
    errno.EPERM,
    errno.EROFS,
)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_LONGEST = 1000  # characters of a line about an error; what a person wrote stands in it, and may be longer


class _Stopped(BaseException):
    """Ends the process with one line and a status.

    Not an `Exception`: Hydra would write a line of its own about those before it passes them on.
    """


class _Failed(NamedTuple):
    """What a job in another process returns that a person can repair."""

    line: str


def main() -> int:
    """Run the command named in `sys.argv`; returns the exit status."""
    open_closed_streams()
    with heeded_signals():
        status = _run(sys.argv[1:])
    try:
        write_output("")  # what is still in the stream's buffer
    except UserError as error:
        write_error(f"sgns: {error}")
        status = status or 2
    return status


def _run(arguments: list[str]) -> int:
    name = "sgns"
    try:
        if arguments[:1] == ["help"]:
            arguments = [*arguments[1:2], "--help"]
        if not arguments or arguments[0] in ("--help", "-h"):
            write_output(_help())
            return 0
        if arguments[0] == "--version":
            write_output(f"sgns {__version__}\n")
            return 0
        command, *rest = arguments
        if command not in COMMANDS:
            raise UserError(f"unknown command {command!r}; commands: {', '.join(COMMANDS)}; see sgns --help")
        name = f"sgns {command}"
        if "--help" in rest or "-h" in rest:
            from sgns.cli.help import command_help

            write_output(command_help(command))
            return 0
        _run_hydra(command, _parsed(command, rest))
        return 0
    except _Stopped as stop:
        line, status = stop.args
        write_error(f"{name}: {line}")
        return status
    except KeyboardInterrupt as stop:
        write_error(f"{name}: interrupted")
        return _status(stop)
    except Exception as error:
        if (line := _line_of(error)) is None:
            raise
        _show_traceback()
        write_error(f"{name}: {line}")
        return 2


def run_command(cfg: DictConfig) -> float | _Failed | None:
    """Hydra's task: run one job; its value is the command's main metric, for sweepers to optimise."""
    from hydra.core.hydra_config import HydraConfig

    from sgns.cli.settings import check_shared
    from sgns.data.files import require_new

    hydra_cfg = HydraConfig.get()
    name = hydra_cfg.job.config_name
    assert name is not None and hydra_cfg.mode is not None
    in_sweep = hydra_cfg.mode.name == "MULTIRUN"
    label = _label(hydra_cfg.job.num, hydra_cfg.overrides.task) if in_sweep else ""
    try:
        _place_output(cfg, hydra_cfg, COMMANDS[name], in_sweep)
        check_shared(cfg, name, COMMANDS[name].needs)
        if (result := COMMANDS[name].result) is not None:
            require_new(Path(cfg.output) / result, cfg.overwrite)
        return getattr(importlib.import_module(COMMANDS[name].module), COMMANDS[name].function)(cfg)
    except KeyboardInterrupt as stop:
        kept = _drop_empty_output(hydra_cfg)
        said = stop.said if isinstance(stop, Interrupted) else ""
        said = said or _interruption(cfg, name, kept, hydra_cfg.sweep.dir if in_sweep else cfg.output)
        if in_sweep and COMMANDS[name].output == "file" and cfg.get("dataset") is None:
            said += f"; finished jobs stay in {hydra_cfg.sweep.dir}; the same sweep would begin anew in another folder"
        raise _Stopped(f"{label}interrupted; {said}", _status(stop)) from None
    except Exception as error:
        if (line := _line_of(error)) is None:
            raise
        _drop_empty_output(hydra_cfg)
        _show_traceback()
        if not hydra_cfg.launcher._target_.endswith("BasicLauncher"):
            # This is another process; the first one says the line. Other sweepers look at errors themselves.
            if hydra_cfg.sweeper._target_.endswith("BasicSweeper"):
                return _Failed(line)
            raise
        raise _Stopped(label + line, 2) from None


def _run_hydra(command: str, arguments: argparse.Namespace) -> None:
    logging.raiseExceptions = False  # a line that a full disk does not take is no reason for a traceback
    # With this variable Hydra passes errors on as they are, in place of its own block of text and status 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    from hydra import initialize_config_module
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.plugins import Plugins
    from hydra.types import RunMode

    from sgns.cli.settings import CheckedLoader, ConfigDir, OwnFiles, require_few_jobs

    if arguments.config_dir is not None and not os.path.isdir(arguments.config_dir):
        raise UserError(f"--config-dir: folder '{arguments.config_dir}' not found")
    for plugin in (ConfigDir, OwnFiles):
        Plugins.instance().register(plugin)
    ConfigDir.folder = None if arguments.config_dir is None else os.path.abspath(arguments.config_dir)
    settings = arguments.settings
    with initialize_config_module("sgns.conf", job_name="sgns", version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        # Not `hydra.main`: it takes no loader, and has flags of its own that run what they find in a file.
        hydra.config_loader = CheckedLoader(hydra.config_loader, settings)  # type: ignore[assignment]
        if arguments.cfg is not None:
            _show_settings(hydra, command, arguments)
        elif arguments.info is not None:
            hydra.show_info(arguments.info, config_name=command, overrides=settings)
        else:
            sweep = arguments.multirun
            # Only a user's own file, or a setting, makes a sweep without -m. To see it everything is composed, 0.2 s.
            if not (sweep or arguments.run) and (
                arguments.config_dir is not None or any("hydra" in one for one in settings)
            ):
                sweep = hydra.get_mode(config_name=command, overrides=settings) == RunMode.MULTIRUN
            require_few_jobs(settings if sweep else [])
            if sweep:
                _check_jobs(hydra, command, settings)
            run, mode = (hydra.multirun, RunMode.MULTIRUN) if sweep else (hydra.run, RunMode.RUN)
            done: Any = run(
                command, task_function=run_command, overrides=[*settings, f"hydra.mode={mode.name}"]
            )
            # Other sweepers than Hydra's keep tables of their own.
            if jobs := [job for batch in done or () for job in batch] if sweep else []:
                _end_sweep(jobs, command)


def _end_sweep(jobs: Sequence[Any], command: str) -> None:
    """The table of the jobs; other launchers than Hydra's own go on when one fails, which is said then.

    Raises:
        UserError: It names the first job that failed.
    """
    from sgns.cli.help import end_sweep

    failed = {n: job for n, job in enumerate(jobs) if isinstance(job.return_value, _Failed)}
    if complete := [job for n, job in enumerate(jobs) if n not in failed]:
        end_sweep(complete, COMMANDS[command].value)
    for number, job in failed.items():
        kept = f"; {len(failed)} of {len(jobs)} jobs failed, the others are kept" if complete else ""
        raise UserError(f"{_label(number, job.overrides)}{job.return_value.line}{kept}")


_MOST_CHECKED = 200
"""Jobs of a sweep whose settings are looked at before the first begins; composing takes some 0.1 s each."""


def _check_jobs(hydra: Any, command: str, settings: Sequence[str]) -> None:
    """Refuse a sweep of which a job would be refused for its settings, before its first job begins.

    Raises:
        UserError: It names the job.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from sgns.cli.settings import check_shared, sweep_jobs

    master = hydra.config_loader.load_configuration(command, settings, RunMode.MULTIRUN)
    jobs = sweep_jobs(settings)
    shared_overrides[:] = set(jobs[0]).intersection(*jobs) if len(jobs) > 1 else ()
    check = getattr(importlib.import_module(COMMANDS[command].module), "check_settings", None)
    for number, job in enumerate(jobs if len(jobs) <= _MOST_CHECKED else ()):
        try:
            cfg = hydra.config_loader.load_sweep_config(master, job)
            HydraConfig.instance().set_config(cfg)
            cfg = hydra.get_sanitized_cfg(cfg, "job")
            check_shared(cfg, command, COMMANDS[command].needs)
            if check is not None:
                check(cfg, job)
        except Exception as error:
            if (line := _line_of(error)) is None:
                raise
            raise UserError(f"{_label(number, job)}{line}; no job has begun") from error


def _label(number: int, overrides: Sequence[str]) -> str:
    """What a job of a sweep is called: by what differs between the jobs."""
    return f"job {number} ({_one_line(','.join(own_overrides(overrides)))}): "


def _show_settings(hydra: Any, command: str, arguments: argparse.Namespace) -> None:
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import OmegaConf

    cfg = hydra.compose_config(
        config_name=command, overrides=arguments.settings, run_mode=RunMode.RUN, with_log_configuration=False
    )
    HydraConfig.instance().set_config(cfg)
    OmegaConf.set_readonly(cfg.hydra, None)
    if arguments.resolve:
        OmegaConf.resolve(cfg)  # all of it: Hydra's own settings name the command's, and the other way round
    shown = hydra.get_sanitized_cfg(cfg, arguments.cfg)
    package = arguments.package
    if package not in (None, "_global_"):
        shown = OmegaConf.select(shown, package)
        if shown is None:
            raise UserError(
                f"--package {package}: no such key, or null; see sgns {command} --cfg {arguments.cfg}"
            )
        write_output(f"# @package {package}\n" if OmegaConf.is_config(shown) else "")
    write_output(OmegaConf.to_yaml(shown) if OmegaConf.is_config(shown) else f"{shown}\n")


def _help() -> str:
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items())
    return f"""\
sgns {__version__}: granular flow under a moving tool, simulated and learned

sgns <command> [key=value ...]        run a command with some of its settings changed
sgns <command> -m key=a,b [...]       a sweep: one job for each value
sgns <command> --help                 what it does, its main keys and groups
sgns <command> --cfg job              all its settings

Commands:
{commands}

Examples:
  sgns simulate scene=excavation scene.depth=0.08 scene.speed=0.10 scene.rake=10 output=run.h5
  sgns train dataset=quick reduction.num_modes=8 output=outputs/first
"""


def _parsed(command: str, arguments: list[str]) -> argparse.Namespace:
    """Flags and `settings` of a command; plain paths as the keys that they are for.

    The flags are those of Hydra that read nothing but settings.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("settings", nargs="*")
    parser.add_argument("--cfg", "-c", choices=("job", "hydra", "all"))
    parser.add_argument("--resolve", action="store_true")
    parser.add_argument("--package", "-p")
    parser.add_argument("--run", "-r", action="store_true")
    parser.add_argument("--multirun", "-m", action="store_true")
    parser.add_argument("--config-dir", "-cd")
    kinds = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
    parser.add_argument("--info", "-i", nargs="?", const="all", choices=kinds)

    def refuse(message: str) -> NoReturn:
        raise UserError(
            f"{message}; flags: --multirun (-m), --run, --config-dir, --cfg, --package, --resolve, --info; "
            f"settings are written key=value; see sgns {command} --help"
        )

    parser.error = refuse  # type: ignore[method-assign]
    if "--version" in arguments:
        refuse("--version stands alone: sgns --version")
    parsed = parser.parse_intermixed_args(arguments)
    if (parsed.resolve or parsed.package is not None) and parsed.cfg is None:
        refuse("--resolve and --package go with --cfg job")
    if sum((parsed.run, parsed.cfg is not None, parsed.multirun, parsed.info is not None)) > 1:
        refuse("only one of --run, --multirun (-m), --cfg, --info can be given")
    plain = COMMANDS[command].plain
    if command == "check" or plain:
        settings = parsed.settings
        paths = [setting for setting in settings if "=" not in setting or os.path.exists(setting)]
        parsed.settings = [setting for setting in settings if setting not in paths]
        if command == "check" and paths:
            parsed.settings.append(f"files=[{','.join(map(_quoted, paths))}]")
        elif command == "import" and len(paths) > 1:  # a shell makes many of a pattern
            *sources, output = map(_quoted, paths)
            parsed.settings += [f"source=[{','.join(sources)}]", f"output={output}"]
        elif len(paths) > len(plain) > 0:
            refuse(f"{paths[len(plain)]!r} is one path too many: sgns {command} takes {' and '.join(plain)}")
        else:
            parsed.settings += [f"{key}={_quoted(path)}" for key, path in zip(plain, paths, strict=False)]
    return parsed


def _quoted(text: str) -> str:
    """Text in the quotes of Hydra's grammar, safe against its interpolation."""
    from hydra.core.override_parser.types import Quote, QuotedString

    return QuotedString(text=text.replace("${", "\\${"), quote=Quote.single).with_quotes()


def _place_output(cfg: DictConfig, hydra_cfg: Any, command: Command, in_sweep: bool) -> None:
    """Set `cfg.output`: Hydra's run folder for a folder; in a sweep a file goes into its job's folder.

    A file with an absolute path keeps its place; only a folder with the job's number comes between.
    """
    folder = Path(hydra_cfg.runtime.output_dir)
    here = Path.cwd()
    folder = folder.relative_to(here) if folder.is_relative_to(here) else folder
    if command.output == "folder":
        cfg.output = str(folder)
    elif command.output == "file" and in_sweep and cfg.output is not None:
        path = Path(cfg.output)
        own = path.parent / str(hydra_cfg.job.num) / path.name if path.is_absolute() else folder / path
        cfg.output = str(own)


def _drop_empty_output(hydra_cfg: Any) -> bool:
    """Remove the run folder when nothing but Hydra's record is in it; says whether it is still there."""
    folder = Path(hydra_cfg.runtime.output_dir)
    if hydra_cfg.output_subdir is None:
        return True
    record = folder / hydra_cfg.output_subdir
    if any(path != record for path in folder.glob("*")):
        return True
    for name in ("config.yaml", "hydra.yaml", "overrides.yaml"):
        (record / name).unlink(missing_ok=True)
    here = Path.cwd()
    for path in (record, folder, *folder.parents):
        if path != record and path != folder and here not in path.parents:
            break
        try:
            path.rmdir()
        except OSError:
            break
    return folder.exists()


def _interruption(cfg: DictConfig, name: str, kept: bool, output: str) -> str:
    if COMMANDS[name].output == "folder" and kept:
        return f"to go on, give the same command with output={output}"
    if COMMANDS[name].output == "folder" or cfg.get("dataset") is not None:
        return "what is complete is kept, and the same command goes on from there"
    return "nothing new is kept"


def _status(stop: KeyboardInterrupt) -> int:
    """As a shell gives of a process that a signal ended."""
    return 128 + (stop.number if isinstance(stop, Interrupted) else signal.SIGINT)


def _line_of(error: Exception) -> str | None:
    """The one line for an error that a person can repair; None for a bug."""
    if isinstance(error, UserError):
        return _one_line(str(error))
    # mpm_warp can only have raised when it has been imported, which takes a while
    mpm_warp = sys.modules.get("mpm_warp")
    if mpm_warp is not None and isinstance(error, (mpm_warp.SceneError, mpm_warp.SolverStopped)):
        return _one_line(str(error))
    if isinstance(error, OSError) and error.errno in _FULL:
        where = "" if error.filename is None else f"{error.filename}: "
        return f"{where}{error.strerror}; free some space; what is complete is kept, and the same command goes on"
    if (
        isinstance(error, OSError)
        and error.filename is not None
        and (error.errno in _UNWRITABLE or _of_mkdir(error))
    ):
        return f"{error.filename}: {error.strerror}; choose another output"
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "can't allocate" in str(error)):
        reason = _one_line(str(error)) or "no reason given"
        return (
            f"more memory is needed than there is ({reason}); make the scene, the data or the network smaller"
        )
    if "omegaconf" not in sys.modules:
        return None
    taken_out = [argument for argument in sys.argv if argument.startswith("~")]
    if taken_out and isinstance(error, (AttributeError, KeyError)):
        return f"{' '.join(taken_out)}: what is taken out here is needed; leave this out"
    circle = [argument for argument in sys.argv if "${" in argument]
    if circle and "Recursive interpolation" in str(error):
        return f"{' '.join(circle)}: this refers to itself; give a value"
    from sgns.cli.help import describe

    line = describe(error)
    return None if line is None else _one_line(line)


def _of_mkdir(error: BaseException) -> bool:
    """Whether a folder could not be made, such as one in /proc: the system then says that it is not there."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and trace.tb_frame.f_code.co_name in ("mkdir", "makedirs")


def _one_line(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"


def _show_traceback() -> None:
    """For developers: SGNS_TRACEBACK=1 shows where a line about bad input came from."""
    if os.environ.get("SGNS_TRACEBACK") == "1":
        import traceback

        traceback.print_exc()
