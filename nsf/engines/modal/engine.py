"""The modal engine: which runs it can step, and why not others."""

from collections.abc import Sequence
from typing import ClassVar

from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.integration import Integration
from nsf.dynamics.projection import GaussNewton, Taylor
from nsf.dynamics.setup import Setup
from nsf.dynamics.sources import Sources
from nsf.dynamics.span import Span
from nsf.engines.base import Engine
from nsf.engines.modal.mirrors import edits
from nsf.engines.modal.projection import projection_fits
from nsf.engines.modal.span import ModalSpan
from nsf.kinematics.fields.basis import BasisManifold

#: The classes whose code the kernels mirror; one derived from them may do anything.
_KNOWN = {
    "manifold": (BasisManifold,),
    "projector": (GaussNewton, Taylor),
    "sources": (Sources,),
    "integration": (Integration,),
}
_NAMED = 3  # edited functions that a refusal names


class Modal(Engine):
    """Fields that are modes times coefficients, several runs at once, as compiled kernels.

    It mirrors the text of the reference, and steps nothing while that text is another (`mirrors`).
    """

    name: ClassVar[str] = "modal"

    @override
    def refusal(self, setups: Sequence[Setup]) -> str:
        setup = setups[0]
        for role, classes in _KNOWN.items():
            kind = type(getattr(setup, role))
            if kind not in classes:
                return f"{role} {kind.__name__} is not known to modal"
        if setup.sources.carried:
            return "stress=particles is not known to modal"
        if not setup.manifold.layered:
            return "a network of the field is not one of layers, as modal needs it"
        if len(setups) > 1 and setup.integration.strategy != "superset":
            return (
                f"integration={setup.integration.strategy} needs a whole grid for each of {len(setups)} runs"
            )
        if setup.device.is_cuda and not _closure_fits(setup):
            return "a block of the GPU does not hold the networks of the field"
        if changed := [name.replace(":", ".") for name in edits()]:
            more = f" and {len(changed) - _NAMED} more" if len(changed) > _NAMED else ""
            return f"{', '.join(changed[:_NAMED])}{more} was edited, and modal copies the step as it was"
        return ""

    @override
    def spans(self, batch: Batch) -> Sequence[Span]:
        setup = batch.shared
        return [
            ModalSpan(batch, sample, sets) for sample, sets in zip(setup.samples, setup.sets, strict=True)
        ]


def _closure_fits(setup: Setup) -> bool:
    """Whether a block of a GPU holds what the projection needs of the closure."""
    sizes, r = setup.manifold.hyperparameters, setup.manifold.latent_dim
    K = sizes["modes"][0]
    widths = (r, *[3 * sizes["beta"][0]] * sizes["depth"], K - r)
    return projection_fits(setup.precision, widths if r < K else (), r, K)
