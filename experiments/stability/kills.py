"""Kill commands at random moments, repeat them, and compare what comes out with what an undisturbed command makes.

    python experiments/stability/kills.py [--kills 20] [--seed 0] [--table kills.csv] [simulate reduce train ...]

Each command runs in a process of its own, which is killed (SIGKILL), once to three times in a row; then it runs to its
end, the result is compared bit for bit with that of the undisturbed command, and it begins anew in an empty folder,
until it has been killed often enough. After each kill, what is on disk under its final name is read through.

Half of the kills come after a random share of the undisturbed command's time, all shares alike. The clock is the
processor time of the command and its worker processes, so that a busy machine does not move them all into the start;
of a campaign, half of them hit a worker process.
The other half come at a random one of the calls that make a file whole, `os.fsync` and `os.replace`, just before or
just after it: a network's checkpoint is written in milliseconds, which no random time would meet. (A campaign's files
are written by its workers, for minutes: there all kills come by the clock.)
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import logging
import mmap
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
import types
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from sgns import cli
from sgns.config import UserError
from sgns.data.check import check_run
from sgns.data.run import Run
from sgns.model.checkpoint import load_surrogate, read_checkpoint
from sgns.reduction.basis import Basis
from sgns.reduction.reduce import read_reduced

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

from common import write_rows

log = logging.getLogger(__name__)

BED = """scene.bed.size=[0.4,0.2,0.16] scene.bed.spacing=0.04
    scene.blade.length=0.1 scene.blade.width=0.1 scene.blade.thickness=0.08"""
MODES = "reduction.max_modes=24 reduction.num_modes=8 output={folder}"
ROLLOUT = f"""rollout scene=quick_excavation {BED} scene.rake=15.0 scene.speed=0.003 scene.duration=60.0
    checkpoint={{checkpoint}} output={{folder}}/rollout.h5"""
COMMANDS = {
    "simulate": f"""simulate dataset=quick dataset.path={{data}} {BED} scene.speed=0.04 scene.duration=2.0
        dataset.draw=[{{rake:[0.0,10.0,20.0],depth:[0.02,0.04]}}] dataset.runs=4""",
    "reduce": f"reduce dataset.path={{data}} {MODES}",
    "train": f"""train dataset.path={{data}} {MODES} model.hidden_width=16 model.message_passing_steps=1
        training.max_steps=100 training.validate_every=20 training.warmup_steps=10 training.threads=1""",
    "train polynomial": f"train dataset.path={{data}} model=polynomial {MODES} training.threads=1",
    "rollout": ROLLOUT,
    "rollout polynomial": ROLLOUT,
}
TRAINED = {"rollout": "train", "rollout polynomial": "train polynomial"}
"""Which training makes the checkpoint that a rollout needs."""


@dataclass
class Row:
    """What happened to one command; numbers of kills and of files."""

    command: str
    kills: int = 0
    """SIGKILLs that hit a running process."""
    while_writing: int = 0  # of them, with a hidden half of a file left
    at_a_write: int = 0  # of them, at a call of `os.fsync` or `os.replace` and not by the clock
    of_workers: int = 0  # of them, a campaign's worker process was hit
    corrupt: int = 0
    """Files under their final name that were not whole."""
    completed: int = 0
    """Times that the command was complete at last, each after some kills."""
    equal: int = 0
    """Those of them whose result was that of the undisturbed command, bit for bit."""
    orphans: int = 0
    """Processes that outlived the command by more than half a minute."""
    leftovers: int = 0
    """Hidden files beside a complete result."""
    undisturbed_s: float = 0.0
    """Processor time of the undisturbed command, the imports of its first process left out [s]."""

    @property
    def nothing_lost(self) -> bool:
        """Whether the command came through."""
        return self.equal == self.completed > 0 and self.corrupt == self.orphans == self.leftovers == 0


def main() -> int:
    """Kill, repeat, compare; returns 0 if nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commands", nargs="*", help=f"of {', '.join(COMMANDS)}; all of them by default")
    parser.add_argument("--kills", type=int, default=20, help="of each command, at least")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--data", type=Path, help="dataset for reduce and train in place of that of simulate")
    parser.add_argument("--table", type=Path, default=Path(__file__).with_name("kills.csv"))
    asked = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    torch.set_num_threads(1)
    for line in COMMANDS.values():  # here, so that no time of the commands goes into imports
        importlib.import_module(cli.COMMANDS[line.split()[0]].module)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="sgns_kills_") as name:
        bench = Bench(Path(name), asked.data)
        for command in asked.commands or COMMANDS:
            chance = np.random.default_rng([asked.seed, list(COMMANDS).index(command)])
            rows.append(bench.killed_often(command, asked.kills, chance))
            write_rows(asked.table, map(asdict, rows))
            log.info("%s", rows[-1])
    return int(not all(row.nothing_lost for row in rows))


class Bench:
    """Undisturbed results of all commands, each made when first needed, and room for disturbed ones."""

    def __init__(self, folder: Path, data: Path | None = None) -> None:
        self.folder = folder
        self.data = data
        self.seconds: dict[str, float] = {}
        """Processor time of each undisturbed command [s]."""
        self.writes: dict[str, int] = {}
        """Moments at its calls of `os.fsync` and `os.replace`: before and after each."""

    def killed_often(self, command: str, kills: int, chance: np.random.Generator) -> Row:
        """Kill the command again and again."""
        reference = self.undisturbed(command)
        row, folder = Row(command, undisturbed_s=round(self.seconds[command], 2)), self.folder / "killed"
        while row.kills < kills:
            for _ in range(chance.integers(1, 4)):
                if not self.killed(row, folder, chance):
                    break
            else:
                begun = self.begin(command, folder)
                begun.ended(0)
                row.orphans += outlived(begun.family)
            row.completed += 1
            row.equal += same(reference, folder)
            row.leftovers += sum(path.name.startswith(".") for path in folder.rglob("*") if path.is_file())
            shutil.rmtree(folder)
        return row

    def killed(self, row: Row, folder: Path, chance: np.random.Generator) -> bool:
        """Begin the command and kill it; says whether it was hit, or complete before."""
        self.give(row.command, folder)
        moments = self.writes[row.command] if row.command != "simulate" else 0
        if moments and chance.integers(2):
            begun = self.begin(row.command, folder, fatal=int(chance.integers(moments)))
            hit = begun.ended(-signal.SIGKILL, 0) != 0
            row.at_a_write += hit
        else:
            begun = self.begin(row.command, folder)
            of_worker = row.command == "simulate" and bool(chance.integers(2))
            target = begun.kill_after(chance.uniform(0.0, self.seconds[row.command]), of_worker)
            hit = target is not None
            row.of_workers += target == "worker"
        row.orphans += outlived(begun.family)
        wrong = broken(folder)
        row.corrupt += len(wrong)
        for line in wrong:
            log.info("%s: %s", row.command, line)
        row.kills += hit
        row.while_writing += hit and any(folder.rglob("*.partial"))
        return hit

    def undisturbed(self, command: str) -> Path:
        """Folder of the result of the undisturbed command."""
        folder = self.folder / command.replace(" ", "_")
        if command not in self.seconds:
            self.give(command, folder)
            begun = self.begin(command, folder)
            begun.ended(0)
            self.seconds[command], self.writes[command] = begun.spent, begun.writes
        return folder

    def give(self, command: str, folder: Path) -> None:
        """Put the dataset there, beside which the reduced runs go."""
        folder.mkdir(parents=True, exist_ok=True)
        if "dataset.path={data}" in COMMANDS[command] and command != "simulate":
            source = self.data or self.undisturbed("simulate") / "data"
            if not (folder / "data").exists():
                shutil.copytree(source, folder / "data")

    def begin(self, command: str, folder: Path, fatal: int | None = None) -> Begun:
        """Begin a command with its result in `folder`; a checkpoint is that of the undisturbed training."""
        places = {"folder": folder, "data": folder / "data", "checkpoint": ""}
        if command in TRAINED:
            places["checkpoint"] = self.undisturbed(TRAINED[command]) / "best.ckpt"
        arguments = COMMANDS[command].split()
        for name, place in places.items():
            arguments = [argument.replace(f"{{{name}}}", str(place)) for argument in arguments]
        return Begun(arguments, self.folder / "log.txt", fatal)


class Begun:
    """A command in a process of its own, made by a fork so that no time goes into imports.

    Args:
        arguments: Of `sgns`.
        log: Where its words go.
        fatal: Which moment at a write ends it; None: none.
    """

    def __init__(self, arguments: list[str], log: Path, fatal: int | None = None) -> None:
        self.log = log
        self.family: set[int] = set()
        """The process and all its descendants that were seen."""
        self.spent = 0.0
        """Processor time of them all [s]."""
        self.status: int | None = None
        self._shared = np.frombuffer(mmap.mmap(-1, 8), np.int64)
        self.pid = os.fork()
        if self.pid == 0:
            self._be(arguments, fatal)

    @property
    def writes(self) -> int:
        """Moments at writes that have passed."""
        return int(self._shared[0])

    def _be(self, arguments: list[str], fatal: int | None) -> None:
        status = 1
        try:
            with self.log.open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            sys.argv = ["sgns", *arguments]
            # So that worker processes begin as those of `python -m sgns` do, without this file and its imports.
            sys.modules["__main__"] = types.ModuleType("__main__")
            sys.modules["__main__"].__spec__ = importlib.util.find_spec("sgns.__main__")
            for name in ("fsync", "replace"):
                setattr(os, name, self._counted(getattr(os, name), fatal))
            status = cli.main()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)

    def _counted(self, write: Callable[..., Any], fatal: int | None) -> Callable[..., Any]:
        def moment() -> None:
            if self.writes == fatal:
                os.kill(os.getpid(), signal.SIGKILL)
            self._shared[0] += 1

        def counted(*args: Any, **settings: Any) -> Any:
            moment()
            result = write(*args, **settings)
            moment()
            return result

        return counted

    def running(self) -> bool:
        """Whether the process is still there."""
        alive = {self.pid, *descendants(self.pid)}
        self.family |= alive
        self.spent = max(self.spent, sum(map(processor_time, alive)))
        if self.status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.status = os.waitstatus_to_exitcode(status)
        return self.status is None

    def kill_after(self, seconds: float, worker: bool) -> str | None:
        """Kill the command or one of its worker processes; says which was hit, None if it ended by itself before.

        Args:
            seconds: Of processor time.
            worker: Whether to kill a worker process if there is one.
        """
        while self.running() and self.spent < seconds:
            time.sleep(0.005)
        if self.status is None:
            workers = [pid for pid in descendants(self.pid) if "spawn_main" in command_line(pid)]
            hit = "worker" if worker and workers else "command"
            os.kill(workers[0] if hit == "worker" else self.pid, signal.SIGKILL)
            # A command whose worker was killed ends by itself.
            if self.ended(-signal.SIGKILL, 2, 0) != 0:
                return hit
        self.ended(0)  # there was nothing left to do
        return None

    def ended(self, *allowed: int) -> int:
        """Wait until the command ends, with one of these statuses; returns which."""
        while self.running():
            time.sleep(0.005)
        if self.status not in allowed:
            raise RuntimeError(f"ended with {self.status}: {self.log.read_text()}")
        return self.status


def outlived(family: set[int], most: float = 30.0) -> int:
    """How many processes are still there after `most` seconds."""
    end = time.perf_counter() + most
    while (alive := [pid for pid in family if is_running(pid)]) and time.perf_counter() < end:
        time.sleep(0.02)
    for pid in alive:
        os.kill(pid, signal.SIGKILL)
    return len(alive)


def descendants(pid: int) -> list[int]:
    """Numbers of a process's children and their children."""
    try:
        children = [int(n) for n in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []
    return [one for child in children for one in (child, *descendants(child))]


def command_line(pid: int) -> str:
    """Command line of a process; empty if it is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


def processor_time(pid: int) -> float:
    """Of a process and its children that have ended [s]; 0 if it is gone."""
    try:
        times = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:15]
    except OSError:
        return 0.0
    return sum(map(int, times)) / os.sysconf("SC_CLK_TCK")


def is_running(pid: int) -> bool:
    """Whether a process is there and not only waits for its end to be noticed."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def results(folder: Path) -> Iterator[tuple[Path, Callable[[Path], Any]]]:
    """Files under their final names, each with its reader: what it gives must be the same every time."""
    for path in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.is_file() and not hidden and path.suffix in READERS:
            yield path, READERS[path.suffix]
        elif path.name == "dataset.yaml":
            yield path, Path.read_bytes


def broken(folder: Path) -> list[str]:
    """What is wrong with the files that a command left under their final names."""
    wrong = []
    for path, read in results(folder):
        try:
            read(path)
        except (UserError, OSError, KeyError, ValueError) as error:
            wrong.append(f"{path}: {error}")
    return wrong


def same(folder: Path, other: Path) -> bool:
    """Whether two complete results hold the same, times of the clock left out."""
    one, two = ({path.relative_to(top): read(path) for path, read in results(top)} for top in (folder, other))
    if one.keys() != two.keys():
        log.info("different files: %s", sorted(map(str, one.keys() ^ two.keys())))
    different = [str(name) for name in one.keys() & two.keys() if one[name] != two[name]]
    if different:
        log.info("different: %s", sorted(different))
    return one.keys() == two.keys() and not different


def read_hdf5(path: Path) -> Any:
    """Content of a run, a reduced run or a basis; runs are checked through."""
    with h5py.File(path) as file:
        kind = file.attrs["format"]
    if kind == b"sgns-run":
        if problems := check_run(path):
            raise ValueError("; ".join(problems))
        with Run(path) as run:
            return run.content_hash, run.scene
    if kind == "sgns-basis":
        return {key: as_bytes(value) for key, value in Basis.load(path).state().items()}
    return {key: as_bytes(value) for key, value in asdict(read_reduced(path)).items()}


def read_tensors(path: Path) -> Any:
    """Everything in a checkpoint that a training goes on from; polynomials have the first two."""
    load_surrogate(path)
    content = read_checkpoint(path)
    kept = ("state_dict", "hyper_parameters", "optimizer_states", "lr_schedulers", "global_step", "callbacks")
    return {key: as_bytes(content[key]) for key in kept if key in content}


def read_json(path: Path) -> Any:
    """Values of a training.json but its time."""
    return {key: value for key, value in json.loads(path.read_text()).items() if key != "seconds"}


READERS: dict[str, Callable[[Path], Any]] = {
    ".h5": read_hdf5,
    ".ckpt": read_tensors,
    ".json": read_json,
    ".csv": Path.read_bytes,
}


def as_bytes(value: Any) -> Any:
    """Plain values whose comparison is bit for bit."""
    if isinstance(value, torch.Tensor):
        value = value.numpy()
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: as_bytes(one) for key, one in value.items()}
    return [as_bytes(one) for one in value] if isinstance(value, (list, tuple)) else value


if __name__ == "__main__":
    sys.exit(main())
