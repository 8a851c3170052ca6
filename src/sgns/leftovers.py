"""Hidden files that become the real ones when they are complete, and what killed processes leave of them."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import stat
from pathlib import Path
from typing import IO
from uuid import uuid4

from mpm_warp.inputs import open_file

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

from sgns.errors import UserError

__all__ = ["give_name", "hidden_beside", "hold", "is_replaceable", "remove_leftovers", "require_replaceable"]

log = logging.getLogger(__name__)

_SUFFIX = ".partial"
_KINDS = {
    stat.S_IFLNK: "a symbolic link; give the name of the file itself",
    stat.S_IFDIR: "a folder; give the name of a file in it, or another name",
    stat.S_IFIFO: "a pipe; give the name of a file",
    stat.S_IFSOCK: "a socket; give the name of a file",
    stat.S_IFCHR: "a device; give the name of a file",
    stat.S_IFBLK: "a device; give the name of a file",
}
"""What is never replaced by a file. A link is not either, wherever it leads: /dev/stdout is one, and may lead to a
plain file."""


def hidden_beside(path: Path) -> Path:
    """A name in the same folder that says which process of which machine writes `path`."""
    return path.with_name(f"{_start(path)}{os.getpid()}-{uuid4().hex[:8]}{_SUFFIX}")


def require_replaceable(*paths: Path) -> None:
    """Refuse names that stand for something else than a plain file, or nothing yet: a file that takes such a name would
    destroy a device, a pipe or a link.

    Raises:
        UserError: says what it is.
    """
    for path in paths:
        kind = _kind(path)
        if kind not in (None, stat.S_IFREG):
            what = _KINDS.get(kind, "no plain file; give the name of a file")
            raise UserError(f"cannot write {path}: it is {what}")


def is_replaceable(path: Path) -> bool:
    """Whether a file of ours may be there, or be put there: see `require_replaceable`."""
    return _kind(path) in (None, stat.S_IFREG)


def give_name(temporary: Path, path: Path) -> None:
    """Let a complete file take its name, and the place of a plain file that had it.

    Raises:
        UserError: By now the name stands for something else.
        OSError: The system refuses.
    """
    require_replaceable(path)
    os.replace(temporary, path)


def _kind(path: Path) -> int | None:
    """What the name itself stands for, as in `stat`; None for nothing, or where that cannot be asked."""
    try:
        return stat.S_IFMT(os.lstat(path).st_mode)
    except (OSError, ValueError):  # a name that no file can have is refused when the file is made
        return None


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
        if _kind(found) != stat.S_IFREG:  # none of ours; opening a pipe may never end
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
