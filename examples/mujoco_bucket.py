"""A blade on a position-controlled slider in MuJoCo feels the soil: 1 kHz control, 60 Hz soil.

pip install 'sgns[mujoco]'
python examples/mujoco_bucket.py
"""

import mujoco
import numpy as np

import sgns
from mpm_warp import Scene
from sgns.coupling import Coupling

soil = Coupling(sgns.Simulator.pretrained("excavation"))
scene = Scene.from_dict(soil.simulator.scene)
start = scene.body_poses()[0]  # of the blade's centre of mass [m]
blade = scene.blade

# The box is the blade of the network. Its weight, 40 kg, hangs on the vertical drive.
MODEL = f"""
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="blade" pos="{start[0]} {start[1]} {start[2]}">
      <joint name="x" type="slide" axis="1 0 0" damping="200"/>
      <joint name="z" type="slide" axis="0 0 1" damping="200"/>
      <geom type="box" size="{blade.thickness / 2} {blade.width / 2} {blade.length / 2}" mass="40"
        contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <position name="x" joint="x" kp="50000" kv="2000"/>
    <position name="z" joint="z" kp="50000" kv="2000"/>
  </actuator>
</mujoco>
"""


def cut(with_soil: bool) -> np.ndarray:
    """Down, then forward at constant speed; rows of actuator forces x, z and forces of the soil x, z [N]."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    body = model.body("blade").id
    mujoco.mj_forward(model, data)
    soil.reset(start)
    rows = []
    for _ in range(2500):
        # Wanted: 4 cm down in 0.7 s, then 0.1 m/s forward.
        data.ctrl[:] = 0.1 * max(0.0, data.time - 0.7), -0.04 * min(1.0, data.time / 0.7)
        pose = np.concatenate([data.xipos[body], np.roll(data.xquat[body], -1)])  # w first in MuJoCo
        wrench = soil.step(data.time, pose)
        if with_soil:
            data.xfrc_applied[body] = np.concatenate(wrench)
        mujoco.mj_step(model, data)
        rows.append([*data.actuator_force, *wrench.force[[0, 2]]])
    return np.array(rows)


felt, free = cut(True), cut(False)
steady = slice(1500, 2500)  # the blade moves at constant speed
extra = (felt - free)[steady, :2].mean(axis=0)
from_soil = felt[steady, 2:].mean(axis=0)
for axis, drive, load in zip("xz", extra, from_soil, strict=True):
    print(f"along {axis}: the drive gives {drive:.1f} N more with soil; the soil's force is {load:.1f} N")

assert from_soil[0] < -20.0
assert np.abs(extra + from_soil).max() < 0.05 * np.abs(from_soil).max()
