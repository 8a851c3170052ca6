"""A wheel sinks into sand and drives: side views at two slips, and how sinkage and drawbar pull follow.

    python experiments/wheel/run.py

Makes two runs in data/wheel (kept), then side.png beside this script.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

from common import scene_of

from sgns.data.run import Run
from sgns.evaluate.views import common_scales, side_views
from sgns.simulate.run import simulate_scene

HERE, DATA = Path(__file__).parent, Path("data/wheel")
SLIPS = (0.2, 0.7)
SCENE = ["scene=wheel", "scene.load=100", "scene.duration=6.0", "scene.bed.particles_per_cell=8"]


def main() -> None:
    runs = {}
    for slip in SLIPS:
        file = DATA / f"slip_{slip}.h5"
        scene, effects = scene_of(*SCENE, f"scene.slip={slip}")
        if not file.exists():
            simulate_scene(scene, file, effects=effects)
        runs[f"slip {100 * slip:.0f} %"] = Run(file)
    for title, run in runs.items():
        print(title, scene.summary(run.force, run.torque, run.pose))
    frames = (60, 200, 359)
    scales = common_scales(list(runs.values()), frames, scene.initial_positions())
    views = [[(title, run, frame) for title, run in runs.items()] for frame in frames]
    figure = side_views(views, scales, whole_width=10.8, width=4.95)
    figure.savefig(HERE / "side.png", dpi=90)


if __name__ == "__main__":
    main()
