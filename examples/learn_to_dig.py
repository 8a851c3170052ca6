"""Learn to dig a trench: the cross-entropy method on a path's knots, all candidates side by side.

python examples/learn_to_dig.py         # short: half a minute at most
python examples/learn_to_dig.py 40 256  # 40 rounds of 256 paths: some minutes
"""

import sys

import numpy as np

from sgns.envs import DigEnvs

rounds, paths = (int(word) for word in (sys.argv[1:] + ["5", "64"][len(sys.argv) - 1 :]))
envs = DigEnvs(paths, seconds=3.0)
x = envs.profile.x  # places along the bed [m]
target = -np.clip(np.minimum(x - 0.12, 0.32 - x), 0.0, 0.05)  # a trench, 5 cm deep

rng = np.random.default_rng(0)
knots = 6  # of forward and vertical speed along the path
mean, spread = np.zeros((knots, 2)), np.full((knots, 2), 0.5)
when = np.linspace(0.0, knots - 1.0, envs.length)
curve = []
for _ in range(rounds):
    tried = (mean + spread * rng.standard_normal((paths, knots, 2))).clip(-1.0, 1.0)
    tried[0] = mean  # how good is the middle?
    envs.reset(options={"target": target})
    earned = np.zeros(paths)
    for t in when:
        before = min(int(t), knots - 2)
        share = t - before
        _, reward, *_ = envs.step((1 - share) * tried[:, before] + share * tried[:, before + 1])
        earned += reward
    curve.append((earned[0], earned.max()))
    best = tried[np.argsort(earned)[-paths // 8 :]]
    mean, spread = best.mean(axis=0), 0.9 * best.std(axis=0) + 0.02
    print(
        f"round {len(curve)}: middle {earned[0]:.3f}, best {earned.max():.3f} (1: a perfect trench for nothing)"
    )

assert curve[-1][0] > curve[0][0] + 0.05
