"""The page of `sgns view` in a real browser."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sgns.data.run import Run
from sgns.model.checkpoint import load_surrogate, pretrained_file
from sgns.simulator import Simulator
from sgns.view.server import serve
from sgns.view.shown import Drive, Replay
from sgns_testing.browser import CHROMIUM, Tab, chromium
from sgns_testing.runs import make_run

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")

PHONE = (390, 844, True)


def opened(
    make: Callable[[], Drive | Replay], output: Path, look: Callable[[Tab, str], Awaitable[None]]
) -> None:
    """Open the page in a browser, look at it, and see that nothing was wrong or came from elsewhere."""

    async def test() -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        task = asyncio.create_task(serve(make, output, port))
        try:
            async with chromium() as tab:
                await tab.size(1280, 800)
                await tab.go(f"http://127.0.0.1:{port}/")
                await tab.until("document.querySelector('#colours :checked') !== null")
                await look(tab, f"http://127.0.0.1:{port}/")
                assert tab.said == []
                assert all(f"//127.0.0.1:{port}/" in one or one.startswith("data:") for one in tab.requests)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    asyncio.run(asyncio.wait_for(test(), 100))


async def slid(tab: Tab, name: str, value: float) -> None:
    """Move a slider."""
    await tab.eval(
        f"(() => {{ const one = document.querySelector('#{name}'); one.value = {value};"
        " one.dispatchEvent(new Event('input')); })()"
    )


async def text(tab: Tab, name: str) -> str:
    found = await tab.eval(f"document.querySelector('#{name}').textContent")
    return found.replace("\N{MINUS SIGN}", "-")


async def fits(tab: Tab) -> bool:
    """Whether nothing is wider than the screen."""
    return await tab.eval("document.documentElement.scrollWidth <= window.innerWidth")


async def drawn(tab: Tab) -> None:
    """Wait until what came last is on the screen."""
    await tab.eval("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")
    await tab.eval("new Promise((done) => setTimeout(() => requestAnimationFrame(() => done(1)), 100))")


@pytest.mark.long
def test_a_tool_is_driven_and_its_force_is_read(tmp_path: Path) -> None:
    async def look(tab: Tab, address: str) -> None:
        await tab.until("!document.querySelector('#clock').textContent.startsWith('0.0')")
        await tab.key("KeyV", "v", True)
        await tab.key("KeyV", "v", False)
        await slid(tab, "slider-depth", 0.04)
        await tab.key("ArrowRight", "ArrowRight", True)
        await tab.until("Number(document.querySelector('#force0').textContent) > 20", 40)
        await tab.key("ArrowRight", "ArrowRight", False)
        await tab.key("Space", " ", True)
        await tab.key("Space", " ", False)
        await tab.until("document.querySelector('#pace').textContent === 'paused'")
        await drawn(tab)
        draft, vertical = float(await text(tab, "force0")), float(await text(tab, "force2"))
        await tab.key("KeyV", "v", True)
        await tab.key("KeyV", "v", False)
        await tab.until("document.querySelector('#said').textContent.startsWith('recorded')")
        with Run(tmp_path / "view.h5") as run:
            sim = Simulator.pretrained("excavation")
            sim.reset(run.pose[0])
            for pose in run.pose[1:]:
                state = sim.step(pose)
        assert (draft, vertical) == pytest.approx((-state.force[0], state.force[2]), abs=0.6)  # whole newtons
        assert run.frame_count > 30 and state.pose[0] > 0.1
        seen = await tab.eval(
            "(() => { const one = document.querySelector('#soil'), pen = document.createElement('canvas')"
            ".getContext('2d'); pen.drawImage(one, 0, 0, 60, 40); return one.width; })()"
        )
        assert seen > 300
        # Out of the training range: a red frame that says why.
        await slid(tab, "slider-speed", 0.2)
        await tab.key("Space", " ", True)
        await tab.key("Space", " ", False)
        await tab.key("ArrowLeft", "ArrowLeft", True)
        await tab.until("document.body.classList.contains('outside')")
        assert "outside the training range: " in await text(tab, "words")
        await tab.key("ArrowLeft", "ArrowLeft", False)
        await tab.key("KeyR", "r", True)
        await tab.key("KeyR", "r", False)
        await tab.until("!document.body.classList.contains('outside')")
        await tab.key("KeyP", "p", True)  # cuts by itself
        await tab.key("KeyP", "p", False)
        await tab.until("Number(document.querySelector('#depth').textContent) > 5", 40)
        await tab.size(*PHONE)
        assert await fits(tab)

    opened(partial(Drive, load_surrogate(pretrained_file("excavation"))), tmp_path / "view.h5", look)


def test_two_runs_are_shown_beside_each_other(tmp_path: Path) -> None:
    names = [make_run(tmp_path / f"{i}.h5", n=60, seed=i, producer=("mpm", "rollout")[i]) for i in (0, 1)]

    async def look(tab: Tab, address: str) -> None:
        assert await tab.eval("document.querySelector('#colours :checked').value") == "error"
        assert "simulated (MPM)" in await text(tab, "names") and "network (dashed)" in await text(
            tab, "names"
        )
        await slid(tab, "when", 7)
        await tab.until("document.querySelector('#now').textContent.startsWith('0.12')")
        shown = [float(one) for one in (await text(tab, "force0")).split(" / ")]
        assert shown == pytest.approx([-run.force[7, 0] for run in runs], abs=0.06)
        assert await fits(tab)
        await tab.size(*PHONE)
        assert await fits(tab)

    with Run(names[0]) as one, Run(names[1]) as other:
        runs = one, other
        opened(partial(Replay, *runs), tmp_path / "view.h5", look)
        assert np.abs(one.force[7] - other.force[7]).max() > 0.1
