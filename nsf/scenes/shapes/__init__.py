"""Shapes of bodies: their volumes in closed form, what they contain, and points spread in them."""

from nsf.scenes.shapes.geometry import Ball, Box, Cylinder, Frame, Lattice, QuarterCylinder, Shape
from nsf.scenes.shapes.mesh import Mesh, mesh_or_ball
from nsf.scenes.shapes.ribbon import Ribbon
from nsf.scenes.shapes.tentacle_ball import TentacleBall

__all__ = [
    "Ball",
    "Box",
    "Cylinder",
    "Frame",
    "Lattice",
    "Mesh",
    "QuarterCylinder",
    "Ribbon",
    "Shape",
    "TentacleBall",
    "mesh_or_ball",
]
