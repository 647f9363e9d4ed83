"""The kernel that inverts the deformation field in the coefficients of its modes.

A GPU takes a block for each run, a CPU one thread.
"""

from functools import cache

import warp as wp

from nsf.engines.modal.closure import PARTS, inputs_of_widest, projection_block
from nsf.mpm import Precision
from nsf.mpm.batch import make_runs
from nsf.mpm.native import native_code
from nsf.mpm.native.access import SHARED, TAKEN, WARP

#: What a launch does: a and ȧ at x̂_n, the linearisation where the next inversion begins, or that inversion.
EVALUATE, PREPARE, SOLVE = range(3)


def shared_bytes(precision: Precision, widths: tuple[int, ...], latents: int, modes: int) -> int:
    """Shared memory [byte] that a block needs, without Bᵀw B."""
    rows, row = inputs_of_widest(widths, latents), -(-latents // 4) * 4
    values = 2 * rows * precision.numpy().itemsize + 8 * rows * row
    return values + 8 * (5 * modes + 2 * modes * latents + 4 * latents * (latents + 1) + 4)


def prepared_size(latents: int, modes: int) -> int:
    """Numbers that `PREPARE` leaves of a run: x̂*, a, q, A, G A and (AᵀG A)⁻¹."""
    return latents + 2 * modes + 2 * modes * latents + latents**2


def projection_fits(precision: Precision, widths: tuple[int, ...], latents: int, modes: int) -> bool:
    """Whether a block of a GPU can hold what the projection needs."""
    return shared_bytes(precision, widths, latents, modes) <= SHARED - TAKEN


@cache
def _make_inversion(precision: Precision):
    """Warp struct of what the projection reads and writes, a row a run where it is of two dimensions.

    `weights` (`packed_weights`), `scale`, `sigma` [r] and G [K²] are of the fields, b comes from
    `make_gathering`, `sample` is |S|, `iterations` and `tolerance` are of the projector, which is `linear` if
    it is `Taylor`. The rest is the state: `Coefficients` and `LatentRecord` say what each of it is, and
    `prepared_size` what `prepared` is.
    """
    real = precision.real

    @wp.struct
    class Inversion:
        weights: wp.array(dtype=wp.float32)
        scale: wp.float64
        sigma: wp.array(dtype=wp.float64)
        G: wp.array(dtype=wp.float64)
        b: wp.array2d(dtype=wp.float64)
        sample: wp.float64
        iterations: int
        tolerance: wp.float64
        linear: int
        dt: wp.float64
        latent: wp.array2d(dtype=wp.float64)
        a: wp.array2d(dtype=wp.float64)
        rate: wp.array2d(dtype=wp.float64)
        xhat: wp.array2d(dtype=real)
        xhat_previous: wp.array2d(dtype=real)
        xhats: wp.array2d(dtype=real)
        residuals: wp.array2d(dtype=real)
        updates: wp.array2d(dtype=real)
        row: wp.array2d(dtype=wp.int64)
        first: wp.array2d(dtype=wp.int32)
        step: wp.array2d(dtype=wp.int32)
        prepared: wp.array2d(dtype=wp.float64)

    return Inversion


@cache
def make_projection(
    precision: Precision,
    widths: tuple[int, ...],
    members: int,
    latents: int,
    modes: int,
    several: bool = False,
):
    """Kernel of the inversion: Gauss-Newton in the coefficients of the modes.

    With d = Δt v the displacement of S in the step and δa = a(x̂) − a(x̂_n), the error of the positions is
    d − B δa, so that all the projection takes from S is b = Bᵀw d, G = Bᵀw B and dᵀw d: an iteration does
    not depend on |S|. With A = ∂a/∂x̂ and q = b − G δa it solves (AᵀG A) u = Aᵀq, and the squared error is
    dᵀw d − δa·(b + q).

    The coefficients are a = [σ x̂ ; closure(x̂)]; the closure is the sum of networks with SiLU between their
    layers, and its derivative goes forward with its value.

    `PREPARE` evaluates both at the start x̂*, which is known before the step: on the parabola through the last
    three latent vectors, or x̂_n if linear. So a GPU does it beside the rest of the step, and what is left for
    `SOLVE` is a product with (AᵀG A)⁻¹, as long as one update is enough. Where the square of an update does
    not exceed the tolerance, it is the last (see `GaussNewton`), and a moves by A u, which misses by that
    order. `EVALUATE` gives a and ȧ at x̂_n, for a run that begins.

    One block evaluates the members of a committee one after another. Blocks that shared them would have to
    wait for each other, and an ordinary launch does not promise that all of them are resident: the wait could
    hang. The cost is members − 1 further closures in each evaluation, and nothing for a single network.
    `PREPARE` hides it beside the rest of the step; `SOLVE` has it where one update is not enough.

    Args:
        precision: of the closure; sums over modes and the solution are fp64.
        widths: of the closure's layers (r, hidden..., K − r); empty without one.
        members: networks of these widths whose shares in the closure are added up.
        latents: r.
        modes: K.
        several: whether there are several runs.

    Source: paper section 5.3.
    """
    _, run_of = make_runs(several)
    rows = inputs_of_widest(widths, latents)
    in_shared = shared_bytes(precision, widths, latents, modes) + 8 * modes**2 <= SHARED - TAKEN
    Inversion = _make_inversion(precision)
    constants = {
        "R": latents, "K": modes, "WIDTHS": widths or (0,), "LAYERS": max(len(widths) - 1, 0), "ROWS": rows,
        "MEMBERS": members, "SHARERS": PARTS, "WARP": WARP, "IN_SHARED": in_shared,
        "PREPARE": PREPARE, "SOLVE": SOLVE,
    }  # fmt: skip

    @wp.func_native(native_code(__package__, "projection", real=precision.native, **constants))
    def invert(inversion: Inversion, task: int, run: int): ...

    @wp.kernel(
        enable_backward=False, module="unique", grid_stride=False, launch_bounds=projection_block(widths)
    )
    def projection(inversion: Inversion, task: int, threads: int):
        invert(inversion, task, run_of(wp.tid(), threads))

    return projection
