"""Many scenes at once."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from itertools import islice, repeat
from typing import Any

from .effects import Effects
from .launch import Executor, Job, find_device
from .scene import Scene
from .solver import Frame, Solver
from .state import SceneError, SolverStopped


def frames_together(
    scenes: Iterable[Scene],
    effects: Effects | Iterable[Effects] | None = None,
    device: str = "cpu",
    precision: str = "float32",
    at_once: int = 32,
) -> Iterator[tuple[int, Frame | SceneError | SolverStopped]]:
    """Computes scenes side by side, each as a `Solver` of its own would.

        for number, frame in frames_together(scenes, device="cuda"):
            if not isinstance(frame, Frame):
                print(f"scene {number} ended: {frame}")

    It pays on a GPU, which a scene of some ten thousand particles does not fill. Scenes may differ in anything; none
    depends on which others are computed with it. Those of the same effects, walls, contact and precision
    share every launch.

    Args:
        scenes: what to compute.
        effects: which physics, for all of them or one for each.
        device: `cpu` or `cuda`, `cuda:0`, ...
        precision: `float32` or `float64`.
        at_once: scenes that are under way at the same time; the next begins when one ends.

    Yields:
        The number of a scene and its next frame. Frames of one scene come in order, those of different scenes mixed.
        In place of a frame that cannot be computed the error comes, as that scene's last; the others go on.
    """

    def frames(
        scene: Scene, effects: Effects | None
    ) -> Generator[Frame | SceneError | SolverStopped | Job, None, None]:
        try:
            yield from Solver(scene, effects, device, precision).stages()
        except (SceneError, SolverStopped) as error:
            yield error

    each = repeat(effects) if effects is None or isinstance(effects, Effects) else effects
    return all_together(map(frames, scenes, each), at_once, device)


def all_together(
    tasks: Iterable[Generator[Any, None, None]], at_once: int, device: str
) -> Iterator[tuple[int, Any]]:
    """Advances `at_once` generators side by side, the next one as soon as one has ended.

    Args:
        tasks: what to advance; each is taken when its turn comes.
        at_once: how many are under way.
        device: where they compute.

    Yields:
        A task's number and what it yielded, unless that was a job: jobs are run when all tasks have asked for one.
    """
    worker = Executor(find_device(device))
    waiting = enumerate(tasks)
    running = list(islice(waiting, at_once))
    try:
        while running:
            works: list[Job] = []
            while len(works) < len(running):
                place = len(works)
                number, task = running[place]
                item = next(task, None)
                if isinstance(item, Job):
                    works.append(item)
                elif item is not None:
                    yield number, item
                else:
                    running[place : place + 1] = islice(waiting, 1)
            worker.run(works)
    finally:
        for _, task in running:
            task.close()
