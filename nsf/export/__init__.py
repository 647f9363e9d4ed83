"""Reduced runs for other programs: each format has one line in `FORMATS` and a module.

The module has `write(playback, folder)`, which gives the path to open, and `NEEDS`, the modules of the extra
`export` that it uses. Of `live` it is `nsf.live.publish`.
"""

FORMATS = {
    "html": "one self-contained page that plays in a browser, without a network",
    "live": "the model itself in one page that runs, is steered and mailed; needs model=recurrence",
    "usd": "points with time samples for usdview, Omniverse, Blender or Houdini (.usdc)",
    "vtk": "points with stress and displacement for ParaView 5.12 or newer (.vtkhdf)",
    "onnx": "the three fields as graphs, and the run's latent vectors to feed them",
    "frames": "a picture of each frame (.png) and a film of all (.mp4)",
}

__all__ = ["FORMATS"]
