"""Chart of a material point: Kirchhoff stress along a deformation path."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from omegaconf import DictConfig

from nsf import config as configuration
from nsf.errors import ConfigError
from nsf.mpm.materials import deformation_path, drive
from nsf.results.style import PALETTE, styled
from nsf.storage import writing

_MOST_POINTS = 1_000_000
_COMPONENTS = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}


def point_response(config: DictConfig) -> pd.DataFrame:
    """Drive a law along a named path.

    Args:
        config: composed from `conf/point.yaml`.

    Returns:
        One row a point: amplitude, the six components of τ [Pa], pressure −tr τ/3 [Pa] and ‖dev τ‖ [Pa].

    Raises:
        ConfigError: unknown law or path, or a value out of range.
    """
    material = configuration.build(config.material, "material")
    p = configuration.section(config, "point")
    configuration.number("point.amplitude", p.amplitude)
    if configuration.number("point.points", p.points, least=2, whole=True) > _MOST_POINTS:
        raise ConfigError(f"point.points={p.points} is more than the {_MOST_POINTS} of a chart; give fewer")
    if not configuration.number("point.rate", p.rate) > 0:
        raise ConfigError(f"point.rate={p.rate} 1/s must be positive")
    amplitude, F = deformation_path(config.path, p.amplitude, p.points)
    tau = drive(material, F, p.amplitude / (p.points - 1) / p.rate, config.precision, config.device)
    mean = np.trace(tau, axis1=1, axis2=2) / 3.0
    deviator = np.linalg.norm(tau - mean[:, None, None] * np.eye(3), axis=(1, 2))
    components = {f"tau_{name}": tau[:, i, j] for name, (i, j) in _COMPONENTS.items()}
    return pd.DataFrame({"amplitude": amplitude, **components, "pressure": -mean, "dev_norm": deviator})


def point_chart(response: pd.DataFrame, title: str) -> Figure:
    """Components of τ along the path, and the path in pressure and ‖dev τ‖."""
    # An axis scaled to rounding errors would show them as a response.
    stresses = response.set_index("amplitude")
    response = stresses.where(stresses.abs() > 1e-9 * stresses.abs().to_numpy().max(), 0.0).reset_index()
    with styled():
        figure = Figure(figsize=(9.0, 3.8), layout="constrained")
        along, plane = figure.subplots(1, 2)
        figure.suptitle(title)
        shown = [c for c in response if c.startswith("tau_") and np.abs(response[c]).max() > 0]
        for name, colour in zip(shown, PALETTE, strict=False):
            along.plot(response["amplitude"], response[name], color=colour, label=name.replace("tau_", "τ "))
        along.set(xlabel="path parameter [1]", ylabel="Kirchhoff stress τ [Pa]")
        along.legend(ncols=2)
        plane.plot(response["pressure"], response["dev_norm"], color=PALETTE[0])
        plane.set(xlabel="pressure −tr τ/3 [Pa]", ylabel="‖dev τ‖ [Pa]")
    return figure


def plot_point(config: DictConfig) -> Path:
    """Write chart and table of a material point; says where.

    Raises:
        ConfigError: as `point_response`.
        StorageError: the disk refused a file.
    """
    with configuration.naming_the_missing():
        response = point_response(config)
        folder = configuration.text("point.folder", config.point.folder)
    name = config.material["_target_"].rsplit(".", 1)[-1]
    stem = Path(folder) / f"{name}_{config.path}"
    with writing(stem.with_suffix(".csv")) as partial:
        response.to_csv(partial, index=False)
    with writing(stem.with_suffix(".png")) as partial:
        point_chart(response, f"{name}, {config.path.replace('_', ' ')}").savefig(partial, dpi=150)
    pressure, deviator = response["pressure"], response["dev_norm"].max()
    print(
        f"{name} along {config.path}, amplitude {config.point.amplitude:g}: "
        f"pressure from {pressure.min():.6g} to {pressure.max():.6g} Pa, ‖dev τ‖ up to {deviator:.6g} Pa"
    )
    print(f"wrote {stem.with_suffix('.png')} and {stem.with_suffix('.csv')}")
    return stem.with_suffix(".png")
