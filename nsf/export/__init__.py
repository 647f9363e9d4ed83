"""Reduced runs for other programs: each format has one module here and one line in `FORMATS`.

The module has `write(playback, folder)`, which gives the path to open, and `NEEDS`, the modules of the extra
`export` that it uses.
"""

FORMATS = {
    "html": "one self-contained page that plays in a browser, without a network",
    "usd": "points with time samples for usdview, Omniverse, Blender or Houdini (.usdc)",
    "vtk": "points with stress and displacement for ParaView 5.12 or newer (.vtkhdf)",
    "onnx": "the three fields as graphs, and the run's latent vectors to feed them",
    "frames": "a picture of each frame (.png) and a film of all (.mp4)",
}

__all__ = ["FORMATS"]
