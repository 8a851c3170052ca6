"""The permissions of files count for root, too, once a process has given up the right to pass over them."""

import ctypes
import os


def become_ordinary() -> None:
    """Give up root's rights over other people's files, so that permissions count; nothing happens to other users."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    header, data = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    if libc.capget(header, data) != 0:
        raise OSError(ctypes.get_errno(), "capget")
    for index in range(3):  # effective, permitted, inheritable
        data[index] &= ~(1 << 1 | 1 << 2)  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH of capabilities(7)
    if libc.capset(header, data) != 0:
        raise OSError(ctypes.get_errno(), "capset")
