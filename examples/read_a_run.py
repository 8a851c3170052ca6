"""Read a run into pandas and xarray (pip install pandas xarray): a table of forces, and the soil by name.

python examples/bucket_on_a_path.py     # makes the run
python examples/read_a_run.py
"""

import pandas as pd
import xarray as xr

from sgns import Run

with Run("outputs/examples/bucket.h5") as run:
    time = pd.Index(run.time, name="time")  # [s]
    forces = pd.DataFrame(run.force, index=time, columns=["Fx", "Fy", "Fz"])  # of the soil on the tool [N]
    soil = xr.Dataset(
        {
            "position": (("time", "particle", "axis"), run.positions()),  # [m]
            "pose": (("time", "component"), run.pose),  # [m], quaternion
        },
        coords={
            "time": run.time,
            "axis": ["x", "y", "z"],
            "component": ["x", "y", "z", "qx", "qy", "qz", "qw"],
        },
    )
print(forces.describe().round(1))
smooth = forces.rolling(6).mean()  # over a tenth of a second
height = soil.position.sel(axis="z").max("particle")
print(f"largest smoothed draft {-smooth.Fx.min():.0f} N")
print(
    f"the soil's highest grain: {1e3 * float(height[0]):.0f} mm at first, {1e3 * float(height.max()):.0f} mm at most"
)

assert -smooth.Fx.min() > 0 and float(height.max()) >= float(height[0])
