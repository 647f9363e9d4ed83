"""The scales of a recurrence, of the runs that teach it."""

import torch
from torch import Tensor

from nsf.recurrence.descent import Runs
from nsf.recurrence.fitting import Fitting
from nsf.recurrence.form import Form, Sizes
from nsf.recurrence.solids import principal


def standardised(runs: Runs, fitting: Fitting, dt: float, stride: int, programs: bool, seed: int) -> Form:
    """A recurrence that accelerates nothing yet, with the scales of the runs, in fp64.

    Args:
        runs: that teach; fitting: widths and members.
        dt: step of the full-order run [s]; stride: steps of one of the recurrence.
        programs: whether the runs follow forcing programs.
        seed: of the weights.
    """
    c_mean, c_matrix = principal(list(runs.features.transpose(0, 1).numpy()), programs)
    sizes = Sizes(
        latents=runs.xhat.shape[-1], stress=runs.stress.shape[-1], parameters=runs.parameters.shape[1],
        features=len(c_mean), states=c_matrix.shape[1], gravity=bool(runs.gravity.any()),
        width=fitting.width, members=fitting.members,
    )  # fmt: skip
    form, changes = Form(sizes, dt, stride, seed).double(), runs.changes
    scales = {
        "x_mean": runs.xhat.flatten(0, 1).mean(0), "x_scale": _deviation(runs.xhat),
        "d_scale": _deviation(changes), "a_scale": _deviation(torch.diff(changes, dim=0)),
        "mu_mean": runs.parameters.mean(0), "mu_scale": _spread(runs.parameters),
        "s_mean": runs.stress.flatten(0, 1).mean(0), "s_scale": _deviation(runs.stress),
        "t_scale": _deviation(torch.diff(runs.stress, dim=0)),
        "c_mean": torch.as_tensor(c_mean), "c_matrix": torch.as_tensor(c_matrix),
        "g_mean": runs.gravity.flatten(0, 1).mean(0),
        "g_scale": _gravity_scale(runs.gravity),
    }  # fmt: skip
    for name, value in scales.items():
        getattr(form, name).copy_(value)
    return form


def _deviation(values: Tensor) -> Tensor:
    """Deviation [k] of [N, R, k]; of what hardly varies a billionth of the largest."""
    if not values.shape[-1]:
        return values.new_ones(0)
    rows = values.flatten(0, -2)
    deviation = rows.std(0, correction=min(1, len(rows) - 1))
    return deviation.clamp_min(1e-9 * float(deviation.max().clamp_min(1e-30)))


def _spread(values: Tensor) -> Tensor:
    """Deviation [n] of rows, 1 where there is none but for round-off."""
    deviation = values.std(0, correction=0)
    return torch.where(deviation > 1e-9 * values.abs().amax(0), deviation, 1.0)


def _gravity_scale(gravity: Tensor) -> Tensor:
    """Deviation of gravity; its size where it hardly varies."""
    rows = gravity.flatten(0, -2)
    spread = (rows - rows.mean(0)).square().mean().sqrt()
    size = rows.norm(dim=1).max().clamp_min(1e-30)
    return spread if spread > 1e-3 * size else size
