"""`sgns view`: a page on this machine alone, with a run or with a tool to drive.

Each opened page is told what there is in one message of JSON and one of numbers, then gets frames as numbers. What it
sends is JSON: controls of the tool, or the frame of a run that it wants to see.
"""

from __future__ import annotations

import asyncio
import errno
import itertools
import json
import logging
import signal
import webbrowser
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, suppress
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from aiohttp import WSCloseCode, WSMsgType, web
from matplotlib.colors import to_hex
from omegaconf import DictConfig

from sgns.config import Interrupted, UserError
from sgns.data.files import require_new
from sgns.data.run import Run
from sgns.evaluate.views import ERROR, SPEED
from sgns.model.checkpoint import load_surrogate
from sgns.rollout import single_thread
from sgns.view.shown import Drive, Replay

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
OWN_NAMES = (HOST, "localhost")
"""What a browser on this machine, or at the other end of a tunnel, calls the server."""
FILES = {
    "/": ("page.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/charts.js": ("charts.js", "text/javascript"),
    "/soil.js": ("soil.js", "text/javascript"),
    "/three.js": ("three.js", "text/javascript"),
}
"""All that is served."""
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
}
MOST_HEARD = 1 << 12
"""Bytes of a message from a page."""
BEHIND = 0.25
"""Who is later than this does not catch up: steps then take longer than what they simulate [s]."""


def main(cfg: DictConfig) -> None:
    """Serve the page until Ctrl-C."""
    if cfg.prediction is not None and (cfg.run is None or cfg.checkpoint is not None):
        raise UserError("prediction goes with run=..., the true one, and without checkpoint")
    if cfg.checkpoint is None and cfg.run is None:
        raise UserError(
            "nothing to show: give a run file, as in sgns view run.h5, or a network to drive a tool in, as in "
            "sgns view checkpoint=excavation"
        )
    with ExitStack() as stack, single_thread():
        runs = [stack.enter_context(Run(path)) for path in (cfg.run, cfg.prediction) if path is not None]
        make = maker(cfg, runs)
        make()  # all that can be wrong is found before the address is shown
        try:
            asyncio.run(serve(make, Path(cfg.output), cfg.port, cfg.open))
        except Interrupted as stop:
            if stop.number != signal.SIGINT:
                raise Interrupted(stop.number, "the page is gone") from None
            log.info("ended")


def maker(cfg: DictConfig, runs: list[Run]) -> Callable[[], Drive | Replay]:
    """What makes the soil of a page that is opened: each has its own."""
    if cfg.checkpoint is None:
        return partial(Replay, *runs)
    require_new(Path(cfg.output), True, "a run", ".h5")
    surrogate, run = load_surrogate(cfg.checkpoint), runs[0] if runs else None
    return partial(Drive, surrogate, run, cfg.device, cfg.checkpoint)


async def serve(make: Callable[[], Drive | Replay], output: Path, port: int, show: bool = False) -> None:
    """Answer browsers on this machine until the task is cancelled.

    Raises:
        UserError: The port is taken.
    """
    contents = {
        path: (files("sgns.view").joinpath(name).read_bytes(), kind) for path, (name, kind) in FILES.items()
    }

    @web.middleware
    async def own(request: web.Request, handler: Any) -> web.StreamResponse:
        """Refuse what other pages in the same browser ask for, by their own address or by a name of theirs."""
        origin = request.headers.get("Origin")
        if urlsplit(f"//{request.host}").hostname not in OWN_NAMES:
            raise web.HTTPForbidden(text=f"this page is at http://{HOST}")
        if origin is not None and origin != f"http://{request.host}":
            raise web.HTTPForbidden(text="another page has asked")
        return await handler(request)

    async def file(request: web.Request) -> web.Response:
        content, kind = contents[request.path]
        return web.Response(body=content, content_type=kind, charset="utf-8", headers=HEADERS)

    async def socket(request: web.Request) -> web.WebSocketResponse:
        answer = web.WebSocketResponse(max_msg_size=MOST_HEARD, compress=False)
        await answer.prepare(request)
        shown = make()
        await answer.send_json(shown.about() | {"colours": {"speed": _stops(SPEED), "error": _stops(ERROR)}})
        for array in shown.arrays():
            await answer.send_bytes(array.tobytes())
        await (driven(answer, shown, output) if isinstance(shown, Drive) else replayed(answer, shown))
        return answer

    app = web.Application(middlewares=[own])
    app.add_routes([web.get(path, file) for path in FILES] + [web.get("/socket", socket)])
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        site = web.TCPSite(runner, HOST, port)
        try:
            await site.start()
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
            raise UserError(
                f"port {port} is taken or not yours; choose another, as in port={8766 if port == 8765 else 8765}, or "
                "port=0 for any that is free"
            ) from error
        address = f"http://{HOST}:{runner.addresses[0][1]}/"
        log.info("%s shows it; Ctrl-C ends it", address)
        if show:
            webbrowser.open(address)
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()


async def replayed(socket: web.WebSocketResponse, replay: Replay) -> None:
    """Send the frames of a run that the page asks for."""
    async for asked in heard(socket):
        try:
            await socket.send_bytes(replay.frame(asked.get("frame")))
        except UserError as error:
            await socket.send_json({"error": str(error)})


async def driven(socket: web.WebSocketResponse, drive: Drive, output: Path) -> None:
    """Step the soil with the clock, and do what the page asks for."""
    ticking = asyncio.create_task(tick(socket, drive))
    try:
        async for asked in heard(socket):
            try:
                said = await do(drive, asked, output)
            except UserError as error:
                said = {"error": str(error)}
            if said and not socket.closed:
                await socket.send_json(said)
    finally:
        ticking.cancel()
        with suppress(asyncio.CancelledError, ConnectionError):
            await ticking
        if drive.recording:  # the page was closed meanwhile
            try:
                log.info("recorded %s", drive.write(drive.recorded(output), free_name(output)))
            except UserError as error:  # nobody is left to be told but the terminal
                log.warning("the record is lost: %s", error)


async def tick(socket: web.WebSocketResponse, drive: Drive) -> None:
    """A step every frame of simulated time; the page is sent each."""
    clock, due, outside, left = asyncio.get_running_loop().time, 0.0, "", 0
    shown, recording = None, False
    while not socket.closed:
        if not drive.paused:
            try:
                drive.step()
            except UserError as error:
                drive.pause(True)
                await socket.send_json({"error": f"{error}; reset to go on", "paused": True})
        if shown is not drive.kept[-1] or recording != drive.recording:  # after a reset, too
            shown, recording = drive.kept[-1], drive.recording
            await socket.send_bytes(drive.frame())
        if outside != drive.outside:
            outside = drive.outside
            await socket.send_json({"outside": outside})
        if left != len(drive.controls.plan):  # the tool goes by itself: its sliders follow
            left = len(drive.controls.plan)
            await socket.send_json({"wanted": drive.controls.wanted})
        due = max(due + 1.0 / drive.rate, clock() - BEHIND)
        await asyncio.sleep(max(due - clock(), 0.0))


async def do(drive: Drive, asked: dict[str, Any], output: Path) -> dict[str, Any]:
    """Do what a page asks for; what to say to it.

    Raises:
        UserError: It cannot be done.
    """
    wish = asked.pop("do", None)
    drive.controls.hear(asked)
    if wish == "pause":
        drive.pause(not drive.paused)
    elif wish == "reset":
        drive.reset()
    elif wish == "cut":
        drive.controls.cut_again()
    elif wish == "record" and not drive.recording:
        drive.record()
    elif wish == "record":
        frames = drive.recorded(output)
        return {"said": "recorded " + await asyncio.to_thread(drive.write, frames, free_name(output))}
    return {"paused": drive.paused, "wanted": drive.controls.wanted} if wish else {}


async def heard(socket: web.WebSocketResponse) -> AsyncIterator[dict[str, Any]]:
    """What a page says, until it goes away; one that says something else is sent away."""
    async for message in socket:
        try:
            asked = json.loads(message.data) if message.type == WSMsgType.TEXT else None
        except ValueError:
            asked = None
        if not isinstance(asked, dict):
            await socket.close(code=WSCloseCode.UNSUPPORTED_DATA, message=b"not a JSON object")
            return
        yield asked


_given: set[Path] = set()


def free_name(output: Path) -> Path:
    """The name, or the first with a number after it that no file has and nobody was given."""
    names = (output.with_stem(f"{output.stem}_{n}") if n > 1 else output for n in itertools.count(1))
    name = next(name for name in names if not name.exists() and name not in _given)
    _given.add(name)
    return name


def _stops(colours: Any) -> list[str]:
    return [to_hex(colours(share)) for share in np.linspace(0.0, 1.0, 9)]
