"""What scenes ask of the device, done for all of them at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from .launches import Launch, SceneKernel, Together

__all__ = ["Program", "Work", "Worker"]


@dataclass(frozen=True, eq=False)
class Program:
    """What a scene lets the device do: `begin`, then `step` as often as it asks, then `end`."""

    begin: Sequence[Launch]
    step: Sequence[Launch] = ()
    end: Sequence[Launch] = ()

    @cached_property
    def kernels(self) -> tuple[tuple[SceneKernel, ...], ...]:
        """Programs that have the same can run as one."""
        return tuple(tuple(launch.kernel for launch in part) for part in (self.begin, self.step, self.end))


@dataclass
class Work:
    """A program and the number of its steps; with none of them its kernels are loaded and nothing runs."""

    program: Program
    steps: int
    shared_by: int = 1
    """How many scenes had work done at the same time; known afterwards."""


def captures(device: wp.Device) -> bool:
    """Whether launches are captured as a graph. Warp can do that on a CPU, too, which tests make use of."""
    return device.is_cuda


class _Stack:
    """Programs of the same kernels as one; on a GPU the whole of it is one CUDA graph."""

    def __init__(self, programs: Sequence[Program], device: wp.Device) -> None:
        self.programs, self._device = programs, device
        self._steps = wp.zeros(len(programs), dtype=int, device=device)
        self._graphs: dict[int, wp.Graph] = {}
        self._begin = self._serving([p.begin for p in programs])
        self._step = self._serving([p.step for p in programs])
        self._end = self._serving([p.end for p in programs])

    def _serving(self, parts: Sequence[Sequence[Launch]]) -> list[Launch | Together]:
        """What runs in place of the programs' launches, in order."""
        if len(parts) == 1:
            for launch in parts[0]:
                launch.load()
            return list(parts[0])
        made: dict[tuple[Launch, ...], Together] = {}
        for launches in zip(*parts, strict=True):
            if launches not in made:
                made[launches] = Together(launches, self._steps)
        return [made[launches] for launches in zip(*parts, strict=True)]

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
        for launch in self._begin:
            launch.launch()
        for step in range(steps):
            for launch in self._step:
                launch.launch(step)
        for launch in self._end:
            launch.launch()


class Worker:
    """Has a device do what scenes ask for.

    Args:
        device: on which their arrays lie.
    """

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._stacks: dict[object, _Stack] = {}  # kernels → the programs that last asked for them

    def do(self, works: Sequence[Work]) -> None:
        """Do works that do not touch each other's arrays, those of the same kernels together."""
        alike: dict[object, list[Work]] = {}
        for work in works:
            work.shared_by = len(works)
            alike.setdefault(work.program.kernels, []).append(work)
        for kernels, group in alike.items():
            programs = [work.program for work in group]
            stack = self._stacks.get(kernels)
            if stack is None or stack.programs != programs:
                stack = self._stacks[kernels] = _Stack(programs, self._device)
            stack.run([work.steps for work in group])
