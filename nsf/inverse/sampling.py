"""Uncertainty: parameters drawn from stated distributions, and what runs by recurrence make of them."""

import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from scipy import stats
from torch import Tensor

from nsf import words
from nsf.data import Trajectory
from nsf.errors import ConfigError, InstabilityError
from nsf.evaluation.quantities import QUANTITIES
from nsf.extras import optional
from nsf.inverse.model import Forcing, Model
from nsf.inverse.observations import Observations, View, is_scalar
from nsf.inverse.space import Space
from nsf.vectors import spaced

#: Runs that are taken together.
_BATCH = 500
#: Times at which quantiles are told, at most.
_TIMES = 21
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
_CALL = re.compile(r"(\w+)\((.*)\)")
_ENDS = 1e-9  # of a distribution, beyond which nothing is drawn


def distribution(text: str):
    """The frozen distribution of scipy.stats that `norm(30, 2)` stands for, or `LOW..HIGH`, which is uniform.

    Raises:
        ConfigError: there is no such distribution, or it refuses its numbers.
    """
    if len(ends := text.split("..")) == 2:
        low, high = (words.number("LOW..HIGH", end.strip()) for end in ends)
        if not low < high:
            raise ConfigError(f"{text} has nothing between its ends; give the smaller one first")
        return stats.uniform(low, high - low)
    match = _CALL.fullmatch(text)
    family = getattr(stats, match[1], None) if match else None
    if not isinstance(family, stats.rv_continuous):
        raise ConfigError(f"{text} is no distribution; give one of scipy.stats, as norm(30,2), or LOW..HIGH")
    numbers = [words.number(match[1], part.strip()) for part in match[2].split(",")]
    try:
        frozen = family(*numbers)
        spread = frozen.std()
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{text}: {error}; see scipy.stats.{match[1]}") from error
    if not (np.isfinite(spread) and spread > 0.0):
        raise ConfigError(f"{text} has no finite spread; see scipy.stats.{match[1]} for its numbers")
    return frozen


@dataclass(frozen=True)
class Prior:
    """The prior of the parameters, which are independent.

    Attributes:
        model: whose they are; each: a frozen distribution of scipy.stats by name, in the model's order.
    """

    model: Model
    each: Mapping[str, object]

    @classmethod
    def of(cls, model: Model, texts: Mapping[str, str]) -> "Prior":
        """From texts by name; evenly over the range that was taught, or over its logarithm, of the others.

        Raises:
            ConfigError: a name is unknown, a text no distribution, or a range goes beyond what was taught.
        """
        if unknown := [name for name in texts if name not in model.names]:
            raise ConfigError(f"there is no parameter {unknown[0]!r}; there are {', '.join(model.names)}")
        each = {}
        for name, (low, high) in zip(model.names, model.ranges.tolist(), strict=True):
            if name not in texts:
                log = model.scene.parameters[name].log
                each[name] = stats.loguniform(low, high) if log else stats.uniform(low, high - low)
                continue
            each[name] = distribution(texts[name])
            if ".." in texts[name]:
                Space.of(model, {name: each[name].support()})
        return cls(model, each)

    def values(self, u: np.ndarray) -> np.ndarray:
        """Parameters [..., n] of points [..., n] of the unit cube, by the inverse distribution functions."""
        u = np.clip(u, _ENDS, 1.0 - _ENDS)
        return np.stack([marginal.ppf(u[..., k]) for k, marginal in enumerate(self.each.values())], -1)

    def draw(self, count: int, seed: int, taught: bool = False) -> np.ndarray:
        """[count, n] parameters; those within what was taught alone where that is asked for.

        Raises:
            ConfigError: nothing of a distribution is within.
        """
        u = np.random.default_rng(seed).random((count, len(self.each)))
        if taught:
            for k, (name, marginal) in enumerate(self.each.items()):
                least, most = self.model.ranges[k]
                low, high = marginal.cdf([least, most])
                if high - low < _ENDS:
                    raise ConfigError(
                        f"the distribution of {name} has nothing within what was taught, "
                        f"{least:g}..{most:g}; give another, or train with a wider range"
                    )
                u[:, k] = low + u[:, k] * (high - low)
        return self.values(u)

    def log_density(self, values: np.ndarray) -> np.ndarray:
        """[...] of parameters [..., n]; −∞ outside of what was taught."""
        density = sum(marginal.logpdf(values[..., k]) for k, marginal in enumerate(self.each.values()))
        low, high = self.model.ranges.T
        inside = np.all((values >= low) & (values <= high), axis=-1)
        return np.where(inside, density, -np.inf)


class Scalars:
    """Scalars of runs at a few times: quantities of the shape, and components of points, as `z@X:Y:Z`.

    Args:
        names: of the scalars.
        model: of the runs.

    Attributes:
        names: of the scalars; t: [F] times [s], the end among them.

    Raises:
        ConfigError: a name is neither, or a point lies outside of the body.
    """

    def __init__(self, names: Sequence[str], model: Model):
        if wrong := [name for name in names if not is_scalar(name)]:
            raise ConfigError(
                f"of={wrong[0]} is none of {', '.join(QUANTITIES)}, nor a component of a point at rest, as "
                "z@0.5:0.5:0.2"
            )
        self.names, looks = tuple(dict.fromkeys(names)), spaced(len(model.t), _TIMES)
        self.t = model.t[looks]
        every = Observations.of_scalars(dict.fromkeys(self.names, 0.0), self.t)
        self._view = View(every, model, looks)

    def of(self, xhat: Tensor) -> Tensor:
        """[B, scalars, F] of runs [B, N + 1, r], differentiable [m]."""
        return self._view.of_runs(xhat).unflatten(1, (len(self.t), -1)).transpose(1, 2)

    def of_truth(self, truth: Trajectory) -> np.ndarray:
        """[scalars] of a full-order run at its end."""
        return self._view.of_truth(truth)[-len(self.names) :]


@dataclass(frozen=True)
class Runs:
    """Runs at many parameters.

    Attributes:
        parameters: [B, n]; values: [B, scalars, F] [m]; t: [F] [s]; names: of the scalars.
        error_bound: [B] shares of the displacement; limit: above which a run is not to be believed.
        seconds: wall time.
    """

    parameters: np.ndarray
    values: np.ndarray
    error_bound: np.ndarray
    limit: float
    t: np.ndarray
    names: tuple[str, ...]
    seconds: float

    @property
    def trusted(self) -> np.ndarray:
        """[B] whether a run is to be believed, as far as a bound tells: NaN tells nothing."""
        return ~(self.error_bound > self.limit) & np.isfinite(self.values).all((1, 2))

    @property
    def doubts(self) -> str:
        """How many runs are distrusted, or that nothing tells."""
        if np.isnan(self.error_bound).any():
            return "whose errors no bound tells (set scene.design.validation)"
        return f"{int((~self.trusted).sum()):,} of them distrusted and left out"

    def quantiles(self) -> dict[str, np.ndarray]:
        """[`LEVELS`, F] of trusted runs, by name.

        Raises:
            InstabilityError: no run is to be believed.
        """
        if not self.trusted.any():
            raise InstabilityError("no run is to be believed; draw parameters within what was taught")
        quantiles = np.quantile(self.values[self.trusted], LEVELS, axis=0)
        return {name: quantiles[:, k] for k, name in enumerate(self.names)}


def runs(model: Model, parameters: np.ndarray, scalars: Scalars, forcing: Forcing | None = None) -> Runs:
    """Runs at parameters [B, n], in batches."""
    began, values, bounds = time.perf_counter(), [], []
    with torch.no_grad():
        for part in np.array_split(parameters, max(1, -(-len(parameters) // _BATCH))):
            mu = model.tensor(part)
            xhat = model(mu, forcing)
            values.append(scalars.of(xhat).cpu().numpy())
            bounds.append(model.error_bound(mu, forcing))
    every = np.concatenate(values), np.concatenate(bounds), model.trust.limit
    return Runs(parameters, *every, scalars.t, scalars.names, time.perf_counter() - began)


def sensitivities(
    prior: Prior,
    count: int,
    evaluate: Callable[[np.ndarray], np.ndarray],
    names: Sequence[str],
    seed: int = 0,
) -> pd.DataFrame:
    """Variance-based indices by Saltelli's design (SALib).

    Args:
        prior: of the parameters.
        count: a power of two; the design has count × (parameters + 2) rows.
        evaluate: parameters [rows, n] → values [rows, scalars].
        names: of the scalars.
        seed: of the design and of the bootstrap.

    Returns:
        Rows of quantity and parameter: `first` and `total`, each with half its 95 % interval.

    Raises:
        MissingExtraError: SALib is not installed.

    Source: Saltelli et al. 2010; Herman and Usher 2017.
    """
    optional("SALib", "inverse")
    from SALib.analyze import sobol as analyze
    from SALib.sample import sobol as sample

    if count < 2 or count & (count - 1):
        raise ConfigError(f"a design of {count} must be of a power of two, as 1024")
    parameters = list(prior.each)
    problem = {"num_vars": len(parameters), "names": parameters, "bounds": [[0.0, 1.0]] * len(parameters)}
    # One parameter has no other beside it, and SALib wants two.
    if len(parameters) == 1:
        problem = {"num_vars": 2, "names": [*parameters, "none"], "bounds": [[0.0, 1.0]] * 2}
    u = sample.sample(problem, count, calc_second_order=False, seed=seed)
    outputs = evaluate(prior.values(u[:, : len(parameters)]))
    rows = []
    for k, name in enumerate(names):
        index = analyze.analyze(problem, outputs[:, k], calc_second_order=False, seed=seed)
        for p, parameter in enumerate(parameters):
            values = [float(index[key][p]) for key in ("S1", "S1_conf", "ST", "ST_conf")]
            rows.append([name, parameter, *values])
    return pd.DataFrame(rows, columns=["quantity", "parameter", "first", "first_95", "total", "total_95"])
