"""Values that constructors refuse: the message quotes them."""

import re

import numpy as np
import pytest

from nsf.errors import ConfigError, DeviceError, ShapeError
from nsf.mpm import (
    FP32,
    FP64,
    Cuboid,
    DomainWalls,
    GridGeometry,
    HalfSpace,
    Motion,
    ParticleConstants,
    Sphere,
    Transfer,
    precision_of,
)
from nsf.mpm.device import warp_device
from nsf.mpm.grid.shape import shape_functions
from nsf.mpm.materials import (
    DruckerPrager,
    Hencky,
    HerschelBulkley,
    VonMises,
    VonMisesHardening,
    VonMisesSoftening,
)

NAN, INF = float("nan"), float("inf")
ORIGIN, UP = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)

REFUSED = [
    (lambda: Hencky(0.0, 0.3), "material.E=0.0 Pa"),
    (lambda: Hencky(INF, 0.3), "material.E=inf Pa"),
    (lambda: Hencky(1.0, 0.5), "material.nu=0.5"),
    (lambda: DruckerPrager(1.0, 0.3, 90.0), "material.friction_angle=90.0"),
    (lambda: VonMises(1.0, 0.3, 0.0), "material.yield_stress=0.0 Pa"),
    (lambda: VonMises(1.0, 0.3, INF), "material.yield_stress=inf"),
    (lambda: VonMisesHardening(1.0, 0.3, 1.0, -0.1), "material.hardening=-0.1"),
    (lambda: VonMisesSoftening(1.0, 0.3, 1.0, -0.1), "material.softening=-0.1 Pa"),
    (lambda: HerschelBulkley(1.0, 0.3, -1.0, 1.0), "material.yield_stress=-1.0 Pa"),
    (lambda: HerschelBulkley(1.0, 0.3, 1.0, -0.5), "material.viscosity=-0.5 Pa s"),
    (lambda: Transfer("flip"), "transfer.scheme='flip'"),
    (lambda: Transfer(shape="linear"), "transfer.shape='linear'"),
    (lambda: Transfer("rpic", damping=1.5), "transfer.damping=1.5"),
    (lambda: Transfer("rpic"), "transfer.damping=0 makes rpic the same as apic; set transfer=apic"),
    (lambda: Transfer("apic", damping=0.5), "transfer.damping=0.5 needs transfer.scheme=rpic"),
    (lambda: HalfSpace(ORIGIN, UP, "glue"), "half-space.kind='glue'"),
    (lambda: HalfSpace(ORIGIN, ORIGIN), "normal=(0.0, 0.0, 0.0)"),
    (lambda: HalfSpace(ORIGIN, (0.0, 0.0, 1e-200)), "normal=(0.0, 0.0, 1e-200) has no direction"),
    (lambda: HalfSpace((0.0, NAN, 0.0), UP), "point=(0.0, nan, 0.0)"),
    (lambda: HalfSpace(ORIGIN, UP, "separate", -0.1), "friction=-0.1"),
    (lambda: HalfSpace(ORIGIN, UP, "sticky", 0.4), "friction=0.4 has no effect on kind=sticky"),
    (
        lambda: HalfSpace(ORIGIN, UP, until=0.0),
        "half-space.since=0.0 s must be at least 0 and below until=0.0",
    ),
    (lambda: HalfSpace(ORIGIN, UP, motion={"times": [0, 1]}), "give it _target_: nsf.mpm.Motion"),
    (lambda: Sphere((0.0, NAN, 0.0), 1.0), "sphere.centre=(0.0, nan, 0.0)"),
    (lambda: Sphere(ORIGIN, 0.0), "sphere.radius=0.0 m"),
    (lambda: Cuboid(ORIGIN, (1.0, -1.0, 1.0)), "cuboid.size=(1.0, -1.0, 1.0) m must be positive"),
    (lambda: Cuboid(ORIGIN, (1.0, 1.0, 1.0), angle=NAN), "cuboid.angle=nan °"),
    (lambda: Motion((0.0,), (ORIGIN,)), "motion.times=(0.0,) s must be at least 2"),
    (lambda: Motion((0.0, 0.2, 0.2), (ORIGIN,) * 3), "motion.times=(0.0, 0.2, 0.2) s"),
    (
        lambda: Motion((-0.1, 0.2), (ORIGIN, UP)),
        "motion.times=(-0.1, 0.2) s must be at least 2 and ascend from 0",
    ),
    (lambda: Motion((0.0, 1.0)), "motion has neither translations nor angles"),
    (lambda: Motion((0.0, 1.0), (ORIGIN,)), "motion.translations=((0.0, 0.0, 0.0),) must be a list of 2"),
    (lambda: Motion((0.0, 1.0), angles=(0.0, 1.0, 2.0)), "motion.angles=(0.0, 1.0, 2.0) must be a list of 2"),
    (lambda: Motion((0.0, 1.0), angles=(0.0, 9.0)), "motion.axis=null must be 3 finite numbers"),
    (lambda: Motion((0.0, 1.0), angles=(0.0, 9.0), axis=UP), "motion.pivot=null m must be 3 finite numbers"),
    (lambda: Motion((0.0, 1.0), (ORIGIN, UP), pivot=UP), "no effect without motion.angles"),
    (
        lambda: Sphere(ORIGIN, 1.0, motion=Motion((0.5, 1.0), (ORIGIN, UP)), until=0.5),
        "sphere.until=0.5 s ends before motion.times=(0.5, 1.0) s begin",
    ),
    (lambda: DomainWalls("open"), "walls.kind='open'"),
    (lambda: DomainWalls("slip", 0), "walls.padding=0"),
    (lambda: GridGeometry.of_domain((1.0, 1.0, 1.0), 0.0), "dx=0.0 m"),
    (lambda: GridGeometry.of_domain((1.0, 1.0, 0.5), 0.1), "dx=0.1 m leaves 5 cells"),
    (lambda: precision_of("half"), "precision=half"),
    (lambda: shape_functions(FP64, "linear"), "shape=linear"),
]


@pytest.mark.parametrize(("build", "quoted"), REFUSED, ids=[quoted for _, quoted in REFUSED])
def test_refused(build, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        build()


@pytest.mark.parametrize("name", ["X", "mass", "volume0", "mu", "lam"])
def test_particle_arrays_must_agree(name):
    arrays = {
        "X": np.zeros((4, 3)),
        "mass": np.ones(4),
        "volume0": np.ones(4),
        "mu": np.ones(4),
        "lam": np.ones(4),
    }
    assert len(ParticleConstants(**arrays)) == 4
    arrays[name] = arrays[name][:3]
    with pytest.raises(ShapeError, match=r"\(3"):
        ParticleConstants(**arrays)


def test_no_particles():
    with pytest.raises(ShapeError, match="P > 0"):
        ParticleConstants(np.zeros((0, 3)), *[np.zeros(0)] * 4)


def test_devices():
    assert warp_device("cpu").alias == "cpu"
    with pytest.raises(DeviceError, match="device=tpu is unknown"):
        warp_device("tpu")
    with pytest.raises(DeviceError, match="device=cuda:99"):
        warp_device("cuda:99")


def test_precisions():
    assert precision_of("fp32") is FP32
    assert precision_of(FP64) is FP64


@pytest.mark.parametrize(("size", "dx", "nodes"), [(1.0, 1 / 150, 151), (1.0, 0.1, 11), (1.05, 0.1, 12)])
def test_grid_covers_the_domain(size, dx, nodes):
    grid = GridGeometry.of_domain((size,) * 3, dx)
    assert grid.nodes == (nodes,) * 3
    assert grid.count == nodes**3
    assert min(grid.upper) >= size - 1e-9


@pytest.mark.parametrize(
    ("scheme", "damping", "shares"),
    [("pic", 0.0, (0.0, 0.0)), ("apic", 0.0, (1.0, 1.0)), ("rpic", 0.25, (0.75, 1.0))],
)
def test_affine_shares(scheme, damping, shares):
    assert Transfer(scheme, damping=damping).affine_shares == shares
