"""How settings are put together, and checks of those that all commands share."""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Callable, Container, Iterable, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar

from hydra.core.config_loader import ConfigLoader
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, QuotedString, RangeSweep
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from sgns import settings as typed
from sgns.cli.help import describe, groups_of, options_of
from sgns.cli.hydra_settings import require_own_objects, require_plain_overrides
from sgns.command_settings import COMMANDS
from sgns.config import UserError, parse_yaml

# --- How settings are put together: by Hydra, with a look at each result before anybody acts on it ------

_sources: Any = Plugins.instance().discover(ConfigSource)
_Files: Any = next(one for one in _sources if one.scheme() == "file")
_MOST_BYTES = 1 << 20
"""Of a file of settings."""


class OwnFiles(_Files):
    """Files of settings that anybody may have written: looked at before OmegaConf copies what aliases stand for."""

    @staticmethod
    def scheme() -> str:
        return "own"

    def load_config(self, config_path: str) -> ConfigResult:
        """As Hydra's own.

        Raises:
            UserError: The file is no group of settings, or stands for more than fits in memory.
        """
        from sgns.data.files import read_text

        file = Path(self.path, self._normalize_file_name(config_path))
        text = read_text(file, "no file of settings", "repair it", _MOST_BYTES)
        try:
            content = parse_yaml(text)
        except ValueError as error:
            raise UserError(f"{file} is no file of settings: {error}; repair it") from None
        if not isinstance(content, dict | None):
            raise UserError(f"{file} is no file of settings: it holds no keys with values; repair it")
        return super().load_config(config_path)


class ConfigDir(SearchPathPlugin):
    """Adds the folder of `--config-dir` to the places where options of groups are found."""

    folder: ClassVar[str | None] = None

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if ConfigDir.folder is not None:
            search_path.append("command-line", f"{OwnFiles.scheme()}://{ConfigDir.folder}")


class CheckedLoader:
    """Hydra's loader, which refuses settings that would run something.

    Hydra makes objects right after it has composed the settings, and calls nobody in between. A sweep's jobs are
    composed one by one, by launchers also in other processes, where this loader comes along.

    Args:
        loader: Hydra's own.
        typed: The overrides of the command line.
    """

    def __init__(self, loader: ConfigLoader, typed: Sequence[str]) -> None:
        self._loader = loader
        self._typed = list(typed)

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        with suppress(HydraException):  # composing says what cannot be read
            require_options(overrides, ("hydra", *groups_of(config_name or "")))
        how = (run_mode, from_shell, validate_sweep_overrides)
        return self._composed(
            config_name,
            overrides,
            lambda all_: self._loader.load_configuration(config_name, all_, *how),
            any("," in value and options_of(key) for key, _, value in (o.partition("=") for o in overrides)),
        )

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        return self._composed(
            master_config.hydra.job.config_name,
            sweep_overrides,
            lambda all_: self._loader.load_sweep_config(master_config, all_),
            True,
        )

    def _composed(
        self,
        command: str | None,
        overrides: list[str],
        compose: Callable[[list[str]], DictConfig],
        in_sweep: bool,
    ) -> DictConfig:
        require_plain_overrides(overrides)
        first = self._first(command, overrides)
        try:
            cfg = compose([*first, *overrides])
        except Exception as error:
            if in_sweep and "no such key" in (said := describe(error) or ""):
                options = [one for one in (*first, *overrides) if options_of(one.partition("=")[0])]
                chosen = " ".join(one for one in options if "," not in one)
                raise UserError(
                    f"the job with {chosen}: {said}; each job of a sweep takes every setting: for options with other "
                    "keys make sweeps of their own"
                ) from error
            if isinstance(error, (MemoryError, UserError)) or describe(error) is not None:
                raise
            if isinstance(error, ValueError) and (line := _key_of_a_grid(overrides)):
                raise UserError(line) from error
            # Composing runs nothing of ours: what goes wrong there is in the settings.
            raise UserError(
                f"the settings cannot be put together: {type(error).__name__}: {error}"
            ) from error
        # Nobody has typed these, and every job of a sweep finds its own.
        cfg.hydra.overrides.task = cfg.hydra.overrides.task[len(first) :]
        require_own_objects(cfg, self._typed)
        _expand_home(cfg)
        return cfg

    def _first(self, command: str | None, overrides: list[str]) -> list[str]:
        """Overrides to stand before those that are given.

        They choose the scene of a dataset or a checkpoint, so that the others can be of its keys. For a sweep's own
        settings, which are composed before those of its jobs, they take the first option of each group that it is
        over. And they empty `dataset.draw` where it is given, so that a grid takes the place of a list of grids.
        """
        parser = OverridesParser.create()
        try:
            parsed = parser.parse_overrides(overrides)
        except HydraException:  # composing says what is wrong
            return []
        first = [
            f"{one.key_or_group}={_value(sweep)}"
            for one in parsed
            if isinstance(sweep := one.value(), ChoiceSweep) and options_of(one.key_or_group)
        ]
        given = {override.key_or_group: override for override in [*parsed, *parser.parse_overrides(first)]}
        empty = ["dataset.draw=0"] if "dataset.draw" in given else []
        return [*first, *empty, *self._chosen(command, given)]

    def _chosen(self, command: str | None, given: dict[str, Override]) -> list[str]:
        if "scene" in given:
            return []
        if command == "rollout" and "experiment" not in given and (checkpoint := given.get("checkpoint")):
            file = checkpoint.value()
            if isinstance(file, ChoiceSweep):  # until each job has its own
                file = _value(file)
            return _of_checkpoint(file, given)
        if command == "simulate" and "dataset" in given:
            try:
                lines = [str(given[key].input_line) for key in ("dataset", "dataset.scene") if key in given]
                alone = self._loader.load_configuration("simulate", lines, RunMode.RUN)
                scene = alone.dataset.get("scene")
            except Exception:  # said where everything is composed
                return []
            return [f"scene={scene}"] if isinstance(scene, str) else []
        return []

    def compute_defaults_list(self, config_name: str | None, overrides: list[str], run_mode: RunMode) -> Any:
        require_plain_overrides(overrides)
        return self._loader.compute_defaults_list(config_name, overrides, run_mode)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # of an object that is not yet unpickled
            raise AttributeError(name)
        return getattr(self._loader, name)


def _value(sweep: ChoiceSweep) -> Any:
    first = sweep.list[0]
    return first.text if isinstance(first, QuotedString) else first


def _key_of_a_grid(overrides: Sequence[str]) -> str | None:
    """The line for an override of one key of `dataset.draw`, where that is a list of grids."""
    for one in overrides:
        if found := re.match(r"\+*dataset\.draw\.([^\d=][^=]*)=(.*)", one):
            key, values = found.groups()
            return (
                f"dataset.draw.{key}: this dataset draws from a list of grids; give the keys to draw together, "
                f"as in 'dataset.draw={{{key}: {values}, ...}}'"
            )
    return None


def _of_checkpoint(file: Any, given: Container[str]) -> list[str]:
    """Overrides that choose scene and soil of a checkpoint, but for groups that are given."""
    if not isinstance(file, str) or not file:  # said later
        return []
    from sgns.rollout import scene_groups  # loads torch: seconds

    groups = scene_groups(os.path.expanduser(file))
    for group, node in groups.items():
        ConfigStore.instance().store(name="of_checkpoint", node=node, group=group, provider="sgns")
    return [f"{group}=of_checkpoint" for group in groups if group not in given]


def _expand_home(node: Any) -> None:
    """Put the home folder in place of `~` at the beginning of values, as a shell does of words without quotes."""
    for key in list(node) if isinstance(node, DictConfig) else range(len(node)):
        if OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key) or key == "hydra":
            continue
        value = node[key]
        if OmegaConf.is_config(value):
            _expand_home(value)
        elif isinstance(value, str) and value.startswith("~"):
            node[key] = os.path.expanduser(value)


MOST_JOBS = 10_000
"""Of a sweep."""


def require_options(overrides: Sequence[str], groups: Iterable[str]) -> None:
    """Refuse null and numbers as options of a group.

    Raises:
        UserError: It names the group.
    """
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key, value = override.key_or_group, None if override.is_sweep_override() else override.value()
        if not key:
            raise UserError(f"cannot read {override.input_line!r}; settings are written key=value")
        if key == "experiment" and ConfigDir.folder is None:
            raise UserError(
                f"{override.input_line}: --config-dir is missing, the folder that holds experiment/*.yaml"
            )
        if key in groups and not (override.is_delete() or override.is_sweep_override()):
            if not isinstance(value, (str, list, dict)):
                raise UserError(
                    f"{key} is {_shown(value)}; allowed: {', '.join(options_of(key)) or 'names of files'}"
                )


def require_few_jobs(overrides: Sequence[str]) -> None:
    """Refuse a sweep of more jobs than anybody waits for, before its values are listed.

    Raises:
        UserError: It names the range, or the number of jobs.
    """
    jobs = 1.0
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        sweep = override.value() if override.is_sweep_override() else None
        if isinstance(sweep, RangeSweep):
            start, stop, step = (float(x or 0.0) for x in (sweep.start, sweep.stop, sweep.step))
            count = (stop - start) / step if step else math.nan
            if math.isnan(count):
                raise UserError(f"{override.input_line}: a range needs numbers and a step that is not 0")
            jobs *= max(1.0, math.ceil(count) if math.isfinite(count) else count)
        elif isinstance(sweep, ChoiceSweep):
            jobs *= max(1, len(sweep.list))
    if jobs > MOST_JOBS:
        raise UserError(f"the sweep has {jobs:.3g} jobs; at most {MOST_JOBS} are allowed: give fewer values")


def sweep_jobs(overrides: Sequence[str]) -> list[list[str]]:
    """The overrides of every job of a sweep, in the order of Hydra's own sweeper; none where only a sweeper knows."""
    values = []
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        if not override.is_sweep_override():
            values.append([f"{key}={override.get_value_element_as_str()}"])
        elif isinstance(override.value(), (ChoiceSweep, RangeSweep)):
            values.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        else:
            return []
    return [list(job) for job in itertools.product(*values)]


# --- The settings that mean the same in every command, checked before any work is done ------------------


_TAKES = {
    "check": ("run files", "run.h5"),
    "plot": ("a run file", "run.h5"),
    "render": ("a run file", "run.h5"),
    "import": ("a source and a name", "run.npz run.h5"),
    "convert": ("a run file and a name", "run.h5 run.vtkhdf"),
}
"""What commands take as plain paths, with an example."""


def check_shared(cfg: DictConfig, command: str, needed: tuple[str, ...]) -> None:
    """Refuse settings that lack a value (???), point nowhere, or are not what every command takes them for.

    Args:
        cfg: All settings.
        command: Name of the command, for the message.
        needed: Dotted keys of paths that the command cannot do without.

    Raises:
        UserError: The line names the key.
    """
    own: Any = COMMANDS[command]
    keys = _keys_of(command)
    if odd := set(cfg) - keys:
        # A file of settings may be for several commands.
        if odd := odd.difference(*map(_keys_of, COMMANDS)):
            known = ", ".join(sorted(keys))
            raise UserError(f"{min(odd)}: no such key; keys of sgns {command}: {known}")
    campaign = command == "simulate" and cfg.get("dataset") is not None  # may draw what its scene lacks
    missing = sorted(
        key for key in OmegaConf.missing_keys(cfg) if not (campaign and key.startswith("scene."))
    )
    if missing:
        blanks = " ".join(f"{key}=..." for key in missing)
        what = "a value is" if len(missing) == 1 else "values are"
        takes = _TAKES.get(command)
        give = blanks if takes is None else f"{takes[0]}, as in sgns {command} {takes[1]}"
        raise UserError(f"{what} missing for {', '.join(missing)}; give {give}; see sgns {command} --help")
    every: Any = OmegaConf.to_container(cfg, resolve=True)
    plain = {key: value for key, value in every.items() if key in keys}
    for group, default in groups_of(command).items():
        if default is not None and cfg.get(group) is None:
            allowed = ", ".join(options_of(group))
            raise UserError(f"{group} is missing; sgns {command} needs one; allowed: {allowed}")
        if default is not None and not OmegaConf.is_config(cfg[group]):
            raise UserError(f"{group} is {_shown(cfg[group])}; it must be a group of settings")
    for key in needed:
        value = OmegaConf.select(cfg, key)
        if not isinstance(value, str) or not value:
            raise UserError(f"{key} is {_shown(value)}; it must be a path; see sgns {command} --help")
    if isinstance(plain.get("dataset"), dict) and plain["dataset"].get("name") is None:
        raise UserError(
            "dataset.name is missing; choose a dataset, as in dataset=quick, or give this one a name"
        )
    checked = own.from_dict({one.name: plain[one.name] for one in fields(own) if one.name in plain})
    for key, value in vars(checked).items():
        if type(value) is int and type(plain.get(key)) is float:  # 1e6 is a whole number to people
            OmegaConf.update(cfg, key, value)
    if plain.get("dataset") is not None:
        typed.dataset_settings(plain["dataset"])
    if "reduction" in plain:
        typed.ReductionSettings.from_dict(plain["reduction"])
    if "model" in plain:
        typed.training_settings(plain["model"], plain["training"])
    if "solver" in plain:
        typed.SolverSettings.from_dict(plain["solver"])


def _keys_of(command: str) -> set[str]:
    """Keys and groups of a command."""
    return {one.name for one in fields(COMMANDS[command])} | set(groups_of(command))  # type: ignore[arg-type]


def _shown(value: Any) -> str:
    return "null" if value is None else repr(value)
