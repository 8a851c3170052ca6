"""`make demo`: the whole way once, with the commands a user would type, from scenes to a report."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

OUTPUT = Path("outputs/demo")
CHECKPOINT = OUTPUT / "best.ckpt"
NEW_PATH = OUTPUT / "new_path.h5"
REPORT = OUTPUT / "evaluation" / "report.html"

# A blade path that no run of the dataset contains: its rake, depth and speed are between those of the runs.
NEW_SCENE = ["scene.rake=20", "scene.depth=0.06", "scene.speed=0.12", "scene.motion=curved"]

NEW_ROLLOUT = [
    "rollout",
    "scene=quick_excavation",
    *NEW_SCENE,
    f"checkpoint={CHECKPOINT}",
    f"output={NEW_PATH}",
    "overwrite=true",
]
EVALUATION = [
    "evaluate",
    "dataset=quick",
    f"checkpoint={CHECKPOINT}",
    f"new_rollouts=[{NEW_PATH}]",
    "overwrite=true",
]
STEPS = [
    ("simulate the runs of dataset=quick", ["simulate", "dataset=quick"]),
    ("fit the basis and train", ["train", "dataset=quick", f"output={OUTPUT}"]),
    ("roll out a new blade path", NEW_ROLLOUT),
    ("roll out and judge the test runs", [*EVALUATION, f"output={REPORT.parent}"]),
]


def main() -> int:
    """Run the steps, reusing what an earlier demo completed; returns the status of the first that fails, or 0."""
    begin = time.perf_counter()
    for number, (title, arguments) in enumerate(STEPS, start=1):
        sys.stdout.write(f"\n[{number}/{len(STEPS)}] {title}\n    sgns {shlex.join(arguments)}\n")
        sys.stdout.flush()
        if arguments[0] == "evaluate" and _newer(REPORT, CHECKPOINT):
            sys.stdout.write(f"{REPORT} is newer than the checkpoint; kept\n")
            continue
        start = time.perf_counter()
        status = subprocess.run([sys.executable, "-m", "sgns", *arguments], check=False).returncode
        if status:
            return status
        sys.stdout.write(f"    {time.perf_counter() - start:.0f} s\n")
    sys.stdout.write(f"\ndone in {time.perf_counter() - begin:.0f} s; the report: {REPORT.resolve()}\n")
    return 0


def _newer(file: Path, than: Path) -> bool:
    return file.exists() and than.exists() and file.stat().st_mtime > than.stat().st_mtime


if __name__ == "__main__":
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        # Ctrl-C reaches the command, too; it says what is kept, and the demo ends with its status.
        signal.signal(signal.SIGINT, lambda *_: None)
    sys.exit(main())
