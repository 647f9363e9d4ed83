"""The law of this project along a path."""

import numpy as np
from nsf.mpm.materials import deformation_path, drive
from PROJECT.saturating import Saturating


def test_shear_stress_grows_towards_its_bound():
    """‖dev τ‖ leaves the yield stress and ends at the saturation, in small steps."""
    law = Saturating(E=4000.0, nu=0.3, yield_stress=40.0, saturation=200.0, rate=20.0)
    _, F = deformation_path("simple_shear", 1.0, 2001)
    tau = drive(law, F, dt=1e-3)
    mean = np.trace(tau, axis1=1, axis2=2)[:, None, None] / 3.0
    size = np.linalg.norm(tau - mean * np.eye(3), axis=(1, 2))
    assert size.max() <= 200.0 * (1.0 + 1e-9)
    assert abs(size[-1] - 200.0) < 2.0
