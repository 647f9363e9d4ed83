"""Tensor cores are a choice of deployment: one training serves every arithmetic of its networks."""

import pytest

from nsf.errors import ConfigError


@pytest.fixture
def on(tmp_path, tiny):
    """(*overrides) → the tiny chain with the paper's networks."""
    from nsf import config
    from nsf.pipeline import Pipeline

    base = [override for override in tiny if not override.startswith(("field.modes", "field.depth"))]
    return lambda *overrides: Pipeline(
        config.load([*base, "field=mlp", *overrides]), lambda line: None, tmp_path / "runs"
    )


def test_arithmetic_names_the_deployment_alone(on):
    one, two = (on(f"field.arithmetic={name}") for name in ("tf32", "null"))
    assert one.training == two.training == on().training
    assert one.deployment != two.deployment
    assert one.deployment == on().deployment
    with pytest.raises(ConfigError, match=r"field\.arithmetic=fp8 is unknown; choose tf32, bf16 or null"):
        on("field.arithmetic=fp8").check()
