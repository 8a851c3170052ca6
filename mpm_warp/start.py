"""Starting Warp without noise, and finding its devices."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache

import warp as wp

from .errors import SceneError

__all__ = ["find_device", "silent_stderr", "start_warp"]


@cache
def start_warp() -> None:
    """Initialise Warp once, without its banner and, where there is no CUDA driver, without saying so.

    Raises:
        SceneError: it has no place for compiled kernels.
    """
    # Warp announces every kernel it loads; here only its warnings are of use.
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    try:
        with nullcontext() if _has_cuda_driver() else silent_stderr():
            wp.init()
    except OSError as error:
        raise SceneError(
            f"Warp cannot make its folder of compiled kernels ({error}); name another one in the environment variable "
            "WARP_CACHE_PATH"
        ) from error


def find_device(name: str) -> wp.Device:
    """The device called `cpu`, `cuda`, `cuda:0`, ..., with Warp started.

    Raises:
        SceneError: there is no such device here.
    """
    start_warp()
    if name == "cuda" and wp.is_cuda_available():
        return wp.get_device(name)
    devices = {str(device): device for device in wp.get_devices()}
    if name not in devices:
        raise SceneError(f"device is {name!r}; allowed here: {', '.join(devices)}")
    return devices[name]


def _has_cuda_driver() -> bool:
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Nothing reaches the error stream, not from native code either."""
    # The warning comes from native code, past Python's sys.stderr.
    try:
        kept = os.dup(2)
    except OSError:  # there is no stderr
        yield
        return
    silent = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silent, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(silent)
