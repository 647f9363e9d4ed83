"""Uncertainty: parameters drawn from stated distributions or a posterior, and runs by recurrence at them."""

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
from nsf.extras import optional
from nsf.inverse.columns import check_scalars
from nsf.inverse.fit import Fit
from nsf.inverse.model import Forcing, Model
from nsf.inverse.observations import Observations, View
from nsf.inverse.space import Space
from nsf.vectors import spaced

#: Runs that are taken together.
_BATCH = 500
#: Times at which quantiles are told, at most.
_TIMES = 21
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
_CALL = re.compile(r"(\w+)\((.*)\)")
_ENDS = 1e-9  # of a distribution, beyond which nothing is drawn
_WALKERS, _TRIED = 64, 512  # of the sampler, and points of the prior and about the estimate to begin at
_STEPS, _MOST_STEPS = 100, 2000  # of the chain between looks at its length, and at most
_LENGTH = 50.0  # autocorrelation times that a chain should have, as emcee has it
_ACCEPTED = 0.1  # share of its proposals


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
        check_scalars(names)
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


@dataclass(frozen=True)
class Posterior:
    """Draws of the parameters given observations, and whether the chain that gave them ran for long enough.

    Attributes:
        values: [draws, n] parameters.
        steps: of the chain; length: of it, in autocorrelation times of the slowest parameter.
        accepted: share of the proposals.
    """

    values: np.ndarray
    steps: int
    length: float
    accepted: float

    @property
    def text(self) -> str:
        """How the draws were made."""
        return (
            f"{len(self.values):,} draws from the second half of {self.steps:,} steps, "
            f"{self.length:.3g} autocorrelation times; {100 * self.accepted:.0f} % of the proposals accepted"
        )

    @property
    def warnings(self) -> list[str]:
        """A sentence on a chain that ran too short or stood still; none on a good one."""
        if self.length >= _LENGTH and self.accepted >= _ACCEPTED:
            return []
        return [
            f"the sampler's chain is {self.length:.3g} autocorrelation times long, of {_LENGTH:g}, and "
            f"accepts {100 * self.accepted:.0f} % of the proposals, of {100 * _ACCEPTED:g} % at least; its "
            "quantiles are rough; give a wider prior, or observations that tell the parameters apart"
        ]


def posterior(
    prior: Prior,
    view: View,
    best: Fit,
    draws: int,
    forcing: Forcing | None = None,
    seed: int = 0,
) -> Posterior:
    """Draws of the parameters given observations, by emcee's affine-invariant ensemble.

    The likelihood is that of what the observations say of the parameters: A (y − m(θ))/s less what validation
    runs are off on average, with the covariance of the estimate (`nsf.inverse.fit`). So it knows of the
    reduced model's own error. Walkers begin where the posterior is highest among points of the prior and
    about the estimate; the chain goes on until it is `_LENGTH` autocorrelation times long, or for
    `_MOST_STEPS`, and its first half is dropped.

    Args:
        prior: of the parameters.
        view: of the observations; best: their fit, of every parameter.
        draws: how many.
        forcing, seed: of the runs, and of the ensemble.

    Raises:
        ConfigError: the prior leaves nothing of what was taught.
        InstabilityError: fewer points than walkers have a posterior above 0.
        MissingExtraError: emcee is not installed.

    Source: Goodman and Weare 2010; Foreman-Mackey et al. 2013.
    """
    emcee = optional("emcee", "inverse")
    model, space = prior.model, best.space
    precision = np.linalg.inv(best.covariance)
    shift = best.u - space.units(best.fitted)
    low, high = model.ranges.T

    def log_probability(values: np.ndarray) -> np.ndarray:
        prior_density = prior.log_density(values)
        with torch.no_grad():
            inside = np.clip(values, low, high)
            seen = view.of_runs(model(model.tensor(inside), forcing)).cpu().numpy()
        off = (view.observations.values - seen) @ best.project.T + shift
        likelihood = -0.5 * np.einsum("bi,ij,bj->b", off, precision, off)
        return np.where(np.isfinite(likelihood), likelihood, -np.inf) + prior_density

    generator = np.random.default_rng(seed)
    deviation = np.minimum(np.sqrt(np.diag(best.covariance)), 0.1)
    about = best.u + deviation * generator.standard_normal((_TRIED, len(space.free)))
    about = space.values(torch.as_tensor(np.clip(about, 1e-3, 1.0 - 1e-3))).numpy()
    tried = np.concatenate([prior.draw(_TRIED, seed, taught=True), about])
    heights = log_probability(tried)
    if np.isfinite(heights).sum() < _WALKERS:
        raise InstabilityError("hardly a run of the prior stays finite; give a prior within what was taught")
    begin = tried[np.argsort(-heights, kind="stable")[:_WALKERS]]
    sampler = emcee.EnsembleSampler(_WALKERS, len(space.free), log_probability, vectorize=True)
    sampler.random_state = np.random.RandomState(seed).get_state()  # emcee's own
    steps, length = 0, 0.0
    while length < _LENGTH and steps < _MOST_STEPS:
        sampler.run_mcmc(begin if not steps else None, _STEPS)
        steps += _STEPS
        length = steps / float(np.max(sampler.get_autocorr_time(discard=steps // 2, tol=0)))
        length = length if np.isfinite(length) else 0.0  # of walkers that stand still
    chain = sampler.get_chain(discard=steps // 2, flat=True)
    drawn = chain[np.linspace(0, len(chain) - 1, draws).round().astype(int)]
    return Posterior(drawn, steps, length, float(sampler.acceptance_fraction.mean()))
