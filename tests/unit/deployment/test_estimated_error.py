"""The estimated error of a run says nothing of steps that another model took."""

from types import SimpleNamespace

import numpy as np
import pytest

from nsf.deployment import Rollout


@pytest.mark.parametrize(
    ("by", "handed_over", "expected"),
    [([0, 0], -1, 0.3), ([0, 1], -1, 0.3), ([1, 1], -1, np.nan), ([0, 0], 0, np.nan), ([0, 0], 1, 0.3)],
)
def test_where_another_model_took_all_steps_nothing_is_estimated(by, handed_over, expected):
    own = {"stops": by, "by": np.array(by), "handed_over": handed_over, "estimate": np.array([0.0, 0.1, 0.3])}
    run = SimpleNamespace(**own)
    run.levels = Rollout.levels.fget(run)
    run.by_latent_model = Rollout.by_latent_model.fget(run)
    np.testing.assert_equal(Rollout.estimated_error.fget(run), expected)
