"""`sgns check`: read run files through and list what is wrong with them."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from sgns.errors import UserError
from sgns.runs import check_run

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main", "run_files"]

log = logging.getLogger(__name__)


def run_files(paths: Iterable[str | Path]) -> list[Path]:
    """Run files that the given paths stand for, in order.

    Args:
        paths: Files, and folders that hold run files themselves or, like a dataset, in a folder `runs`.

    Raises:
        UserError: A path does not exist, or a folder holds no run file.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        if not os.path.isdir(path):  # unlike Path.is_dir, takes any name
            if not os.path.exists(path):
                raise UserError(f"{path}: no such file; give run files (.h5) or folders of them")
            files.append(path)
            continue
        folder = path / "runs" if (path / "runs").is_dir() else path
        # a name that begins with a dot is one that is still being written
        found = sorted(file for file in folder.glob("*.h5") if not file.name.startswith("."))
        if not found:
            raise UserError(f"{folder}: holds no run file (*.h5); `sgns simulate` writes them")
        files.extend(found)
    if not files:
        raise UserError("nothing to check; give run files: sgns check run.h5")
    return files


def main(cfg: DictConfig) -> float:
    """Check the run files `cfg.files`; returns the number of problems, which is 0.

    Raises:
        UserError: A path is missing or a file has a problem; all problems have been listed before.
    """
    named = [cfg.files] if isinstance(cfg.files, str) else OmegaConf.to_container(cfg, resolve=True)["files"]
    if not isinstance(named, list) or not all(isinstance(path, str) for path in named):
        raise UserError(f"files is {named!r}; it must be paths of run files, as in sgns check run.h5")
    files = run_files(named)
    bad = 0
    for path in files:
        try:
            problems = check_run(path)
        except UserError as error:
            problems = [str(error)]
        if problems:
            bad += 1
            for problem in problems:
                log.info("%s", problem if str(path) in problem else f"{path}: {problem}")
        else:
            log.info("%s: good", path)
    if bad:
        raise UserError(
            f"{bad} of {len(files)} files checked {'is' if bad == 1 else 'are'} not good; see above"
        )
    return 0.0
