"""How large a scene may be: far beyond what has been computed, and short of what ends in an error or never ends."""

MOST_PARTICLES = 20_000_000
MOST_NODES = 200_000_000
"""Of the grid."""
MOST_FRAMES = 1_000_000
MOST_SUBSTEPS = 1_000_000
"""Between two frames."""
MOST_STEPS = 1_000_000_000
"""Substeps of a whole run."""
# What numbers can mean, lowest and highest.
YOUNGS_MODULUS = (1.0e-9, 1.0e12)  # [Pa]
MOST_POISSONS_RATIO = 0.499
LEAST_PACKING = 0.05
MOST_GRAVITY = 1.0e5  # [m/s^2], ten thousand times the earth's
FRAME_RATE = (1.0e-3, 1.0e6)  # [Hz]
MOST_DURATION = 1.0e6  # [s]
LEAST_COURANT = 1.0e-4
BODY_MASS = (1.0e-9, 1.0e9)  # [kg], of a body whose height is free
