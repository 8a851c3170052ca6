"""Loading kernels from Warp's cache, whatever became of the files there."""

from __future__ import annotations

import os
import shutil
from contextlib import nullcontext, suppress
from pathlib import Path

import warp as wp

from .errors import SceneError
from .start import silent_stderr

__all__ = ["load_kernel"]


def load_kernel(kernel: wp.Kernel, device: wp.Device) -> None:
    """Load a kernel's module; what is damaged in Warp's cache is compiled again, once.

    A full disk or a machine that was switched off leaves files that are cut short; Warp trusts whatever has the right
    name.

    Raises:
        SceneError: the cache cannot be written, or what was compiled anew does not load either.
    """
    module = kernel.module
    block_dim = 1 if device.is_cpu else module.options["block_dim"]
    folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block_dim)
    there = os.path.lexists(folder)
    try:
        with silent_stderr() if there else nullcontext():  # the line that follows says it, or it is repaired
            wp.load_module(module, device, max_workers=0)
        return
    except OSError as error:
        if not there:
            raise SceneError(_unwritable(error)) from error
    except Exception:  # Warp's own have no class of theirs
        if not there:
            raise
    aside = folder.with_name(f"{folder.name}.damaged-{os.getpid()}")
    try:
        # A folder that cannot be read can still be renamed. Another process may have done so.
        with suppress(FileNotFoundError):
            folder.rename(aside)
        shutil.rmtree(aside, ignore_errors=True)
        module.unload()  # a failure is remembered otherwise
        wp.load_module(module, device, max_workers=0)
    except OSError as error:
        raise SceneError(_unwritable(error)) from error
    except Exception as error:
        raise SceneError(
            f"the kernel {kernel.key} in {folder} was damaged and does not load when compiled anew either "
            f"({str(error).splitlines()[0]}); remove {wp.config.kernel_cache_dir} and try again"
        ) from error


def _unwritable(error: OSError) -> str:
    return (
        f"Warp's folder of compiled kernels, {wp.config.kernel_cache_dir}, cannot be used ({error}); repair or remove "
        "it, or name another one in the environment variable WARP_CACHE_PATH"
    )
