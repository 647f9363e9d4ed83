"""Von Mises plasticity whose flow stress is a function of the plastic strain."""

import ast
import inspect
import math
import textwrap
from abc import abstractmethod
from dataclasses import dataclass, fields
from functools import cache
from types import FunctionType

import numpy as np

from nsf.errors import ConfigError
from nsf.mpm.materials.base import LawFunctions, Material
from nsf.mpm.materials.hencky import hencky_stretches, hencky_tau
from nsf.mpm.materials.von_mises import von_mises_update
from nsf.mpm.precision import Precision

#: [-] plastic strains at which a flow stress is checked.
_CHECKED = (0.0, *np.geomspace(1e-4, 10.0, 51).tolist())


@cache
def _functions(law: type, precision: Precision) -> LawFunctions:
    import warp as wp

    real = precision.real
    constants = {"__annotations__": {field.name: real for field in fields(law)}, "__module__": law.__module__}
    Params = wp.struct(type(f"{law.__name__}Params", (), constants))
    flow_stress = wp.func(_annotated(law.flow_stress, Params, real))

    @wp.func
    def bound(gamma: real, params: Params):
        return flow_stress(params, gamma)

    @wp.func
    def strained(gamma: real, flowed: real, mu: real, params: Params):
        return gamma + flowed

    update = von_mises_update(precision, bound, strained, Params)
    return LawFunctions(hencky_tau(precision), None, Params, update)


def _annotated(method, *types: type) -> FunctionType:
    """A copy of a method, as a function of arguments of these types."""
    copy = FunctionType(method.__code__, method.__globals__, method.__name__)
    copy.__annotations__ = dict(zip(method.__code__.co_varnames, types, strict=False))
    copy.__module__, copy.__qualname__ = method.__module__, method.__qualname__
    return copy


@cache
def _check_numbers(law: type) -> None:
    """Refuse numbers in the text of a flow stress, which Warp would take for fp32 and int."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(law.flow_stress)))
    calls = [
        node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Call)
    ]
    typed = {part for call in calls for value in call.args for part in ast.walk(value)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and node not in typed:
            gamma = law.flow_stress.__code__.co_varnames[1]
            raise ConfigError(
                f"{law.__name__}.flow_stress has the number {node.value}; write type({gamma})({node.value}), "
                "which has the precision of a run"
            )


@dataclass(frozen=True)
class IsotropicHardening(Material):
    """Solid whose ‖dev τ‖ is bounded by a flow stress of the plastic strain: any τ_Y = f(γ) in one method.

    A law derives from it, declares its constants as fields, and defines `flow_stress`, which takes plain
    arithmetic and functions of `math` and is compiled for each precision. It inherits `E` and `nu`, and one
    history variable a particle: γ, the sum of δγ = ‖dev ε‖ − τ_Y/(2μ) over its returns as in `VonMises`,
    zero at rest. √(2/3) γ is the equivalent plastic strain, √1.5 τ_Y the yield stress in uniaxial stress.

    Each return goes to the flow stress before the step, so that ‖dev τ‖ lags by one step.

    Raises:
        ConfigError: a flow stress is not positive and finite, or has bare numbers.
    """

    def __post_init__(self):
        super().__post_init__()
        _check_numbers(type(self))
        for gamma in _CHECKED:
            try:
                stress = float(self.flow_stress(gamma))
            except (ArithmeticError, ValueError) as error:
                stress = error
            if not (isinstance(stress, float) and 0.0 < stress < math.inf):
                raise ConfigError(
                    f"{type(self).__name__}.flow_stress({gamma:.3g})={stress} Pa must be positive and finite"
                )

    @abstractmethod
    def flow_stress(self, gamma: float) -> float:
        """τ_Y [Pa], the largest ‖dev τ‖, at the accumulated plastic strain γ."""

    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions."""
        return _functions(type(self), precision)

    def stretches_of(self, principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """[P, 3] stretches of [P, 3] principal stresses, in closed form."""
        return hencky_stretches(principal, mu, lam)
