"""Read a run with pandas and xarray (pip install pandas xarray): a table of forces, the surface, the soil by name.

python examples/bucket_on_a_path.py     # makes the run
python examples/read_a_run.py
"""

import numpy as np

from sgns import Run

with Run("outputs/examples/bucket.h5") as run:
    forces = run.forces()  # a row per frame: Fx [N], Tx [N m], x [m], qx, ...
    x, y, z = run.surface(-1)  # of the last frame [m]
    soil = run.to_xarray()
print(forces.describe().round(1))
smooth = forces.rolling(6).mean()  # over a tenth of a second
height = soil.position.sel(axis="z").max("particle")
print(f"largest smoothed draft {-smooth.Fx.min():.0f} N")
print(
    f"the soil's highest grain: {1e3 * float(height[0]):.0f} mm at first, {1e3 * float(height.max()):.0f} mm at most"
)
row, column = np.unravel_index(np.nanargmax(z), z.shape)
print(
    f"in the end the pile is {1e3 * z[row, column]:.0f} mm high, at x = {x[row]:.2f} m, y = {y[column]:.2f} m"
)

assert -smooth.Fx.min() > 0 and float(height.max()) >= float(height[0]) and np.nanmax(z) > 0
