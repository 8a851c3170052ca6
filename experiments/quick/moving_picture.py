"""The README's moving picture: a test run of the demo, simulated above and predicted below, with the draft beside.

    make demo
    python experiments/quick/moving_picture.py

It plays in real time: every third frame of 1/60 s. Writes cut.gif beside this file.
"""

from __future__ import annotations

from pathlib import Path

from sgns import Run
from sgns.plot import moving_picture

HERE = Path(__file__).resolve().parent
RUN = "0024_motion-curved_rake-3.8_depth-0.08_speed-0.04.h5"


def main() -> None:
    rollouts = Path("outputs/demo/evaluation/rollouts")
    with Run(Path("data/quick/runs") / RUN) as truth, Run(rollouts / RUN) as network:
        moving_picture({"solver": truth, "network": network}, HERE / "cut.gif")


if __name__ == "__main__":
    main()
