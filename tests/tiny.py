"""The tiny chain that tests, the fuzzer and references of a GPU run."""

#: A column of 500 particles on a grid of 50³, 24 steps: a second for the whole chain.
TINY = (
    "scene=sand",
    "device=cpu",
    "scene.dx=0.02",
    "scene.dt=0.005",
    "scene.steps=24",
    "scene.bodies.column.particles=500",
    "scene.design.train=[22,30,38]",
    "scene.design.validation=[]",
    "scene.design.test=[26]",
    "field.modes=[8,8,8]",
    "field.beta=4",
    "field.depth=1",
    "trainer.steps=200",
    "latent_dim=4",
    "sampler.size=20",
    "evaluation.trials=1",
    "evaluation.picture_particles=100",
    "evaluation.picture_frames=3",
)

#: Keys by which a recurrence is taught on the tiny chain: hardly, in two seconds.
TAUGHT = (
    "model=recurrence", "model.runs=8", "model.stress=4", "model.stride=2", "model.members=2",
    "model.descents=180", "model.width=32",
)  # fmt: skip


def tiny_pipeline(root, *overrides, say=None):
    """The tiny chain, or a variant of it, with its runs under `root`."""
    from nsf import config
    from nsf.pipeline import Pipeline

    return Pipeline(config.load([*TINY, *overrides]), say=say or (lambda line: None), root=root)
