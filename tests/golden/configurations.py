"""Keys of the goldens' tiny scenes: the one place that changes where a key is renamed.

The numbers of `values/` stay as they are when a key gets another name.
"""

#: Of every scene. Networks are trained for a step or two, and get their values from `inputs/` afterwards.
EVERY = (
    "device=cpu",
    "data.dtype=float64",
    "scene.design.validation=[]",
    "trainer.steps=2",
    "latent_dim=3",
    "sampler.size=20",
    "evaluation.trials=0",
    "evaluation.picture_particles=20",
    "evaluation.picture_frames=2",
)

SCENES = {
    "bread": (
        "scene.dx=0.02",
        "scene.dt=0.003",
        "scene.steps=12",
        "scene.bodies.slice.particles=120",
        "sampler=random",
        "scene.design.train=[1,13]",
        "scene.design.test=[8]",
    ),
    "cake": (
        "scene.dx=0.03",
        "scene.dt=0.006",
        "scene.steps=16",
        "scene.colliders.spatula.size=[0.09,0.5,0.22]",
        "scene.bodies.cake.particles=120",
        "scene.design.train=[0,28]",
        "scene.design.test=[8]",
    ),
    "sand": (
        "scene.dx=0.03",
        "scene.dt=0.008",
        "scene.steps=16",
        "scene.bodies.column.particles=140",
        "scene.design.train=[22,30,38]",
        "scene.design.test=[26]",
    ),
    "metal": (
        "scene.dx=0.02",
        "scene.dt=0.002",
        "scene.steps=10",
        "scene.bodies.frame.particles=120",
        "sampler=random",
        "scene.design.train=[0,0.2]",
        "scene.design.test=[0.06]",
    ),
    "toothpaste": (
        "scene.dx=0.03",
        "scene.dt=0.008",
        "scene.steps=12",
        "scene.bodies.ribbon.particles=120",
        "scene.design.train=[0,30]",
        "scene.design.test=[7.1]",
    ),
    "jelly_cube": (
        "sampler=random",
        "scene.dx=0.04",
        "scene.dt=0.02",
        "scene.steps=12",
        "scene.bodies.cube.particles=40",
        "scene.bodies.wall.particles=80",
        "scene.design.train=[0.35,0.55]",
        "scene.design.test=[0.5]",
    ),
    "squishy_ball": (
        "scene.dx=0.04",
        "scene.dt=0.015",
        "scene.steps=16",
        "scene.bodies.ball.shape.centre=[0.32,0.5,0.56]",
        "scene.bodies.ball.particles=120",
        "scene.design.train=[20,30]",
        "scene.design.test=[22.5]",
    ),
    "block": (  # under gravity that wanders
        "scene.dx=0.03",
        "scene.dt=0.002",
        "scene.steps=40",
        "scene.bodies.block.particles=120",
        "scene.design.train=4",
        "scene.design.validation=0",
        "scene.design.test=2",
    ),
}
PAPER = ("bread", "cake", "sand", "metal", "toothpaste", "jelly_cube", "squishy_ball")

_TAUGHT = ("model=recurrence", "model.runs=0", "model.members=1", "model.descents=3", "model.width=8")
#: A state of stress, strides of five steps, two members, and the validation program that is asked for.
_STRESS = ("model.stress=2", "model.members=2", "scene.design.validation=1")
_PAPER = ("model=projected", "stress=field", "affine=field")
#: Of every field but the paper's networks.
MODES = ("field.modes=[4,2,2]", "field.beta=4", "field.depth=1", "field.members=1", "field.noise=0.03")
#: By what takes a run's steps.
MODELS = {
    "projected, compiled": (*MODES, *_PAPER),
    "projected, reference": (*MODES, *_PAPER),
    "baseline": (*MODES, "model=projected", "stress=deformation", "affine=none"),
    "history": (*MODES, "model=projected", "stress=particles", "affine=particles"),
    "recurrence": (*MODES, *_TAUGHT, "stress=field", "affine=field"),
    "history recurrence": (*MODES, *_TAUGHT, *_STRESS, "stress=particles", "affine=particles"),
    "networks": (*_PAPER, "field=mlp", "field.beta=2"),
}
#: Models whose runs are built without their stage, as no key says how a step is computed.
BUILT = {"projected, reference": "reference"}
#: (scene, model) of `inputs/` in which an engine is taught.
TAUGHT = (
    ("bread", "recurrence"),
    ("sand", "recurrence"),
    ("toothpaste", "recurrence"),
    ("block", "history recurrence"),
)
NETWORKS = ("sand",)

#: Of a training whose fields are compared themselves.
FEW = ("trainer.steps=3",)
#: Keys that `make.py` adds, where it trains and teaches in earnest.
TRAINED = ("trainer.steps=300",)
TAUGHT_WELL = ("model.descents=300",)

#: (scene, model, further keys) of each row of three experiments.
EXPERIMENTS = {
    "models": [("sand", model, ()) for model in ("projected, compiled", *list(MODELS)[2:5], "networks")],
    "timestep": [
        ("bread", "projected, compiled", (f"deploy.dt_multiplier={multiplier}",)) for multiplier in (1.0, 2.0)
    ],
    "forcing": [("block", model, ()) for model in ("history", "history recurrence")],
}
