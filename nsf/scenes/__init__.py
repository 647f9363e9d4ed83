"""Scenes (paper section 6): one yaml each in `conf/scene`.

Names are imported on first use: shapes and designs can be checked without Warp.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.scenes.body import Body
    from nsf.scenes.designs import Design, Grid, LatinHypercube, Sobol, Values
    from nsf.scenes.inclination import Inclination
    from nsf.scenes.parameters import Parameter
    from nsf.scenes.programs import (
        GravityCurve,
        GravityProgram,
        Keyframes,
        MotionProgram,
        Programs,
        RandomPress,
        RandomPush,
        RandomShake,
        RandomTilt,
    )
    from nsf.scenes.scene import Scene
    from nsf.scenes.shapes import (
        Ball,
        Box,
        Cylinder,
        Frame,
        Lattice,
        Mesh,
        QuarterCylinder,
        Ribbon,
        Shape,
        TentacleBall,
        mesh_or_ball,
    )
    from nsf.scenes.weakness import Weakness

__all__ = [
    "Ball",
    "Body",
    "Box",
    "Cylinder",
    "Design",
    "Frame",
    "GravityCurve",
    "GravityProgram",
    "Grid",
    "Inclination",
    "Keyframes",
    "LatinHypercube",
    "Lattice",
    "Mesh",
    "MotionProgram",
    "Parameter",
    "Programs",
    "QuarterCylinder",
    "RandomPress",
    "RandomPush",
    "RandomShake",
    "RandomTilt",
    "Ribbon",
    "Scene",
    "Shape",
    "Sobol",
    "TentacleBall",
    "Values",
    "Weakness",
    "mesh_or_ball",
]

__getattr__ = on_first_use(__name__)
