"""Warp: its start, kernels for one scene or many, and the jobs that scenes ask of the device."""

from __future__ import annotations

import ctypes
import inspect
import linecache
import os
import shutil
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from .state import SceneError

# --- Starting Warp without noise, and finding its devices -----------------------------------------------


@cache
def start_warp() -> None:
    """Initialise Warp once, without its banner and, where there is no CUDA driver, without saying so.

    Raises:
        SceneError: it has no place for compiled kernels.
    """
    named = wp.config.kernel_cache_dir or os.getenv("WARP_CACHE_PATH") or os.getenv("XDG_CACHE_HOME")
    if not named and os.path.expanduser("~") == "~":  # Warp would make a folder of that name here
        raise SceneError(
            "this user has no home folder, where Warp keeps compiled kernels; name a folder for them in the "
            "environment variable WARP_CACHE_PATH"
        )
    # Warp announces every kernel it loads; here only its warnings are of use.
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    quiet: AbstractContextManager = nullcontext()
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        quiet = silent_stderr()
    try:
        with quiet:
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


# --- Loading kernels from Warp's cache, whatever became of the files there ------------------------------


def load_kernel(kernel: wp.Kernel, device: wp.Device) -> None:
    """Load a kernel's module; what is damaged in Warp's cache is compiled again, once.

    A full disk or a machine that was switched off leaves files that are cut short; Warp trusts whatever has the right
    name.

    Raises:
        SceneError: the cache cannot be written, or what was compiled anew does not load either.
    """
    module = kernel.module
    block_dim = 1 if device.is_cpu else module.options["block_dim"]
    folder = Path(str(wp.config.kernel_cache_dir)) / module.get_module_identifier(block_dim)
    there = os.path.lexists(folder)
    try:
        try:
            with silent_stderr() if there else nullcontext():  # the error below says it, or it is repaired
                wp.load_module(module, device, max_workers=0)
            return
        except Exception:  # Warp's own have no class of theirs
            if not there:
                raise
        # A folder that cannot be read can still be renamed. Another process may have done so.
        aside = folder.with_name(f"{folder.name}.damaged-{os.getpid()}")
        with suppress(FileNotFoundError):
            folder.rename(aside)
        shutil.rmtree(aside, ignore_errors=True)
        module.unload()  # a failure is remembered otherwise
        wp.load_module(module, device, max_workers=0)
    except OSError as error:
        raise SceneError(
            f"Warp's folder of compiled kernels, {wp.config.kernel_cache_dir}, cannot be used ({error}); repair or "
            "remove it, or name another one in the environment variable WARP_CACHE_PATH"
        ) from error
    except Exception as error:
        if not there:
            raise
        raise SceneError(
            f"the kernel {kernel.key} in {folder} was damaged and does not load when compiled anew either "
            f"({str(error).splitlines()[0]}); remove {wp.config.kernel_cache_dir} and try again"
        ) from error


# --- Kernels that work for one scene or, in one launch, for many ----------------------------------------
# What a scene asks of the device is a fixed order of kernels with fixed arguments. Where several scenes ask for
# the same kernels, one launch of each serves them all: a table holds every scene's arguments, and thread (s, i)
# does in scene s what thread i does where the scene is alone. Each scene keeps arrays, sizes, a material and a
# time step of its own.


class SceneKernel:
    """The two kernels made of one function, as a decorator of it.

    `body` is what thread i does; i is its first argument, the others are the kernel's.
    """

    def __init__(self, body: Callable, module_options: dict[str, Any] | None = None) -> None:
        _, *arguments = inspect.get_annotations(body).items()
        self.name = body.__name__
        self._types = dict(arguments)
        self._body, self._options = body, module_options
        self._function = wp.func(body)

    @cached_property
    def alone(self) -> wp.Kernel:
        """Over the items of one scene, with the function's arguments."""
        return self._kernel("", self._arguments, f"one_item(wp.tid(), {', '.join(self._types)})")

    @cached_property
    def part(self) -> wp.Kernel:
        """Over the items from `first` on, with the function's arguments."""
        line = f"one_item(first + wp.tid(), {', '.join(self._types)})"
        return self._kernel("_part", f"first: int, {self._arguments}", line)

    @cached_property
    def together(self) -> wp.Kernel:
        """Over (scenes, items); `counts` are the scenes' items, and a scene with no more than `step` steps to do is
        left as it is."""
        return self._kernel(
            "_together",
            "table: wp.array(dtype=row), counts: wp.array(dtype=int), steps: wp.array(dtype=int), step: int",
            "s, i = wp.tid()",
            "if i < counts[s] and step < steps[s]:",
            f"    one_item(i, {', '.join(f'table[s].{name}' for name in self._types)})",
        )

    @property
    def row(self) -> Any:
        """Struct of one scene's arguments in the table of `together`."""
        # Not the one made below: where Warp has met the same text and types before, it gives the kernel it made then.
        return self.together.adj.arg_types["table"].dtype

    @property
    def _arguments(self) -> str:
        return ", ".join(f"{name}: types[{name!r}]" for name in self._types)

    def _kernel(self, ending: str, arguments: str, *lines: str) -> wp.Kernel:
        # Warp translates a kernel's text. This one stands in no file, so Python has to be told of it.
        name = self.name + ending
        text = "\n    ".join((f"def {name}({arguments}):", *lines)) + "\n"
        file = f"<{self._body.__module__}.{self._body.__qualname__}{ending} {id(self)}>"
        linecache.cache[file] = len(text), None, text.splitlines(keepends=True), file
        names: dict[str, Any] = {"wp": wp, "one_item": self._function, "types": self._types}
        names["__name__"] = self._body.__module__
        if "table" in arguments:
            names["row"] = wp.struct(type(f"{self.name}_row", (), {"__annotations__": self._types}))
        exec(compile(text, file, "exec"), names)
        function: Any = names[name]
        function.__qualname__ = self._body.__qualname__ + ending
        return wp.kernel(function, module="unique", enable_backward=False, module_options=self._options)


@dataclass(frozen=True, eq=False)
class Launch:
    """A kernel over the items of one scene."""

    kernel: SceneKernel
    count: int
    arguments: Sequence[Any]
    """Of the kernel's function, without its first. Arrays keep their place and numbers their value."""
    device: wp.Device
    first: int | None = None
    """Of the items, where they are a part of the scene's."""

    @cached_property
    def recorded(self) -> wp.Launch:
        """The launch, with the kernel loaded, which compiles it the first time."""
        kernel, arguments = self.kernel.alone, list(self.arguments)
        if self.first is not None:
            kernel, arguments = self.kernel.part, [self.first, *arguments]
        load_kernel(kernel, self.device)
        return wp.launch(kernel, self.count, arguments, device=self.device, record_cmd=True)

    def launch(self, step: int = 0) -> None:
        """Run it, whatever the number of the step."""
        self.recorded.launch()


@dataclass(frozen=True, eq=False)
class SideBySide:
    """What threads do at the same time: launches for each of them, in order. None writes what another one uses."""

    launches: Sequence[Sequence[Launch]]
    owned: str
    """What a thread's launches use of what others write in the next ones over the same: nothing. So none waits for the
    others before those; empty: they wait."""

    @property
    def kernel(self) -> tuple[SceneKernel, ...]:
        """Those of a thread."""
        return tuple(launch.kernel for launch in self.launches[0])


@dataclass(frozen=True)
class Threads:
    """Shares work among so many threads of a CPU."""

    count: int
    device: wp.Device

    def share(
        self,
        items: int,
        *calls: tuple[SceneKernel, Sequence[Any]],
        owned: str = "",
        alone: Sequence[Launch] = (),
    ) -> list[Launch | SideBySide]:
        """Launches of kernels with their arguments, in order, over the same items, of which each thread takes a part.

        An argument that is a list has an entry for each thread: what a kernel adds up at places that another thread
        adds to as well. The first thread does what is `alone` before its part.
        """

        def arguments(given: Sequence[Any], thread: int) -> list[Any]:
            return [one[thread] if isinstance(one, list) else one for one in given]

        if self.count == 1:
            return [
                *alone,
                *(Launch(kernel, items, arguments(given, 0), self.device) for kernel, given in calls),
            ]
        ends = np.linspace(0, items, self.count + 1).astype(int).tolist()
        launches = [
            [
                Launch(kernel, end - first, arguments(given, thread), self.device, first)
                for kernel, given in calls
                if end > first
            ]
            for thread, (first, end) in enumerate(pairwise(ends))
        ]
        return [SideBySide([[*alone, *launches[0]], *launches[1:]], owned)]

    def copies(self, array: wp.array) -> list[wp.array]:
        """The array for the first thread, and one of zeros like it for each of the others."""
        return [array, *(wp.zeros_like(array) for _ in range(1, self.count))]


class BatchedLaunch:
    """The same kernel over the items of several scenes, a launch of each; `steps` are what each has to do."""

    def __init__(self, launches: Sequence[Launch], steps: wp.array) -> None:
        self._launches = launches  # they hold the arrays that the table points to
        kernel, device, rows = launches[0].kernel, launches[0].device, []
        for launch in launches:
            rows.append(kernel.row())
            for name, value in zip(kernel.row.vars, launch.arguments, strict=True):
                setattr(rows[-1], name, value)
        counts = [launch.count for launch in launches]
        inputs: list[Any] = [wp.array(rows, dtype=kernel.row, device=device)]
        inputs += [wp.array(counts, dtype=int, device=device), steps, 0]
        load_kernel(kernel.together, device)
        size = len(launches), max(counts)
        self._recorded = wp.launch(kernel.together, size, inputs, device=device, record_cmd=True)

    def launch(self, step: int = 0) -> None:
        """Run it for the scenes that have more than `step` steps to do."""
        self._recorded.set_param_by_name("step", step)
        self._recorded.launch()


# --- What scenes ask of the device, done for all of them at once ----------------------------------------


@dataclass(frozen=True, eq=False)
class Program:
    """What a scene lets the device do: `begin`, then `step` as often as it asks, then `end`."""

    begin: Sequence[Launch | SideBySide]
    step: Sequence[Launch | SideBySide] = ()
    end: Sequence[Launch | SideBySide] = ()

    @cached_property
    def kernels(self) -> tuple[tuple[object, ...], ...]:
        """Programs that have the same can run as one."""
        return tuple(tuple(launch.kernel for launch in part) for part in (self.begin, self.step, self.end))


@dataclass
class Job:
    """What a scene asks of the device: a program and the number of its steps. With none of them its kernels are loaded
    and nothing runs."""

    program: Program
    steps: int
    shared_by: int = 1
    """How many scenes had a job at the same time; known afterwards."""


def captures(device: wp.Device) -> bool:
    """Whether launches are captured as a graph. Warp can do that on a CPU, too, which tests make use of."""
    return device.is_cuda


class _Batch:
    """Programs of the same kernels as one; on a GPU the whole of it is one CUDA graph."""

    def __init__(self, programs: Sequence[Program], device: wp.Device) -> None:
        self.programs, self._device = programs, device
        self._steps = wp.zeros(len(programs), dtype=int, device=device)
        self._graphs: dict[int, wp.Graph] = {}
        self._begin = self._serving([p.begin for p in programs])
        self._step = self._serving([p.step for p in programs])
        self._end = self._serving([p.end for p in programs])
        shared = [item for item in (*self._begin, *self._step, *self._end) if isinstance(item, SideBySide)]
        self._threads = max((len(item.launches) for item in shared), default=1)

    def _serving(
        self, parts: Sequence[Sequence[Launch | SideBySide]]
    ) -> list[Launch | SideBySide | BatchedLaunch]:
        """What runs in place of the programs' launches, in order."""
        if len(parts) == 1:
            for item in parts[0]:
                for launch in chain(*item.launches) if isinstance(item, SideBySide) else [item]:
                    _ = launch.recorded
            return list(parts[0])
        groups = list(zip(*parts, strict=True))
        batched = {group: BatchedLaunch(group, self._steps) for group in dict.fromkeys(groups)}
        return [batched[group] for group in groups]

    def run(self, steps: Sequence[int]) -> None:
        """Do so many steps of each program."""
        most = max(steps)
        if most == 0:
            return
        if len(steps) > 1:
            self._steps.assign(np.array(steps, dtype=np.int32))
        if not captures(self._device):
            self._launch(most)
            return
        if most not in self._graphs:
            with wp.ScopedCapture(device=self._device) as capture:
                self._launch(most)
            self._graphs[most] = capture.graph
        wp.capture_launch(self._graphs[most])

    def _launch(self, steps: int) -> None:
        order = [(item, 0) for item in self._begin]
        order += [(item, step) for step in range(steps) for item in self._step]
        order += [(item, 0) for item in self._end]
        run_side_by_side(order, self._threads)


def run_side_by_side(order: Sequence[tuple[Launch | SideBySide | BatchedLaunch, int]], threads: int) -> None:
    """Runs items, each with the number of its step, in order; the caller's thread does what is not shared."""
    barrier = threading.Barrier(threads)

    def go(thread: int) -> None:
        before: str | None = None
        try:
            for item, step in order:
                owned = item.owned if isinstance(item, SideBySide) else None
                if before != owned or owned == "":
                    barrier.wait()
                before = owned
                if isinstance(item, SideBySide):
                    for launch in item.launches[thread]:
                        launch.launch()
                elif thread == 0:
                    item.launch(step)
        except threading.BrokenBarrierError:
            pass  # another thread has the error
        except BaseException:
            barrier.abort()
            raise

    if threads == 1:
        go(0)
        return
    with ThreadPoolExecutor(threads - 1) as pool:
        others = [pool.submit(go, thread) for thread in range(1, threads)]
        go(0)
    for other in others:
        other.result()


class Executor:
    """Runs jobs on the device on which their arrays lie."""

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._batches: dict[object, _Batch] = {}  # kernels → the programs that last asked for them

    def run(self, jobs: Sequence[Job]) -> None:
        """Run jobs that do not touch each other's arrays, those of the same kernels together."""
        alike: dict[object, list[Job]] = {}
        for job in jobs:
            job.shared_by = len(jobs)
            alike.setdefault(job.program.kernels, []).append(job)
        for kernels, group in alike.items():
            programs = [job.program for job in group]
            batch = self._batches.get(kernels)
            if batch is None or batch.programs != programs:
                batch = self._batches[kernels] = _Batch(programs, self._device)
            batch.run([job.steps for job in group])


def run_concurrently(
    tasks: Iterable[Generator[Any, None, None]], at_once: int, device: str
) -> Iterator[tuple[int, Any]]:
    """Advances `at_once` of the generators side by side, the next one as soon as one has ended.

    Yields:
        A task's number and what it yielded, unless that was a job. Jobs are run when all tasks have asked for one.
    """
    executor = Executor(find_device(device))
    waiting = enumerate(tasks)
    running = list(islice(waiting, at_once))
    try:
        while running:
            jobs: list[Job] = []
            while len(jobs) < len(running):
                place = len(jobs)
                number, task = running[place]
                item = next(task, None)
                if isinstance(item, Job):
                    jobs.append(item)
                elif item is not None:
                    yield number, item
                else:
                    running[place : place + 1] = islice(waiting, 1)
            executor.run(jobs)
    finally:
        for _, task in running:
            task.close()
