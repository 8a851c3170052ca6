"""The published excavation cases with a blade that is cut off level below: what the end of the plate takes.

    python experiments/published_forces/level.py <folder of the authors' excavation files> [--scene excavation]

A raked plate's end is square: its back edge is lower than the front edge and is dragged through the soil. Here the same
motions are made by a blade with the same front and a level end, at the height of the middle of the plate's end. Makes
run files as run.py does and writes level.csv, with `--scene excavation` level_excavation.csv. Beside the drafts stands
what the earth-moving equation says, moment by moment, of a full bed.
"""

from __future__ import annotations

import argparse
import csv
import logging
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from run import HERE, campaign_of, compared, first_third, smoothed

from mpm_warp import Excavation, Push
from mpm_warp.poses import rotate
from sgns.data.published import excavation_case
from sgns.data.run import Run
from sgns.simulate.command import simulate_campaign

sys.path.append(str(HERE.parent / "verification"))
from mckyes import ANGLE, level_blade, wedge


def level(cut: Excavation, file: Path) -> Push:
    """A scene of its own for the same cut; the blade's mesh goes to `file`."""
    blade = cut.blade
    tool = level_blade(file, cut.rake, (blade.length, blade.width, blade.thickness), blade.friction)
    corners = tool.mesh[0]
    end = corners[corners[:, 2] < corners[:, 2].min() + 1e-9].mean(axis=0)
    times = np.arange(0.0, cut.duration + 1.0 / cut.frame_rate, 0.25 / cut.frame_rate)
    poses = cut.poses_at(times)
    poses[:, :3] += rotate(poses[:, 3:], blade.tip) - end
    poses[:, 3:] = (0.0, 0.0, 0.0, 1.0)
    shared = {key: getattr(cut, key) for key in vars(cut) if key in Push.__dataclass_fields__}
    path = np.column_stack([times, poses])
    return Push(
        **shared | {"name": f"{cut.name}_level", "kind": Push.kind, "tool": tool, "path": path.tolist()}
    )


def theory(cut: Excavation, angle: float) -> np.ndarray:
    """Draft by the earth-moving equation at the frames after the first [N]: the blade at the depth of the moment, with
    all the soil swept up so far before it.

    Args:
        angle: of friction in the soil [degrees].
    """
    poses = cut.body_poses()
    tip = poses[:, :3] + rotate(poses[:, 3:], cut.blade.tip)
    depth = np.maximum(-tip[:, 2], 0.0)
    swept = np.cumsum(depth[1:] * np.diff(tip[:, 0]))
    width = cut.blade.width
    return np.array(
        [
            width * wedge(angle, cut.rake, d, width, area)[0] if d > 0.0 else 0.0
            for d, area in zip(depth[1:], swept, strict=True)
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("published", help="folder with valid.tfrecord and metadata.json")
    parser.add_argument("--runs", default=None, help="folder for the run files (default: data/<scene>_level)")
    parser.add_argument(
        "--scene",
        default="published_excavation",
        choices=("published_excavation", "excavation"),
        help="excavation: the reference setting",
    )
    parser.add_argument("--workers", type=int, default=None, help="runs at once (default: one per core)")
    parser.add_argument("--cases", type=int, nargs="*", help="only these case numbers")
    parser.add_argument("overrides", nargs="*", help="changes of the scene, for example scene.duration=2")
    options = parser.parse_intermixed_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    options.runs = options.runs or f"data/{options.scene}_level"
    published, campaign = campaign_of(options, excavation_case, options.cases)
    campaign.path.mkdir(parents=True, exist_ok=True)
    cuts = campaign.scenes
    scenes = {name: level(cut, campaign.path / f"blade_{cut.rake:g}.obj") for name, cut in cuts.items()}
    campaign = replace(campaign, scenes=scenes)
    simulate_campaign(campaign, device="cpu", workers=options.workers)

    suffix = "" if options.scene == "published_excavation" else f"_{options.scene}"
    with (HERE / f"table{suffix}.csv").open(newline="") as stream:
        square = {int(row["case"]): row for row in csv.DictReader(stream)}
    rows = []
    for theirs in published:
        with Run(campaign.file(f"case_{theirs.case:03d}")) as run:
            ours = run.force[1 : 1 + len(theirs.force)]
            third = first_third(smoothed(run.pose[1 : 1 + len(ours), 0]))
        row = {"case": theirs.case, **excavation_case(theirs.case)}
        for name, component, sign in (("draft", 0, -1), ("vertical", 2, 1)):
            found = compared(sign * ours[:, component], sign * theirs.force[: len(ours), component])
            row[f"{name}_square"] = float(square[theirs.case][f"{name}_mean"])
            row |= {f"{name}_{key}": round(float(value), 3) for key, value in found.items()}
        row["draft_first_third"] = round(float(smoothed(-ours[:, 0])[third].mean()), 3)
        cut = cuts[f"case_{theirs.case:03d}"]
        own = math.degrees(math.asin(cut.material.static_friction))
        for name, angle in (("nominal", ANGLE), ("own", own)):
            row[f"mckyes_{name}"] = round(float(smoothed(theory(cut, angle)[: len(ours)]).mean()), 3)
        rows.append(row)
    with (HERE / f"level{suffix}.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    for name in ("draft", "vertical"):
        ratios = [
            [row[f"{name}_{end}"] / row[f"{name}_published"] for row in rows] for end in ("square", "mean")
        ]
        logging.info(
            "%s over published: median %.2f with a square end, %.2f with a level one",
            name,
            *map(np.median, ratios),
        )


if __name__ == "__main__":
    main()
