"""`sgns view` as a program sees it: what is served to whom, what is sent, and what is refused."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest

from sgns.command_settings import View
from sgns.config import UserError
from sgns.data.run import Run
from sgns.model.checkpoint import load_surrogate, pretrained_file
from sgns.simulator import Simulator
from sgns.view import server
from sgns.view.server import FILES, serve
from sgns.view.shown import FIELDS, Drive, Replay
from sgns_testing.commands import refused, sgns
from sgns_testing.runs import make_run


@pytest.fixture(scope="module")
def drive() -> Callable[[], Drive]:
    return partial(Drive, load_surrogate(pretrained_file("excavation")), checkpoint="excavation")


@asynccontextmanager
async def served(make: Callable[[], Any], output: Path) -> AsyncIterator[tuple[aiohttp.ClientSession, str]]:
    """A client of a page that is served on a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    task = asyncio.create_task(serve(make, output, port))
    try:
        async with aiohttp.ClientSession() as client:
            for _ in range(100):
                try:
                    await client.get(f"http://127.0.0.1:{port}/")
                    break
                except aiohttp.ClientConnectorError:
                    await asyncio.sleep(0.02)
            yield client, f"http://127.0.0.1:{port}"
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def run(test: Awaitable[None]) -> None:
    asyncio.run(asyncio.wait_for(test, 60))  # type: ignore[arg-type]


async def told(page: aiohttp.ClientWebSocketResponse, key: str) -> dict[str, Any]:
    """The next message in words that has a key."""
    while True:
        message = await page.receive(20)
        assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY), message
        if message.type == aiohttp.WSMsgType.TEXT and key in (found := json.loads(message.data)):
            return found


async def numbers(page: aiohttp.ClientWebSocketResponse) -> dict[str, float]:
    """The next frame's numbers."""
    while (message := await page.receive(20)).type != aiohttp.WSMsgType.BINARY:
        pass
    assert len(message.data) <= 204  # docs/guides/view.md says how little a frame of 8 modes is
    return dict(zip(FIELDS, np.frombuffer(message.data, "<f4").tolist(), strict=False))


def test_only_the_named_files_are_served_and_only_to_its_own_page(tmp_path: Path, drive: Any) -> None:
    async def test() -> None:
        async with served(drive, tmp_path / "view.h5") as (client, address):
            for path, (name, kind) in FILES.items():
                async with client.get(address + path) as answer:
                    assert (answer.status, answer.content_type) == (200, kind)
                    assert "default-src 'none'" in answer.headers["Content-Security-Policy"], name
            for path in ("/server.py", "/../server.py", "/%2e%2e/settings.py", "/view.h5", "/three.LICENSE"):
                async with client.get(address + path) as answer:
                    assert answer.status == 404
            port = address.rpartition(":")[2]
            for headers in (
                {"Host": "evil.example"},
                {"Host": f"evil.example:{port}"},
                {"Origin": "http://evil.example"},
            ):
                for path in ("/", "/socket"):
                    async with client.get(address + path, headers=headers) as answer:
                        assert answer.status == 403, (path, headers)
                with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                    await client.ws_connect(f"{address}/socket", headers=headers)
            # At the other end of a tunnel the port is another one.
            far = {"Host": "localhost:9000", "Origin": "http://localhost:9000"}
            async with client.ws_connect(f"{address}/socket", headers=far) as page:
                assert (await told(page, "mode"))["mode"] == "drive"

    run(test())


def test_the_page_asks_for_nothing_from_outside() -> None:
    folder = Path(server.__file__).parent
    for name, _ in FILES.values():
        text = (folder / name).read_text(encoding="utf-8").replace("http://www.w3.org/1999/xhtml", "")
        assert "https://" not in text and "http://" not in text, name
    assert sum((folder / name).stat().st_size for name, _ in FILES.values()) < 1_000_000
    assert "MIT" in (folder / "three.LICENSE").read_text(encoding="utf-8")


def test_what_is_driven_is_what_the_simulator_says(tmp_path: Path, drive: Any) -> None:
    async def test() -> None:
        async with (
            served(drive, tmp_path / "view.h5") as (client, address),
            client.ws_connect(f"{address}/socket") as page,
        ):
            about = await told(page, "mode")
            mean, modes, rest, corners = [
                np.frombuffer((await page.receive(20)).data, kind) for kind in ("<f4", "<f2", "<f4", "<f4")
            ]
            sim = Simulator.pretrained("excavation")
            soil = mean.reshape(-1, 3) + modes.reshape(len(mean) // 3, -1) @ rest.reshape(-1, 3)
            assert np.abs(soil - sim.reset().soil()).max() < 2e-4  # half precision
            assert corners.reshape(-1, 3)[:, 2].min() == pytest.approx(-0.1525)
            await page.send_json({"way": 1, "depth": 0.04, "speed": 0.1})
            await page.send_json({"do": "record"})
            await told(page, "paused")
            while (await numbers(page))["recorded"] < 40:
                pass
            await page.send_json({"do": "pause"})
            await told(page, "paused")
            await page.send_json({"do": "record"})
            assert "view.h5: " in (await told(page, "said"))["said"]
            await page.send_json({"do": "reset"})
            first = await numbers(page)
            assert (first["frame"], first["force0"], first["outside"]) == (0.0, 0.0, 0.0)
            assert about["modes"] == 8 and about["scales"]["speed"] == pytest.approx(0.15)

    run(test())
    with Run(tmp_path / "view.h5") as recorded:
        assert recorded.frame_count >= 40 and recorded.producer == "rollout"
        assert (
            recorded.pose[-1, 0] > recorded.pose[0, 0] + 0.02
            and recorded.pose[-1, 2] < recorded.pose[0, 2] - 0.02
        )
        assert recorded.scene["motion"] == "path" and len(recorded.scene["path"]) == recorded.frame_count
        sim, state = Simulator.pretrained("excavation"), None
        sim.reset(recorded.pose[0])
        for pose, force in zip(recorded.pose[1:], recorded.force[1:], strict=True):
            state = sim.step(pose)
            assert np.allclose(state.force, force, rtol=1e-9)
        assert np.linalg.norm(state.force) > 1.0
        assert np.abs(recorded.positions(-1)[0] - state.soil()).max() < 1e-6


def test_a_second_record_gets_a_number(tmp_path: Path) -> None:
    assert server.free_name(tmp_path / "a.h5").name == "a.h5"
    assert server.free_name(tmp_path / "a.h5").name == "a_2.h5"  # the first may not be complete yet
    (tmp_path / "a_3.h5").touch()
    assert server.free_name(tmp_path / "a.h5").name == "a_4.h5"


def test_a_record_of_one_frame_is_lost_in_a_line(tmp_path: Path, drive: Any, caplog: Any) -> None:
    """The page is closed while the clock stands."""

    async def test() -> None:
        async with served(drive, tmp_path / "view.h5") as (client, address):
            async with client.ws_connect(f"{address}/socket") as page:
                for wish in ("pause", "record"):
                    await page.send_json({"do": wish})
                    await told(page, "paused")
            for _ in range(100):
                if caplog.records:
                    break
                await asyncio.sleep(0.02)

    run(test())
    found = [(one.levelname, one.getMessage()) for one in caplog.records if one.levelname != "INFO"]
    assert found == [("WARNING", "the record is lost: nothing was recorded yet: let the clock run first")]


def test_what_a_page_may_not_ask_for_is_said(tmp_path: Path, drive: Any) -> None:
    async def test() -> None:
        async with served(drive, tmp_path / "view.h5") as (client, address):
            async with client.ws_connect(f"{address}/socket") as page:
                for asked, words in (
                    ({"way": "fast"}, "way is 'fast'; it must be a number"),
                    ({"depth": True}, "must be a number"),
                    ({"height": 1.0}, "height is no control; there are way, depth, rake, speed"),
                ):
                    await page.send_json(asked)
                    assert words in (await told(page, "error"))["error"]
                await page.send_json({"depth": 1e9})
                await page.send_json({"do": "pause"})
                assert (await told(page, "wanted"))["wanted"]["depth"] <= 0.15
            for junk in ("[1]", "no", "{" * 10_000):
                async with client.ws_connect(f"{address}/socket") as page:
                    await page.send_str(junk)
                    while not page.closed:
                        await page.receive(20)
                    assert page.close_code in (1003, 1009)

    run(test())
    assert not (tmp_path / "view.h5").exists()


def test_runs_are_sent_frame_by_frame(tmp_path: Path) -> None:
    names = [
        make_run(tmp_path / f"{i}.h5", n=60, seed=i, frames=8 + i, producer=("mpm", "rollout")[i])
        for i in (0, 1)
    ]

    async def test(replay: Replay) -> None:
        async with (
            served(lambda: replay, tmp_path / "view.h5") as (client, address),
            client.ws_connect(f"{address}/socket") as page,
        ):
            about = await told(page, "mode")
            assert about["bed"] == [0.8, 0.6, 0.15] and about["frames"] == 8
            assert about["who"] == ["simulated (MPM)", "network"]
            for _ in range(2 * 3):
                assert (await page.receive(20)).type == aiohttp.WSMsgType.BINARY
            await page.send_json({"frame": 5})
            data = (await page.receive(20)).data
            head, shares = (
                np.frombuffer(data, "<f4", 15),
                np.frombuffer(data, "<u2", offset=60).reshape(2, 60, 4),
            )
            assert head[0] == 5
            for i, run in enumerate(replay.runs):
                low, high, top = head[1 + 7 * i : 4 + 7 * i], head[4 + 7 * i : 7 + 7 * i], head[7 + 7 * i]
                soil = low + (high - low) * (shares[i, :, :3] / 65535)
                assert soil == pytest.approx(run.positions(5)[0], abs=1e-5)
                speed = np.linalg.norm(run.velocities(5)[0], axis=1)
                assert top * shares[i, :, 3] / 65535 == pytest.approx(speed, abs=1e-5)
            await page.send_json({"frame": 8})
            assert (await told(page, "error"))["error"] == "frame is 8; allowed: 0 to 7"

    with Run(names[0]) as one, Run(names[1]) as other:
        run(test(Replay(one, other)))
    with Run(names[0]) as one, Run(make_run(tmp_path / "c.h5", n=61)) as other:
        with pytest.raises(UserError, match="differ in their particles"):
            Replay(one, other)


def test_wrong_settings_are_refused_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "run.h5", n=20)
    assert "nothing to show: give a run file" in refused("view")
    assert "prediction goes with run=" in refused("view", "prediction=run.h5")
    assert "excavate" in refused("view", "checkpoint=excavate")
    assert "a run is a .h5 file: output=a.h5" in refused("view", "checkpoint=excavation", "output=a.csv")
    assert "bed is not the one that" in refused("view", "checkpoint=excavation", "run=run.h5")
    assert "port is 70000; allowed: 0 to 65535" in refused("view", "run.h5", "port=70000")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = refused("view", "run.h5", f"port={port}")
    assert f"port {port} is taken" in line and "port=0 for any that is free" in line
    assert View().port == 8765


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_it_ends_with_ctrl_c(
    tmp_path: Path, number: signal.Signals, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_run(tmp_path / "run.h5", n=20)

    async def interrupted(make: Callable[[], Replay], *given: Any) -> None:
        asyncio.get_running_loop().call_later(0.2, signal.raise_signal, number)
        await serve(make, *given)

    monkeypatch.setattr(server, "serve", interrupted)
    # Whoever runs the tests may ignore Ctrl-C, as a shell does of what it runs in the background.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        done = sgns(tmp_path, "view", "run.h5", "port=0")
    finally:
        signal.signal(signal.SIGINT, before)
    first, *rest = done.stdout.splitlines()
    assert first.startswith("http://127.0.0.1:") and first.endswith("/ shows it; Ctrl-C ends it")
    assert (done.returncode, rest) == (status, ["ended"] if status == 0 else [])
    assert done.stderr == ("" if status == 0 else "sgns view: interrupted; the page is gone\n")
