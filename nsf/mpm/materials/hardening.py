"""Von Mises plasticity whose flow stress is a function of the equivalent plastic strain."""

import ast
import hashlib
import inspect
import linecache
import math
import textwrap
from abc import abstractmethod
from dataclasses import dataclass, fields
from functools import cache
from types import FunctionType

import numpy as np

from nsf.errors import ConfigError, first_line
from nsf.mpm.materials.base import LawFunctions, Material
from nsf.mpm.materials.hencky import hencky_stretches, hencky_tau
from nsf.mpm.materials.von_mises import deviator_norm, von_mises_update
from nsf.mpm.precision import Precision

#: ‖dev τ‖ of a tensile stress, and equivalent plastic strain of γ: √(2/3) of it.
_TENSILE = math.sqrt(2.0 / 3.0)
#: [-] equivalent plastic strains at which a flow stress is checked.
_CHECKED = (0.0, *np.geomspace(1e-4, 10.0, 51).tolist())
_HALVINGS = 30  # of the bracket between two of these, down to 3e-10 of the larger


@cache
def _functions(law: type, precision: Precision) -> LawFunctions:
    import warp as wp

    real = precision.real
    constants = {"__annotations__": {field.name: real for field in fields(law)}, "__module__": law.__module__}
    Params = wp.struct(type(f"{law.__name__}Params", (), constants))
    flow_stress = wp.func(_typed(law.flow_stress, Params, real))
    tensile = real(_TENSILE)

    @wp.func
    def bound(gamma: real, params: Params):
        return tensile * flow_stress(params, tensile * gamma)

    @wp.func
    def strained(gamma: real, flowed: real, mu: real, params: Params):
        return gamma + flowed

    update = von_mises_update(precision, bound, strained, Params)
    return LawFunctions(hencky_tau(precision), None, Params, update)


def _typed(method: FunctionType, *types: type) -> FunctionType:
    """A method as a function of arguments of these types, its numbers of the type of the second one."""
    tree = ast.fix_missing_locations(_Typed(method).visit(_tree(method)))
    text, made = ast.unparse(tree), {}
    # Warp reads the text of a function where `inspect` has it from.
    file = f"<{method.__module__}.{method.__qualname__} {hashlib.sha256(text.encode()).hexdigest()[:12]}>"
    linecache.cache[file] = len(text), None, text.splitlines(keepends=True), file
    exec(compile(text, file, "exec"), method.__globals__, made)
    typed = made[method.__name__]
    typed.__annotations__ = dict(zip(method.__code__.co_varnames, types, strict=False))
    typed.__module__, typed.__qualname__ = method.__module__, method.__qualname__
    return typed


def _tree(method: FunctionType) -> ast.Module:
    return ast.parse(textwrap.dedent(inspect.getsource(method)))


@cache
def _check_text(law: type) -> None:
    """Refuse a flow stress that Python evaluates and Warp cannot compile in each precision."""
    name = f"{law.__name__}.flow_stress"
    method = law.flow_stress
    if not inspect.isfunction(method) or method.__code__.co_argcount != 2 or method.__name__ == "<lambda>":
        raise ConfigError(f"{name} must be a plain method; write def flow_stress(self, p)")
    if method.__code__.co_freevars:
        raise ConfigError(
            f"{name} uses super(), a decorator or a name of an enclosing function, which no run can compile; "
            "write the whole formula from the fields of the law"
        )
    try:
        tree = _tree(method)
    except (OSError, SyntaxError) as error:
        raise ConfigError(
            f"{name} has no readable text ({first_line(error)}); write the class in a file and import it"
        ) from error
    _check_fields(law, tree)


def _check_fields(law: type, tree: ast.AST) -> None:
    """Refuse attributes that the Warp struct of the law's constants lacks."""
    self_name = law.flow_stress.__code__.co_varnames[0]
    constants = {field.name for field in fields(law)}
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(value=ast.Name(id=owner), attr=name) if owner == self_name:
                if name not in constants:
                    raise ConfigError(
                        f"{law.__name__}.flow_stress reads {owner}.{name}, which is no field; "
                        f"declare a field of the law, or compute it from {', '.join(sorted(constants))}"
                    )


class _Typed(ast.NodeTransformer):
    """Gives numbers and constants of modules the type of p: Warp would take them for fp32 and int."""

    def __init__(self, method: FunctionType):
        self._function = method.__name__
        names = method.__code__.co_varnames
        self._strain = names[1]
        self._constants = {key: value for key, value in method.__globals__.items() if key not in names}

    def visit(self, node: ast.AST) -> ast.AST:
        """The node, or its number as `type(p)(number)`."""
        if isinstance(node, ast.FunctionDef) and node.name == self._function:
            node.decorator_list, node.returns, node.args.defaults = [], None, []
            for argument in node.args.args:
                argument.annotation = None  # which need not exist at run time
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Call):
            return node  # has its type
        value = _value(node, self._constants)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return ast.parse(f"type({self._strain})({float(value)!r})", mode="eval").body
        return self.generic_visit(node)


def _value(node: ast.AST, constants: dict):
    """The value of a literal, of a module's constant or of an attribute of a module; else None."""
    match node:
        case ast.Constant(value=value):
            return value
        case ast.Name(id=name):
            return constants.get(name)
        case ast.Attribute(value=ast.Name(id=module), attr=name):
            return getattr(constants.get(module), name, None)
    return None


@dataclass(frozen=True)
class IsotropicHardening(Material):
    """Solid whose von Mises stress is bounded by a flow stress σ_Y = f(p) in one method.

    A law derives from it, declares its constants as fields, and defines `flow_stress` as a tensile test has
    it: σ_Y bounds √1.5 ‖dev τ‖, and p = √(2/3) γ is the equivalent plastic strain. It takes plain arithmetic
    and functions of `math`, and is compiled for each precision. A law inherits `E` and `nu`, and one history
    variable a particle: γ, the sum of δγ = ‖dev ε‖ − √(2/3) σ_Y/(2μ) over its returns as in `VonMises`, zero
    at rest. The `yield_stress` of `VonMises` bounds ‖dev τ‖ itself.

    Each return goes to the flow stress before the step, so that the stress lags by one step.

    Raises:
        ConfigError: a flow stress fails, is not positive and finite, or cannot be compiled.
    """

    def __post_init__(self):
        super().__post_init__()
        _check_text(type(self))
        for p in _CHECKED:
            value = f"{type(self).__name__}.flow_stress({p:.3g})"
            try:
                stress = float(self.flow_stress(p))
            except Exception as error:
                raise ConfigError(
                    f"{value} raises {type(error).__name__}: {first_line(error)}; it must be a positive "
                    "and finite number of Pa, from the fields of the law and functions of math"
                ) from error
            if not 0.0 < stress < math.inf:
                raise ConfigError(f"{value}={stress} Pa must be positive and finite")

    @abstractmethod
    def flow_stress(self, p: float) -> float:
        """σ_Y [Pa], the stress of a tensile test that flows, at the equivalent plastic strain p."""

    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions."""
        return _functions(type(self), precision)

    def stretches_of(self, principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """[P, 3] stretches of [P, 3] principal stresses, in closed form."""
        return hencky_stretches(principal, mu, lam)

    def history_of(self, tau: np.ndarray) -> np.ndarray:
        """[P, 1] lower bound of γ: the least whose flow stress holds τ, zero up to that at rest.

        By bisection between the checked strains. Where no flow stress holds τ, because the law softens
        or saturates below it, γ is that of the largest, and the next return goes to it. As in
        `VonMisesHardening`, the bound misses the hardening of a particle that has unloaded since.

        Args:
            tau: [P, 3, 3] Kirchhoff stress [Pa].
        """
        carried, strains = deviator_norm(tau) / _TENSILE, np.array(_CHECKED)
        stresses = self._flow_stresses(strains)
        upper = np.searchsorted(np.maximum.accumulate(stresses), carried)
        upper = np.minimum(upper, stresses.argmax())
        p, hardened = strains[upper], upper > 0
        low, high, carried = strains[upper[hardened] - 1], p[hardened], carried[hardened]
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            holds = self._flow_stresses(middle) >= carried
            low, high = np.where(holds, low, middle), np.where(holds, middle, high)
        p[hardened] = high
        return p[:, None] / _TENSILE

    def _flow_stresses(self, p: np.ndarray) -> np.ndarray:
        """[n] flow stresses [Pa] at plastic strains [n]; one by one, as `flow_stress` takes numbers."""
        return np.array([self.flow_stress(value) for value in p.tolist()], float)
