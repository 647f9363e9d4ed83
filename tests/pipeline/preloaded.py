"""Imported once by the server whose forks are commands: modules of stages, and the configuration composed."""

import importlib
import pkgutil

from tiny import TINY

from nsf import config
from nsf.pipeline import stages

for name in (
    *("torch", "warp", "pytorch_lightning", "h5py", "scipy.spatial", "matplotlib.backends.backend_svg"),
    *("nsf.cli", "nsf.pipeline.sweeps.jobs", "nsf.pipeline.sweeps.experiment", "nsf.results.report"),
    *(f"nsf.pipeline.stages.{module.name}" for module in pkgutil.iter_modules(stages.__path__)),
):
    importlib.import_module(name)
config.load(TINY)
