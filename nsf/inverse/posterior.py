"""The posterior of the parameters given observations, by emcee."""

from dataclasses import dataclass

import numpy as np
import torch

from nsf.errors import InstabilityError
from nsf.extras import optional
from nsf.inverse.fit import Fit
from nsf.inverse.model import Forcing
from nsf.inverse.observations import View
from nsf.inverse.sampling import Prior

_WALKERS, _TRIED = 64, 512  # of the sampler, and points of the prior and about the estimate to begin at
_STEPS, _MOST_STEPS = 100, 2000  # of the chain between looks at its length, and at most
_LENGTH = 50.0  # autocorrelation times that a chain should have, as emcee has it
_ACCEPTED = 0.1  # share of its proposals


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
