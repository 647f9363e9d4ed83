"""The law along a path."""

from pathlib import Path

import numpy as np
import yaml
from nsf.mpm.materials import deformation_path, drive
from PROJECT import Law


def test_sheared_body_carries_its_flow_stress():
    values = yaml.safe_load((Path(__file__).parents[1] / "conf/material/law.yaml").read_text())
    law = Law(**{name: value for name, value in values.items() if name != "_target_"})
    _, F = deformation_path("simple_shear", 1.0, 2001)
    tau = drive(law, F, dt=1e-3)[-1]
    carried = np.sqrt(1.5) * np.linalg.norm(tau - np.trace(tau) / 3.0 * np.eye(3))  # von Mises stress
    stresses = [law.flow_stress(p) for p in np.linspace(0.0, 1.0, 101).tolist()]
    assert 0.99 * min(stresses) <= carried <= 1.01 * max(stresses)
