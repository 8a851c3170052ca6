"""What is kept of a run whose solver stopped: its frames, and the state to go on from."""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np

from mpm_warp import State
from sgns.errors import UserError
from sgns.hdf5 import BROKEN, own_attribute, own_dataset, own_object
from sgns.leftovers import is_replaceable, require_replaceable
from sgns.runs.runlayout import one_line, open_run, read_attributes

__all__ = ["read_state", "remove_stopped", "require_run_place", "stopped_path", "write_state"]

_GROUP = "state"


def stopped_path(path: Path) -> Path:
    """Where the frames of a run go that was to become `path` and stopped before its end."""
    return path.with_name(f"{path.stem}.stopped{path.suffix}")


def require_run_place(path: Path) -> None:
    """Refuse a run's name if the run, or its frames if it stops, would destroy something else than a run of before.

    Raises:
        UserError: says what is there.
    """
    kept = stopped_path(path)
    require_replaceable(path, kept)
    if os.path.lexists(kept) and not _is_stopped(kept):
        raise UserError(
            f"{kept} is no stopped run, and the frames of {path.name} would go there if it stopped; move it, or choose "
            "another output"
        )


def remove_stopped(path: Path) -> None:
    """Remove what an earlier attempt at a run left, now that the run is complete; anything else stays."""
    kept = stopped_path(path)
    if is_replaceable(kept) and _is_stopped(kept):
        kept.unlink(missing_ok=True)


def _is_stopped(path: Path) -> bool:
    try:
        with open_run(path) as file:
            return "stopped" in read_attributes(file)
    except (UserError, *BROKEN):
        return False


def write_state(file: h5py.File, state: State) -> None:
    """Store a state beside the frames."""
    group = file.create_group(_GROUP)
    group.attrs["frame"] = np.int64(state.frame)
    for name, array in state.arrays.items():
        group[name] = array


def read_state(path: str | os.PathLike[str]) -> State:
    """The state in a stopped run.

    Raises:
        UserError: the file cannot be read or holds none.
    """
    with open_run(path) as file:
        try:
            group = own_object(file, _GROUP)
            if not isinstance(group, h5py.Group):
                raise UserError(
                    f"{path} holds no state to go on from; give a *.stopped.h5, which `sgns simulate` leaves when the "
                    "solver stops"
                )
            return State(
                int(own_attribute(group, "frame")),
                {name: _numbers(group, name, path) for name in sorted(group)},
            )
        except BROKEN as error:
            raise UserError(f"{path}: its state is damaged ({one_line(error)}); repeat the run") from error


def _numbers(group: h5py.Group, name: str, path: str | os.PathLike[str]) -> np.ndarray:
    found = own_dataset(group, name)
    if found.dtype.kind not in "if":
        raise UserError(f"{path}: /{_GROUP}/{name} does not hold numbers; repeat the run")
    return found[...]
