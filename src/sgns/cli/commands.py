"""The command line: `sgns <command> [key=value ...] [-m]`.

One Hydra application serves all commands: the command's name becomes `--config-name`, so that its settings
are `conf/<command>.yaml`. Exit status: 0 done; 2 bad input, said in one line; 130 interrupted; 1 a bug, with
its traceback.
"""

from __future__ import annotations

import errno
import importlib
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from sgns import __version__
from sgns.errors import UserError

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["COMMANDS", "main", "run_command"]


class Command(NamedTuple):
    """One command.

    Attributes:
        module: whose `main(cfg)` does it.
        summary: a line of help.
        output: what its `output` is: "file", "folder", or None where it has none.
        needs: dotted keys of paths that it cannot do without.
    """

    module: str
    summary: str
    output: str | None
    needs: tuple[str, ...] = ()


COMMANDS = {
    "simulate": Command(
        "sgns.simulate", "simulate a scene or a dataset with the material point method", "file", ("output",)
    ),
    "reduce": Command(
        "sgns.reduction.reduce",
        "fit the basis (PCA) on a dataset and reduce its runs",
        "folder",
        ("dataset.path",),
    ),
    "train": Command(
        "sgns.learning.training", "learn a simulator from a dataset", "folder", ("dataset.path",)
    ),
    "rollout": Command(
        "sgns.rollout", "let a trained network play a scene", "file", ("checkpoint", "output")
    ),
    "evaluate": Command(
        "sgns.evaluation.evaluate",
        "compare a trained network with true runs; write the report",
        "folder",
        ("dataset.path", "checkpoint"),
    ),
    "frontier": Command(
        "sgns.frontier.frontier", "measure what accuracy costs in time; table, figures and page", "folder"
    ),
    "advise": Command("sgns.frontier.advise", "name the setting that is good and fast enough", None),
    "check": Command("sgns.check", "read run files through and list what is wrong with them", None),
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


class _Stopped(BaseException):
    """Ends the process with one line.

    Not an `Exception`: Hydra would write a line of its own about those before it passes them on.
    """

    def __init__(self, line: str, status: int) -> None:
        super().__init__(line)
        self.line = line
        self.status = status


def main() -> int:
    """Run the command named in `sys.argv`; returns the exit status."""
    arguments = sys.argv[1:]
    name = "sgns"
    try:
        if not arguments or arguments[0] in ("--help", "-h", "help"):
            sys.stdout.write(_help())
            return 0
        if arguments[0] == "--version":
            sys.stdout.write(f"sgns {__version__}\n")
            return 0
        command, rest = _split(arguments)
        name = f"sgns {command}"
        if "--help" in rest or "-h" in rest:
            from sgns.cli.command_help import command_help

            sys.stdout.write(command_help(command))
            return 0
        # In place, and not only for Hydra: Lightning starts its other processes with this list.
        sys.argv[1:] = ["--config-name", command, *_hydra_arguments(command, rest)]
        _run_hydra()
        return 0
    except _Stopped as stop:
        sys.stderr.write(f"{name}: {stop.line}\n")
        return stop.status
    except KeyboardInterrupt:
        sys.stderr.write(f"{name}: interrupted\n")
        return 130
    except Exception as error:
        line = _line_of(error)
        if line is None:
            raise
        _show_traceback()
        sys.stderr.write(f"{name}: {line}\n")
        return 2


def run_command(cfg: DictConfig) -> float | None:
    """Hydra's task: run one job; its value is the command's main metric, for sweepers to optimise."""
    from hydra.core.hydra_config import HydraConfig

    from sgns.cli.shared_settings import check_shared

    hydra_cfg = HydraConfig.get()
    name = hydra_cfg.job.config_name
    in_sweep = hydra_cfg.mode.name == "MULTIRUN"
    label = f"job {hydra_cfg.job.num} ({hydra_cfg.job.override_dirname}): " if in_sweep else ""
    interrupted = False
    try:
        _place_output(cfg, hydra_cfg, COMMANDS[name], in_sweep)
        check_shared(cfg, name, COMMANDS[name].needs)
        return importlib.import_module(COMMANDS[name].module).main(cfg)
    except KeyboardInterrupt:
        interrupted = True
    except SystemExit as error:
        # Lightning turns Ctrl-C into an exit with status 1
        if not isinstance(error.__context__, KeyboardInterrupt):
            raise
        interrupted = True
    except Exception as error:
        line = _line_of(error)
        if line is None:
            raise
        _drop_empty_output(hydra_cfg)
        if not hydra_cfg.launcher._target_.endswith("BasicLauncher"):
            raise  # this is another process; the line is made in the first one
        _show_traceback()
        raise _Stopped(label + line, 2) from None
    assert interrupted
    kept = _drop_empty_output(hydra_cfg)
    raise _Stopped(label + _interruption(cfg, name, kept), 130) from None


def _run_hydra() -> None:
    logging.raiseExceptions = False  # a line that a full disk does not take is no reason for a traceback
    # With this variable Hydra passes errors on as they are, in place of its own block of text and status 1.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    import hydra
    from hydra._internal.config_loader_impl import ConfigLoaderImpl

    from sgns.cli.own_objects import require_own_objects

    compose = ConfigLoaderImpl.load_configuration

    def checked(self: ConfigLoaderImpl, *args: Any, **settings: Any) -> DictConfig:
        try:
            cfg = compose(self, *args, **settings)
        except Exception as error:
            if _line_of(error) is not None:
                raise
            # Composing runs nothing of ours: what goes wrong there is in the settings.
            raise UserError(
                f"the settings cannot be put together: {type(error).__name__}: {error}"
            ) from error
        require_own_objects(cfg)
        verbose = cfg.hydra.verbose
        if not isinstance(verbose, (bool, str, Sequence)):
            raise UserError(f"hydra.verbose is {verbose!r}; it must be true, false, or names of loggers")
        return cfg

    # Hydra makes objects right after it has composed the settings, and calls nobody in between.
    ConfigLoaderImpl.load_configuration = checked
    try:
        hydra.main(version_base="1.3", config_path="pkg://sgns.conf")(run_command)()
    finally:
        ConfigLoaderImpl.load_configuration = compose


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


def _split(arguments: list[str]) -> tuple[str, list[str]]:
    """The command and what follows it; also as `--config-name <command>`, as Lightning's processes get it."""
    command, *rest = arguments
    if command == "--config-name" and rest:
        command, *rest = rest
    if command not in COMMANDS:
        raise UserError(f"unknown command {command!r}; commands: {', '.join(COMMANDS)}; see sgns --help")
    return command, rest


def _hydra_arguments(command: str, arguments: list[str]) -> list[str]:
    """Arguments in the order that Hydra wants (flags first), the paths of `sgns check` as its key `files`."""
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise UserError(f"{message}; settings are written key=value; see sgns {command} --help")

    parser.error = refuse  # type: ignore[method-assign]
    if "--version" in arguments:
        refuse("--version stands alone: sgns --version")
    parsed = parser.parse_intermixed_args(arguments)
    if parsed.config_name is not None or parsed.config_path is not None:
        refuse(
            "--config-name and --config-path are given by the command; --config-dir adds a folder of your own"
        )
    if parsed.resolve and parsed.cfg is None:
        refuse("--resolve goes with --cfg job")
    if sum(map(bool, (parsed.run, parsed.cfg, parsed.multirun, parsed.shell_completion, parsed.info))) > 1:
        refuse("only one of --run, --multirun (-m), --cfg, --info, --shell-completion can be given")
    settings = list(parsed.overrides)
    flags = [argument for argument in arguments if argument not in settings]
    if command == "check":
        paths = [setting for setting in settings if "=" not in setting or os.path.exists(setting)]
        if paths:
            settings = [setting for setting in settings if setting not in paths]
            settings.append(f"files=[{','.join(map(_quoted, paths))}]")
    return [*flags, *settings]


def _quoted(text: str) -> str:
    """Text in the quotes of Hydra's grammar, safe against its interpolation."""
    from hydra.core.override_parser.types import Quote, QuotedString

    return QuotedString(text=text.replace("${", "\\${"), quote=Quote.single).with_quotes()


def _place_output(cfg: DictConfig, hydra_cfg: Any, command: Command, in_sweep: bool) -> None:
    """Set `cfg.output`: Hydra's run folder for a folder; in a sweep a file goes into its job's folder.

    A file with an absolute path keeps its place; only a folder with the job's number comes between.
    """
    if command.output == "folder":
        folder = Path(hydra_cfg.runtime.output_dir)
        here = Path.cwd()
        cfg.output = str(folder.relative_to(here) if folder.is_relative_to(here) else folder)
    elif command.output == "file" and in_sweep and cfg.output is not None:
        path = Path(cfg.output).expanduser()
        folder = (
            path.parent / str(hydra_cfg.job.num) if path.is_absolute() else Path(hydra_cfg.runtime.output_dir)
        )
        cfg.output = str(folder / (path.name if path.is_absolute() else path))


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


def _interruption(cfg: DictConfig, name: str, kept: bool) -> str:
    if COMMANDS[name].output == "folder" and kept:
        return f"interrupted; to go on, give the same command with output={cfg.output}"
    return "interrupted; what is complete is kept, and the same command goes on from there"


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
    if isinstance(error, OSError) and error.errno in _UNWRITABLE and error.filename is not None:
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
    from sgns.cli.setting_errors import describe

    return describe(error)


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _show_traceback() -> None:
    """For developers: SGNS_TRACEBACK=1 shows where a line about bad input came from."""
    if os.environ.get("SGNS_TRACEBACK") == "1":
        import traceback

        traceback.print_exc()
