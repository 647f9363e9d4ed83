"""Pictures of bodies for stills and films: arrays, colours and colliders in, figures and files out.

It draws every point that can be seen, without a display. What is interactive is drawn by the page of
`nsf.live`.
"""

from nsf.bodies.colors import Categories, ColorScale
from nsf.bodies.film import film
from nsf.bodies.pictures import Body, closed_radius, frames, grid, hides_inside, is_cut_open, strip

__all__ = [
    "Body",
    "Categories",
    "ColorScale",
    "closed_radius",
    "film",
    "frames",
    "grid",
    "hides_inside",
    "is_cut_open",
    "strip",
]
