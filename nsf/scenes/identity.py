"""What makes two scenes the same physics."""

from omegaconf import OmegaConf

from nsf.runs.canonical import content_hash

#: Keys of a scene that its simulation does not depend on.
NOT_PHYSICS = ("parameters", "design", "reduced", "paper", "title")
#: Keys that operators take as input.
_INPUT = ("gravity", "forcing", "program")


def physics_hash(scene) -> str:
    """Hash of a scene's physics but for its forcing, initial velocities and the values of its parameters."""
    template = scene.template.copy()
    for parameter in scene.parameters.values():
        OmegaConf.update(template, parameter.key, None)
    template = OmegaConf.to_container(template, resolve=False)
    content = {key: template[key] for key in ("scale", "material", "transfer")}
    content["scene"] = {k: v for k, v in template["scene"].items() if k not in (*NOT_PHYSICS, *_INPUT)}
    bodies = content["scene"]["bodies"]
    content["scene"]["bodies"] = {
        name: {key: value for key, value in body.items() if key != "velocity"}
        for name, body in bodies.items()
    }
    return content_hash(content)
