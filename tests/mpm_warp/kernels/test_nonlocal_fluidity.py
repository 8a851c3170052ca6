"""The cooperative term on the grid, against exact answers."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.optimize import brentq

from mpm_warp import Bed, Effects, Material, Scene, Solver
from mpm_warp.kernels.fluidity import nonlocal_launches, wall_sink
from mpm_warp.kernels.grid import GhostNodes
from mpm_warp.launch import Threads
from sgns_testing.solvers import change

STEADY = Effects(nonlocality=True)
DYNAMIC = Effects(fluidity=True, nonlocality=True)
PRESSURE = 1000.0


class Column:
    """A block of soil whose stress and fluidity are imposed. Its floor is the only wall."""

    def __init__(self, effects, material, height=0.2, spacing=0.01, real="float64", wide=4, **bed):
        size = (wide * spacing, wide * spacing, height)
        bed = Bed(size=size, spacing=spacing, initial_stress="none", headroom=2 * spacing, **bed)
        scene = Scene(bed=bed, material=material, gravity=0.0, duration=0.1)
        self.solver = solver = Solver(scene, effects, precision=real)
        self.material, self.particles, self.g = material, solver.particles, solver.particles.fluidity
        grid, self.field = solver.grid, solver._cooperative_field
        self.shape = (grid.nx, grid.ny, grid.nz)
        floor = wall_sink(self.shape, (-1, -1, grid.low[2]), (2**30,) * 3)
        self.launches = nonlocal_launches(
            solver._real,
            solver.effects,
            floor * (material.fluidity_at_walls == "zero"),
            *(self.particles, grid, solver._soil, self.field, solver._cooperation),
            GhostNodes(solver._real, solver.device, grid, {}, mirrored=False),
            Threads(1, solver.device),
        )
        wp.copy(self.particles.home, self.particles.position)  # as a remap does
        self.height = self.particles.position.numpy()[:, 2] + height  # of the particles [m]
        self.nodal_height = spacing * (np.arange(grid.nz) - grid.low[2])
        self.inside = (self.nodal_height > -1e-9) & (self.nodal_height < self.height.max() + 1e-9)
        self.z = self.nodal_height[self.inside]  # of the nodes in the soil, above the floor [m]

    def impose(self, mu, pressure=PRESSURE):
        """Shear stress mu p in the xz plane."""
        e = np.zeros((len(self.height), 6))
        e[:, 4] = mu * np.ones(len(e)) * pressure / (2.0 * self.material.shear_modulus)
        self.particles.elastic_strain.assign(e)
        self.particles.log_volume.fill_(-pressure / self.material.bulk_modulus)

    def solve(self, times):
        for _ in range(times):
            for launch in self.launches:
                launch.launch()

    def nodes(self, name):
        """filled, source, slowing or g in the middle of the column, from the floor to the surface."""
        at = ("filled", "source", "slowing", "g").index(name)
        field = self.field.numpy()[:-1, at].reshape(self.shape)
        return field[self.shape[0] // 2, self.shape[1] // 2][self.inside]

    def move(self):
        """The particles' part of the step with the velocities that are on the grid."""
        for launch in self.solver._steps.step[-2:]:
            launch.launch()

    @property
    def mu(self):
        e, ln_j = self.particles.elastic_strain.numpy(), self.particles.log_volume.numpy()
        strain = np.sqrt(2.0) * np.linalg.norm(e * [1, 1, 1, 2**0.5, 2**0.5, 2**0.5], axis=1)
        return self.material.shear_modulus * strain / (-self.material.bulk_modulus * ln_j)

    @property
    def lost_share(self):
        """Of what the grid cannot see of g, per step."""
        number = 4.0 * (cooperative_length(self.material) / self.solver.scene.bed.spacing) ** 2
        return 1.0 - 1.0 / (1.0 + number * self.solver.time_step / self.material.fluidity_time)


def cooperative_length(material):
    """A d [m]."""
    return material.nonlocal_amplitude * material.grain_diameter


def soil(xi, mu=0.8):
    """A material whose cooperativity length at mu is xi [m]."""
    sand = Material()
    return Material(grain_diameter=sand.grain_diameter * xi / sand.cooperativity_length(mu))


BOTH_LAWS = pytest.mark.parametrize("law", ["saturating", "linear"])


@pytest.mark.parametrize("effects", [STEADY, DYNAMIC])
def test_nodes_that_hardly_hold_soil_do_no_harm(effects):
    """A particle just beyond the middle of its cell gives the next nodes so little that float32 has hardly a number for
    it: the answer is that for a particle in the middle."""

    def answer(beyond):
        column = Column(effects, soil(0.04), real="float32", height=0.05)
        at = column.particles.position.numpy() + beyond * column.solver.scene.bed.spacing
        column.particles.home.assign(at)
        column.impose(0.8)
        if effects.fluidity:
            column.g.assign(10.0 * column.height)
        column.solve(30 if effects is STEADY else 3)
        assert np.isfinite(column.field.numpy()).all()
        return column.nodes("g")

    middle = answer(0.0)
    assert middle.max() > 0.1
    for beyond in np.geomspace(1e-7, 1e-5, 9):
        np.testing.assert_allclose(answer(beyond), middle, rtol=1e-3)


def test_cohesion_is_like_so_much_more_pressure():
    """Cooperative flow of cohesive soil is that of dry soil under p + p_c; torn soil takes no part in it."""
    dry = soil(0.03)
    damp = replace(dry, cohesion=500.0)
    damp_column, dry_column = (Column(STEADY, one, height=0.1) for one in (damp, dry))
    mu = np.where(dry_column.height < 0.05, 0.8, 0.7)
    for column, pressure in ((damp_column, PRESSURE), (dry_column, PRESSURE + damp.cohesive_pressure)):
        column.impose(mu * (PRESSURE + damp.cohesive_pressure) / pressure, pressure)
        column.solve(50)
    np.testing.assert_allclose(damp_column.nodes("g"), dry_column.nodes("g"), rtol=1e-9)
    damp_column.particles.log_volume.fill_(1e-6)
    damp_column.particles.bond.zero_()
    damp_column.solve(1)
    assert not damp_column.nodes("filled").any()


def test_flow_reaches_into_soil_below_its_friction():
    """A flowing layer under a solid one: cosh profiles on both sides, joined in value and slope."""
    material = replace(soil(0.03, 0.7), fluidity_at_walls="free")
    column = Column(STEADY, material)
    column.impose(np.where(column.height < 0.1, 0.8, 0.7))
    column.solve(100)
    z, g = column.z, column.nodes("g")
    below, above = material.cooperativity_length(0.8), material.cooperativity_length(0.7)
    g_loc = column.nodes("source")[0]
    # g = g_loc - a cosh(z / below) and g = b cosh((H - z) / above), equal value and slope at z = 0.1.
    matrix = [
        [math.cosh(0.1 / below), math.cosh(0.1 / above)],
        [math.sinh(0.1 / below) / below, -math.sinh(0.1 / above) / above],
    ]
    a, b = np.linalg.solve(matrix, [g_loc, 0.0])
    exact = np.where(z < 0.1, g_loc - a * np.cosh(z / below), b * np.cosh((0.2 - z) / above))
    assert exact[-1] < 0.15 * g_loc < exact.max()  # there is a decay to be seen
    assert np.abs(g - exact).max() < 0.02 * g_loc


def test_laplacian_is_of_second_order():
    """One implicit step on cos(k z): the grid's change against -kappa / (1 + kappa) cos(k z)."""
    errors = []
    for spacing in (0.04, 0.02, 0.01):
        material = Material(grain_diameter=0.01, fluidity_at_walls="free")
        column = Column(DYNAMIC, material, spacing=spacing)
        k = math.pi / 0.2
        column.impose(0.5)
        column.g.assign(1.0 + np.cos(k * column.height))
        column.solve(1)
        kappa = (cooperative_length(material) * k) ** 2 * column.solver.time_step / material.fluidity_time
        change = column.nodes("g") - column.nodes("source")
        errors.append(np.abs(change + kappa / (1 + kappa) * np.cos(k * column.z)).max() / kappa)
    assert errors[0] < 0.2
    assert errors[1] < 0.35 * errors[0]
    assert errors[2] < 0.35 * errors[1]


@pytest.mark.parametrize(
    "bed",
    [
        {"particles_per_cell": 1},
        {"particles_per_cell": 4, "arrangement": "jittered"},
        {"arrangement": "poisson"},
    ],
)
@pytest.mark.parametrize("effects", [STEADY, DYNAMIC])
def test_constants_stay_constant(effects, bed):
    """Uniform fluidity and nothing that takes it away: the same on every node, however the particles lie."""
    column = Column(effects, Material(grain_diameter=0.005, fluidity_at_walls="free"), **bed)
    column.impose(0.8)
    if effects.fluidity:
        column.g.fill_(3.0)
    column.solve(3)
    field = column.field.numpy()
    soil_nodes = field[:, 0] > 0.0
    assert np.ptp(field[soil_nodes, 0]) > 0.5  # nodes at the surface are partly filled
    expected = 3.0 if effects.fluidity else column.nodes("source")[5]
    np.testing.assert_allclose(field[soil_nodes, 3], expected, rtol=1e-9)
    # Particles get nothing, or exactly the share that they are to give up.
    placed = column.solver._cooperation.numpy()[soil_nodes, 0]
    np.testing.assert_allclose(
        placed, column.lost_share * expected if effects.fluidity else 0.0, atol=1e-9 * expected
    )


def test_particles_of_a_cell_keep_together():
    """Rows that differ by turns, which the grid cannot see: the difference fades, a smooth profile does not."""
    column = Column(DYNAMIC, Material(grain_diameter=0.01, nonlocal_amplitude=0.5, fluidity_at_walls="free"))
    g, k = column.g, math.pi / 0.2
    rows = np.round(column.height / 0.01 - 0.5).astype(int)
    material, dt = column.solver.scene.material, column.solver.time_step
    turns, smooth = [], []
    for start in (1.0 + 0.3 * (-1.0) ** rows, 1.0 + 0.3 * np.cos(k * column.height)):
        g.assign(0.01 * start)
        column.impose(material.static_friction, 1000.0 * PRESSURE)  # no growth, no decay of its own
        column.solve(1)
        column.move()
        found = 100.0 * g.numpy()
        inner = np.abs(column.height - 0.1) < 0.07
        turns.append(np.mean(((found - 1.0) * (-1.0) ** rows)[inner]) / 0.3)
        smooth.append(np.mean((found - 1.0) * np.cos(k * column.height)) / 0.15)
    assert turns[0] == pytest.approx(1.0 - column.lost_share, rel=0.01)
    kappa = (0.5 * 0.01 * k) ** 2 * dt / material.fluidity_time
    assert smooth[1] == pytest.approx(1.0 / (1.0 + kappa), rel=0.1 * kappa)


def test_fluidity_is_kept_by_the_step():
    """Natural boundaries all around: the volume-weighted sum of g does not change."""
    column = Column(
        DYNAMIC,
        Material(grain_diameter=0.01, fluidity_at_walls="free"),
        particles_per_cell=2,
        arrangement="jittered",
    )
    column.impose(0.5)
    column.g.assign(np.exp(-(((column.height - 0.05) / 0.03) ** 2)))
    column.solve(1)
    filled, source, _, g = column.field.numpy().T
    assert np.abs(g - source).max() > 0.02
    # What the Jacobi sweeps leave undone is not conserved: a per cent of the change.
    assert abs(np.sum(filled * (g - source))) < 0.01 * np.sum(filled * np.abs(g - source))


def sheared(effects, material, profile):
    """Heights and mu of the particles of a sheared column, without the last centimetre at both ends.

    The grid's velocity is imposed for 0.03 s: v_x(z) with dv_x/dz = profile(z) [1/s]. The particles are put back where
    they were, or the column would lean.
    """
    column = Column(effects, material, wide=2)
    x = column.particles.position.numpy().copy()
    fine = np.linspace(-0.05, 0.3, 3501)
    slope = profile(fine)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(fine))])
    velocity = np.zeros((*column.shape, 4))
    velocity[..., 0] = np.interp(column.nodal_height, fine, integral)
    column.solver._velocity[:-1].assign(velocity.reshape(-1, 4))
    column.impose(material.static_friction)
    for _ in range(round(0.03 / column.solver.time_step)):
        column.solve(1)
        column.move()
        column.particles.position.assign(x)
    middle = np.abs(column.height - 0.1) < 0.09
    return column.height[middle], column.mu[middle]


def steady_friction(material, profile):
    """Heights and the mu with g_loc(mu) = g - xi(mu)^2 g'', g = profile / mu, no slope at both ends."""
    z, numbers = np.linspace(0.0, 0.2, 41), math.pi / 0.2 * np.arange(5)
    modes = np.cos(np.outer(z, numbers))
    mu_s, mu_2, span = material.static_friction, material.limit_friction, material.limit_friction - 0.76
    c = math.sqrt(PRESSURE / material.grain_density) * 0.278 / material.grain_diameter

    def missing(mu, g, bend):
        m = span / (mu_2 - mu) if material.rate_law == "saturating" else 1.0
        return c * m * (mu - mu_s) / (span * mu) - (g - material.cooperativity_length(mu) ** 2 * bend)

    mu = np.full(z.shape, mu_s)
    for _ in range(12):
        g = profile(z) / mu
        bend = -modes @ (numbers**2 * np.linalg.lstsq(modes, g, rcond=None)[0])
        for i in range(len(z)):
            local = brentq(missing, mu_s * (1 + 1e-7), mu_2 * (1 - 1e-9), (g[i], 0.0))
            mu[i] = brentq(missing, 0.5 * (mu_s + local), mu_2 * (1 - 1e-9), (g[i], bend[i]))
    return z, mu


@BOTH_LAWS
def test_shear_that_varies_meets_the_nonlocal_law(law):
    """Imposed rate 1 + 0.1 cos(k z): friction settles where g_loc(mu) = g - xi(mu)^2 g''. The excess is taken from
    the step before and follows from mu, so this also shows that the two come to agree."""
    material = Material(grain_diameter=0.02, rate_law=law, fluidity_at_walls="free")

    def profile(z):
        return 1.0 + 0.1 * np.cos(math.pi / 0.2 * z)

    at, found = sheared(STEADY, material, profile)
    z, expected = steady_friction(material, profile)
    _, local = steady_friction(replace(material, nonlocal_amplitude=0.0), profile)
    change = np.abs(expected - local).max()
    assert change > 0.002  # the term matters here
    assert np.abs(found - np.interp(at, z, expected)).max() < 0.05 * change


@BOTH_LAWS
def test_far_below_the_grid_it_is_inert(law):
    """A d a hundredth of the spacing, walls included: less than a thousandth of the friction."""
    material = Material(grain_diameter=2e-4, rate_law=law)
    _, mu = sheared(STEADY, material, np.ones_like)
    _, local = sheared(STEADY, replace(material, nonlocal_amplitude=0.0), np.ones_like)
    np.testing.assert_allclose(mu, local, rtol=1e-3)


@pytest.mark.parametrize("effects", [STEADY, DYNAMIC])
def test_fluidity_never_falls_below_zero(effects):
    """Patches of flow beside soil at rest, sharp edges: 0 <= g <= the largest source."""
    column = Column(effects, Material(grain_diameter=0.01), wide=6, arrangement="jittered")
    rng = np.random.default_rng(0)
    flowing = rng.random(column.solver.particle_count) < 0.1
    column.impose(np.where(flowing, 0.95, 0.3))
    if effects.fluidity:
        column.g.assign(np.where(flowing, 100.0, 0.0))
    for _ in range(5):
        column.solve(1)
        _, source, _, g = column.field.numpy().T
        assert 0.0 <= g.min() <= g.max() <= source.max() * (1 + 1e-12)
        column.move()
    if effects.fluidity:
        assert column.g.numpy().min() >= 0.0


@pytest.mark.parametrize("effects", [STEADY, DYNAMIC])
@pytest.mark.parametrize("change", [{"grain_diameter": 1e-12}, {"nonlocal_amplitude": 0.0}])
@pytest.mark.parametrize("mu", [0.0, 0.76, 0.9616, 5.0])
def test_limits_are_finite(effects, change, mu):
    column = Column(effects, replace(Material(), **change), real="float32")
    for pressure in (1e-20, 1e3):
        column.impose(mu, pressure)
        column.solve(2)
        column.move()
        assert np.isfinite(column.field.numpy()).all()
        assert np.isfinite(column.particles.elastic_strain.numpy()).all()


def test_separated_soil_has_no_part_in_it():
    column = Column(STEADY, soil(0.04))
    column.impose(0.8)
    change(column.particles.log_volume, 0.01, at=column.height > 0.1)
    column.solve(1)
    filled = column.nodes("filled")
    assert filled[5] > 0.9
    assert not filled[column.z > 0.12].any()
