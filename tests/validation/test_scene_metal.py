"""The squeezed frame springs back the more, the more it hardens (paper section 6.3)."""

import pytest

import nsf


def spring_back(hardening):
    """Height that the frame regains once the plates let go, as a share of what it had lost."""
    scene = nsf.load_scene("metal", ["scale=small"])
    solver = scene.full_order({"hardening": hardening}, device="cpu")
    z = scene.particles().X[:, 2]
    top, bottom = z > z.max() - scene.dx, z < z.min() + scene.dx
    release = round(scene.solids[0].until / scene.dt)
    heights = [z[top].mean() - z[bottom].mean()]
    for steps in (release, *[10] * ((scene.steps - release) // 10)):
        solver.step(steps)
        z = solver.state.x.numpy()[:, 2]
        heights.append(z[top].mean() - z[bottom].mean())
    return (heights[-1] - min(heights)) / (heights[0] - min(heights))


@pytest.mark.slow
def test_frame_springs_back_more_the_more_it_hardens():
    none, some, much = (spring_back(xi) for xi in (0.0, 0.1, 0.2))
    assert 0.0 < none < 0.75 * some
    assert some < 0.95 * much
    assert much < 0.5  # it stays bent
