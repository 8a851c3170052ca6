"""Hidden files that become the real ones when they are complete, and what killed processes leave of them."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from pathlib import Path
from typing import IO
from uuid import uuid4

from mpm_warp.inputs import open_file

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

__all__ = ["hidden_beside", "hold", "remove_leftovers"]

log = logging.getLogger(__name__)

_SUFFIX = ".partial"


def hidden_beside(path: Path) -> Path:
    """A name in the same folder that says which process of which machine writes `path`."""
    return path.with_name(f"{_start(path)}{os.getpid()}-{uuid4().hex[:8]}{_SUFFIX}")


def hold(file: IO[bytes]) -> None:
    """Show other processes, also those that cannot see this one's number, that the file is being written."""
    if fcntl is not None:
        with contextlib.suppress(OSError):  # some file systems have no locks
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def remove_leftovers(path: Path) -> None:
    """Delete what killed processes of this machine left of `path`."""
    if fcntl is None:
        return
    start = _start(path)
    for found in path.parent.iterdir():
        if not (found.name.startswith(start) and found.name.endswith(_SUFFIX)):
            continue
        pid = found.name[len(start) :].split("-")[0]
        if not pid.isdecimal() or _alive(int(pid)):
            continue
        # A live process in a container may have a number that we cannot see; its lock shows that it is there.
        with contextlib.suppress(OSError, ValueError), open_file(found, 1 << 62) as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            found.unlink()
            log.info("removed %s, left by a process that was killed", found)


def _start(path: Path) -> str:
    return f".{path.name}.{socket.gethostname()}-"


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return not _ended(pid)


def _ended(pid: int) -> bool:
    """Whether only the number of a process is left until its parent asks for its status, which may be never."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()[0]
    except (OSError, IndexError):  # another system, or gone by now
        return False
    return state in ("Z", "X")
