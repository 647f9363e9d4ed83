"""Constitutive laws (paper, appendix "Elasticity and plasticity details").

Names are imported on first use, and Warp by the functions that make kernels: laws are checked without it.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.mpm.materials.base import (
        LawFunctions,
        Material,
        make_elastic_stress,
        make_law_update,
        make_stress_update,
    )
    from nsf.mpm.materials.driver import PATHS, deformation_path, drive
    from nsf.mpm.materials.drucker_prager import DruckerPrager
    from nsf.mpm.materials.fixed_corotated import FixedCorotated
    from nsf.mpm.materials.hardening import IsotropicHardening
    from nsf.mpm.materials.hencky import Hencky
    from nsf.mpm.materials.herschel_bulkley import HerschelBulkley
    from nsf.mpm.materials.von_mises import VonMises, VonMisesHardening, VonMisesSoftening

__all__ = [
    "PATHS",
    "DruckerPrager",
    "FixedCorotated",
    "Hencky",
    "HerschelBulkley",
    "IsotropicHardening",
    "LawFunctions",
    "Material",
    "VonMises",
    "VonMisesHardening",
    "VonMisesSoftening",
    "deformation_path",
    "drive",
    "make_elastic_stress",
    "make_law_update",
    "make_stress_update",
]

__getattr__ = on_first_use(__name__)
