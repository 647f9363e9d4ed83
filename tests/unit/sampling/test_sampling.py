"""Sample particles by number, region and phase of time (paper section 5.4)."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nsf.errors import ConfigError, ProjectionError
from nsf.sampling import RandomSampler
from nsf.sampling.qdeim import displacement_components
from nsf.sampling.sampler import check_well_posed


@pytest.fixture(scope="module")
def X():
    return np.random.default_rng(5).random((200, 3))


def of(X):
    """As much of a manifold as a random choice needs."""
    return SimpleNamespace(X=torch.as_tensor(X))


def drawn(X, **settings):
    return [phase.particles for phase in RandomSampler(**settings).spans_of(of(X))]


def test_size_and_range(X):
    (particles,) = drawn(X, size=30)
    assert len(particles) == len(set(particles)) == 30
    assert (np.diff(particles) > 0).all()
    assert 0 <= particles[0] < particles[-1] < 200


def test_the_whole_body_may_be_the_sample(X):
    assert drawn(X, size=200)[0].tolist() == list(range(200))


def test_seeds(X):
    one, again, other = (drawn(X, size=30, seed=seed)[0] for seed in (1, 1, 2))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)


def test_no_global_seed(X):
    np.random.seed(0)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    drawn(X, size=30)
    assert np.array_equal(before, np.random.get_state()[1])  # noqa: NPY002


def test_region(X):
    (particles,) = drawn(X, size=20, lower=[0.0, 0.5, 0.0], upper=[0.6, 1.0, 1.0])
    inside = X[particles]
    assert (inside[:, 0] <= 0.6).all()
    assert (inside[:, 1] >= 0.5).all()
    assert len(particles) == 20


def test_a_later_smaller_phase_is_a_part_of_the_earlier(X):
    sampler = RandomSampler(size=60, phases=[{"start": 0.5, "size": 25}])
    first, later = sampler.spans_of(of(X))
    assert (first.start, later.start) == (0.0, 0.5)
    assert (len(first.particles), len(later.particles)) == (60, 25)
    assert set(later.particles) < set(first.particles)


def test_a_phase_has_its_own_region(X):
    first, later = drawn(X, size=40, phases=[{"start": 0.25, "size": 10, "lower": [0.5, 0.0, 0.0]}])
    assert (X[later][:, 0] >= 0.5).all()
    assert (X[first][:, 0] < 0.5).any()


@pytest.mark.parametrize(
    ("settings", "quoted"),
    [
        ({"size": 0}, "sampler.size=0 must be a whole number of at least 1"),
        (
            {"size": 5, "phases": [{"start": 0.5, "size": -1}]},
            "sampler.size=-1 must be a whole number of at least 1",
        ),
        ({"size": 5, "phases": [{"start": 0.0, "size": 3}]}, "sampler.phases start at [0.0, 0.0] of T"),
        ({"size": 5, "phases": [{"start": 1.0, "size": 3}]}, "sampler.phases start at [0.0, 1.0] of T"),
        (
            {"size": 5, "phases": [{"start": 0.6, "size": 3}, {"start": 0.3, "size": 3}]},
            "rising fractions in (0, 1)",
        ),
        ({"size": 2.5}, "sampler.size"),
        ({"size": "many"}, "sampler.size"),
        ({"size": 5, "phases": [{"start": 0.5, "sise": 3}]}, "sise"),
        ({"size": 5, "phases": [{"size": 3}]}, "sampler.phases"),
        ({"size": 5, "lower": [0.0, 0.0]}, "sampler.lower"),
    ],
    ids=str,
)
def test_refused(X, settings, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        drawn(X, **settings)


@pytest.mark.parametrize(
    ("settings", "held"),
    [({"size": 201}, "scene has 200"), ({"size": 1, "lower": [2.0, 2.0, 2.0]}, "region holds 0")],
)
def test_a_region_with_too_few_particles(X, settings, held):
    wanted = re.escape(f"sampler.size={settings['size']}, but the {held} particles")
    with pytest.raises(ConfigError, match=wanted):
        drawn(X, **settings)


def test_fewer_equations_than_unknowns():
    with pytest.raises(ProjectionError) as refusal:
        check_well_posed(1, 6)
    assert (
        str(refusal.value)
        == "|S|=1 gives 3 equations for r=6 unknowns; choose sampler.size >= 2 or latent_dim <= 3"
    )
    with pytest.raises(ProjectionError, match=r"choose sampler.size >= 3 or latent_dim <= 6$"):
        check_well_posed(2, 7)
    check_well_posed(2, 6)  # exactly as many equations as unknowns


def test_displacement_components(tiny_manifold):
    """They are those of a singular value decomposition of all snapshots."""
    components = displacement_components(tiny_manifold, 5).flatten(0, 1)
    u = tiny_manifold.restrict().position(tiny_manifold.training_latents)
    u = (u - u.mean(0)).flatten(1).T / len(u) ** 0.5
    left, singular, _ = torch.linalg.svd(u, full_matrices=False)
    assert len(u.T) <= 256  # so that none is passed over
    assert torch.allclose(components.norm(dim=0), singular[:5], rtol=1e-6)
    assert torch.allclose((left[:, :5] * components).sum(0).abs(), singular[:5], rtol=1e-6)
