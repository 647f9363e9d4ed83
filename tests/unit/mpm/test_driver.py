"""The material-point driver: input errors, paths, history."""

import re
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import warp as wp

from nsf.errors import ConfigError, DeviceError, InstabilityError, ShapeError
from nsf.mpm.materials import (
    PATHS,
    DruckerPrager,
    FixedCorotated,
    Hencky,
    LawFunctions,
    Material,
    deformation_path,
    drive,
)

EYE = np.eye(3)[None]


@cache
def aging_functions(precision):
    real, mat33 = precision.real, precision.mat33
    vec2 = wp.types.vector(length=2, dtype=real)

    @wp.struct
    class Params:
        rate: real

    @wp.func
    def tau_of(F: mat33, history: vec2, mu: real, lam: real):
        return mu * F

    @wp.func
    def return_map(F_trial: mat33, history: vec2, mu: real, lam: real, params: Params, dt: real):
        h = vec2(history[0] + params.rate * dt, history[1] + real(1.0))
        return (h[0] + h[1]) * wp.identity(n=3, dtype=real), h

    return LawFunctions(tau_of, return_map, Params)


@dataclass(frozen=True)
class Aging(Material):
    """τ = μ̂ (rate · t + number of steps + 10) I: nothing but history."""

    rate: float = 0.5
    history_size = 2

    def initial_history(self, particles):
        return np.tile([10.0, 0.0], (particles, 1))

    def functions(self, precision):
        return aging_functions(precision)

    def stretches_of(self, principal, mu, lam):
        return np.full_like(principal, np.nan)  # stress does not tell the stretch

    def params(self, precision):
        params = self.functions(precision).Params()
        params.rate = precision.real(self.rate)
        return params


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
def test_history_is_carried_from_row_to_row(precision):
    material = Aging(2.6, 0.3)  # μ̂ = 1
    tau = drive(material, np.tile(EYE, (4, 1, 1)), 0.1, precision)
    np.testing.assert_allclose(tau, [(10.0 + 0.05 * k + k) * np.eye(3) for k in (1, 2, 3, 4)], rtol=1e-6)


def test_history_starts_afresh_at_every_call():
    material = Aging(2.6, 0.3)
    assert np.array_equal(drive(material, EYE, 0.1), drive(material, EYE, 0.1))


@pytest.mark.parametrize("F", [np.eye(3), np.zeros((0, 3, 3)), np.zeros((4, 3, 2)), np.zeros((4, 9))])
def test_shape_is_refused(F):
    with pytest.raises(ShapeError, match=re.escape(str(F.shape))):
        drive(Hencky(1.0, 0.3), F, 1.0)


@pytest.mark.parametrize("dt", [0.0, -1.0, float("nan")])
def test_dt_is_refused(dt):
    with pytest.raises(ConfigError, match=f"dt={dt} s"):
        drive(Hencky(1.0, 0.3), EYE, dt)


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize(
    "bad", [np.full((3, 3), np.nan), np.diag([1.0, 1.0, -1.0]), np.diag([1.0, 1.0, 0.0])]
)
def test_bad_row_is_named(bad):
    with pytest.raises(ConfigError, match=r"F_path\[2\]"):
        drive(Hencky(1.0, 0.3), np.array([np.eye(3), np.eye(3), bad, bad]), 1.0)


def test_bad_precision_and_device():
    with pytest.raises(ConfigError, match="precision=fp8"):
        drive(Hencky(1.0, 0.3), EYE, 1.0, precision="fp8")
    with pytest.raises(DeviceError, match="device=tpu"):
        drive(Hencky(1.0, 0.3), EYE, 1.0, device="tpu")


def test_non_finite_stress_is_named():
    with pytest.raises(InstabilityError, match=r"FixedCorotated gave a non-finite stress at F_path\[1\]"):
        drive(FixedCorotated(1e30, 0.3), np.array([np.eye(3), 1e5 * np.eye(3)]), 1.0, precision="fp32")


@pytest.mark.parametrize("name", PATHS)
def test_paths(name):
    s, F = deformation_path(name, 0.1, 11)
    assert F.shape == (11, 3, 3)
    assert (s[0], s[-1]) == (0.0, 0.1)
    np.testing.assert_allclose(F[0], np.eye(3), atol=1e-15)
    assert (np.linalg.det(F) > 0).all()
    assert np.isfinite(drive(DruckerPrager(1e3, 0.3, 30.0), F, 1.0)).all()


@pytest.mark.parametrize(
    ("name", "row"),
    [
        ("simple_shear", [[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        ("uniaxial_strain", np.diag([1.1, 1.0, 1.0])),
        ("oedometer", np.diag([1.0, 1.0, 0.9])),
        ("isotropic_compression", 0.9 * np.eye(3)),
    ],
)
def test_end_of_a_path(name, row):
    np.testing.assert_allclose(deformation_path(name, 0.1, 5)[1][-1], row)


def test_cyclic_shear_returns():
    _, F = deformation_path("cyclic_shear", 0.1, 9)
    np.testing.assert_allclose(F[[0, 2, 4, 6, 8], 0, 1], [0.0, 0.1, 0.0, -0.1, 0.0], atol=1e-15)


@pytest.mark.parametrize(
    ("arguments", "quoted"),
    [
        (("twist", 0.1, 5), "path=twist"),
        (("simple_shear", 0.0, 5), "amplitude=0.0"),
        (("oedometer", 1.0, 5), "amplitude=1.0"),
        (("simple_shear", 0.1, 1), "points=1"),
    ],
)
def test_bad_path(arguments, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        deformation_path(*arguments)
