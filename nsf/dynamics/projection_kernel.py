"""The kernel that inverts the deformation field in the coefficients of its modes (`field=basis`).

A GPU takes for each simulation a block for each network whose mean is the closure; all of them do the linear
algebra alike, and only the first one writes. A CPU is one thread.
"""

from functools import cache

import warp as wp

from nsf.dynamics.closure_kernel import CLOSURE, MEETING, PARTS, inputs_of_widest, projection_block
from nsf.mpm import Precision
from nsf.mpm.access import SHARED, TAKEN, WARP
from nsf.mpm.copies import make_copies

#: What a launch does: a and ȧ at x̂_n, the linearisation where the next inversion begins, or that inversion.
EVALUATE, PREPARE, SOLVE = range(3)


def shared_bytes(precision: Precision, widths: tuple[int, ...], latents: int, modes: int) -> int:
    """Shared memory [byte] that a block needs, without Bᵀw B."""
    rows, row = inputs_of_widest(widths, latents), -(-latents // 4) * 4
    values = 2 * rows * precision.numpy().itemsize + 8 * rows * row
    return values + 8 * (5 * modes + 2 * modes * latents + 4 * latents * (latents + 1) + 4)


def prepared_size(latents: int, modes: int) -> int:
    """Numbers that `PREPARE` leaves of a simulation: x̂*, a, q, A, G A and (AᵀG A)⁻¹."""
    return latents + 2 * modes + 2 * modes * latents + latents**2


def projection_fits(precision: Precision, widths: tuple[int, ...], latents: int, modes: int) -> bool:
    """Whether a block of a GPU can hold what the projection needs."""
    return shared_bytes(precision, widths, latents, modes) <= SHARED - TAKEN


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

    Args:
        precision: of the closure; sums over modes and the solution are fp64.
        widths: of the closure's layers (r, hidden..., K − r); empty without one.
        members: networks of these widths whose shares in the closure are added up; of a GPU a block each.
            The blocks of a simulation follow each other, and wait for each other.
        latents: r.
        modes: K.
        several: whether there are several simulations.

    Source: paper section 5.3.
    """
    real = precision.real
    _, copy_of = make_copies(several)
    rows = inputs_of_widest(widths, latents)
    kept = shared_bytes(precision, widths, latents, modes) + 8 * modes**2 <= SHARED - TAKEN
    closure = ""
    if widths:
        counts = "{" + ", ".join(map(str, widths)) + "}"
        closure = CLOSURE.format(layers=len(widths) - 1, members=members, widths=counts)
    scalar = precision.native
    snippet = f"""
    typedef {scalar} real;
    typedef float slope_t;  // as Warp takes float(x) for its own
    struct alignas(8) pair_t {{ slope_t one, two; }};
#if defined(__CUDA_ARCH__)
    #define NSF_SHARED __shared__
    #define NSF_SYNC __syncthreads()
    const int lane = threadIdx.x, lanes = blockDim.x, PARTS = {PARTS}, TILE = {WARP};
    const int blocks = {members}, block = blockIdx.x % blocks;
#else
    #define NSF_SHARED
    #define NSF_SYNC
    const int lane = 0, lanes = 1, PARTS = 1, TILE = 1;
    const int block = 0, blocks = 1;
#endif
    const int R = {latents}, K = {modes};
    const int ROW = (R + 3) / 4 * 4;  // whole vectors of four
    const int AHEAD = {min(18, rows // PARTS)};  // weights whose loads are under way together
    NSF_SHARED real value[2][{rows}];
    NSF_SHARED alignas(16) slope_t slope[2][{rows} * ROW];
    NSF_SHARED double x[R], at[K], a_n[K], d[K + 1], A[K * R], q[K], M[K * R], g[R], u[R], E[2][2 * R * R];
    NSF_SHARED double error;
    {"NSF_SHARED double gram[K * K];" if kept else "const double* gram = G.data;"}
    int met = 0;
    double *const x_0 = prepared.data, *const a_0 = x_0 + R, *const q_0 = a_0 + K;
    double *const A_0 = q_0 + K, *const M_0 = A_0 + K * R, *const inverse = M_0 + K * R;
    {MEETING}
    auto evaluate = [&]() {{
        #pragma unroll 1
        for (int e = lane; e < R * R; e += lanes) {{
            A[e] = e / R == e % R ? sigma.data[e / R] : 0.0;
            if (e < R) at[e] = sigma.data[e] * x[e];
        }}
        NSF_SYNC;
        {closure}
    }};
    // Once, before anything is evaluated. Padding of the widest layer is read, times a weight of zero.
    auto begin = [&]() {{
        #pragma unroll 1
        for (int e = lane; e < 2 * {rows}; e += lanes) (&value[0][0])[e] = 0;
        #pragma unroll 1
        for (int e = lane; e < 2 * {rows} * ROW; e += lanes) (&slope[0][0])[e] = 0.0f;
        {"for (int e = lane; e < K * K; e += lanes) gram[e] = G.data[e];" if kept else ""}
        NSF_SYNC;
    }};
    // q = d - G da, where d holds b, or zeros while b is not known; with them the columns of M = G A.
    auto residual = [&](int columns) {{
        #pragma unroll 1
        for (int e = lane; e < K * (columns + 1); e += lanes) {{
            const int k = e % K, c = e / K;
            double sum = 0.0;
            #pragma unroll 8
            for (int j = 0; j < K; ++j)
                sum += gram[j * K + k] * (c == columns ? at[j] - a_n[j] : A[j * R + c]);
            if (c == columns) q[k] = d[k] - sum; else M[k * R + c] = sum;
        }}
        NSF_SYNC;
    }};
    // E[0] = [AᵀG A | Aᵀq], or beside AᵀG A the identity; g = Aᵀq.
    auto assemble = [&](bool identity) {{
        const int right = identity ? R : 1, C = R + right;
        #pragma unroll 1
        for (int e = lane; e < R * (R + 1); e += lanes) {{
            const int c = e / (R + 1), other = e % (R + 1);
            double sum = 0.0;
            #pragma unroll 8
            for (int k = 0; k < K; ++k) sum += A[k * R + c] * (other < R ? M[k * R + other] : q[k]);
            if (other < R) E[0][c * C + other] = sum;
            else g[c] = sum;
            if (other == R)
                for (int i = 0; i < right; ++i) E[0][c * C + R + i] = !identity ? sum : i == c ? 1.0 : 0.0;
        }}
        NSF_SYNC;
    }};
    // Gauss and Jordan; AᵀG A is positive definite, so that no pivot is sought. Gives what is on the right.
    auto eliminate = [&](int right) {{
        const int C = R + right;
        #pragma unroll 1
        for (int m = 0; m < R; ++m) {{
            const double* from = E[m % 2];
            #pragma unroll 1
            for (int e = lane; e < R * C; e += lanes) {{
                const int i = e / C, c = e % C;
                const double row = from[m * C + c] / from[m * C + m];
                E[1 - m % 2][e] = i == m ? row : from[e] - from[i * C + m] * row;
            }}
            NSF_SYNC;
        }}
        return E[R % 2] + R;
    }};
    // Where sums cancel to less than their round-off, nothing is left; a NaN stays one.
    auto least = [](double sum) {{ return sum < 0.0 ? 0.0 : sum; }};
    // The squared error, of which q is known.
    auto left = [&]() {{
        double sum = d[K];
        #pragma unroll 8
        for (int k = 0; k < K; ++k) sum -= (at[k] - a_n[k]) * (d[k] + q[k]);
        return least(sum);
    }};

    const long long n = row.data[0];
    #pragma unroll 1
    for (int k = lane; k < K; k += lanes) a_n[k] = a.data[k];
    if (mode != {SOLVE}) {{
        #pragma unroll 1
        for (int i = lane; i < R; i += lanes) {{
            x[i] = latent.data[i];
            if (mode == {PREPARE} && !linear) {{
                const double before = xhat_previous.data[i], change = latent.data[i] - before;
                x[i] += change;
                if (n > 1) x[i] += change - before + xhats.data[(n - 2) * R + i];
            }}
        }}
        #pragma unroll 1
        for (int k = lane; k <= K; k += lanes) d[k] = 0.0;
        begin();
        evaluate();
        if (mode == {PREPARE}) {{
            residual(R);
            assemble(true);
            const double* found = eliminate(R);
            if (block > 0) return;
            #pragma unroll 1
            for (int e = lane; e < K * R; e += lanes) {{
                A_0[e] = A[e];
                M_0[e] = M[e];
                if (e < K) {{ a_0[e] = at[e]; q_0[e] = q[e]; }}
                if (e < R * R) inverse[e] = found[e / R * 2 * R + e % R];
                if (e < R) x_0[e] = x[e];
            }}
            return;
        }}
        if (block > 0) return;
    }} else {{
        // What a block takes its decisions from, the first one, which may be done before, does not change.
        #pragma unroll 1
        for (int e = lane; e < K * R; e += lanes) {{
            A[e] = A_0[e];
            M[e] = M_0[e];
            if (e < K) {{ at[e] = a_0[e]; q[e] = b.data[e] + q_0[e]; }}
            if (e < R) x[e] = x_0[e];
        }}
        #pragma unroll 1
        for (int k = lane; k <= K; k += lanes) d[k] = b.data[k];
        NSF_SYNC;
        // g = Aᵀq, and the squared error at the start; a warp for each.
#if defined(__CUDA_ARCH__)
        const int each = 32;
#else
        const int each = 1;
#endif
        #pragma unroll 1
        for (int c = lane / each; c <= R; c += lanes / each) {{
            double sum = 0.0;
            #pragma unroll 1
            for (int k = lane % each; k < K; k += each)
                sum += c < R ? A[k * R + c] * q[k] : -(at[k] - a_n[k]) * (d[k] + q[k]);
#if defined(__CUDA_ARCH__)
            for (int half = 16; half > 0; half /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, half);
#endif
            if (lane % each == 0) {{
                if (c < R) g[c] = sum;
                else error = least(d[K] + sum);
            }}
        }}
        NSF_SYNC;
        #pragma unroll 1
        for (int i = lane; i < R; i += lanes) {{
            double sum = 0.0;
            for (int c = 0; c < R; ++c) sum += inverse[i * R + c] * g[c];
            u[i] = sum;
        }}
        NSF_SYNC;
        int done = 0;
        bool going = true;
        while (true) {{
            double length = 0.0, change = 0.0;
            for (int i = 0; i < R; ++i) {{
                length += u[i] * u[i];
                change += u[i] * g[i];
            }}
            going = !(length <= tolerance);
            if (block == 0 && lane == 0) {{
                residuals.data[n * (iterations + 1) + done] = real(sqrt(error / sample));
                updates.data[n * iterations + done] = real(sqrt(length));
            }}
            #pragma unroll 1
            for (int i = lane; i < R; i += lanes) x[i] += u[i];
            ++done;
            if (!going) break;
            if (done == 1) begin(); else NSF_SYNC;
            evaluate();
            if (done == iterations) {{
                // What a linearised model leaves: |e - J u|² = |e|² - uᵀ(AᵀG A)u at the minimum.
                if (linear && lane == 0) error = least(error - change);
                break;
            }}
            residual(R);
            assemble(false);
            const double* found = eliminate(1);
            #pragma unroll 1
            for (int i = lane; i < R; i += lanes) u[i] = found[i * (R + 1)];
            if (lane == 0) error = left();
            NSF_SYNC;
        }}
        if (block > 0) return;
        if (going && !linear) {{
            residual(0);
        }} else if (!going) {{
            #pragma unroll 1
            for (int k = lane; k < K; k += lanes) {{
                for (int c = 0; c < R; ++c) {{
                    at[k] += A[k * R + c] * u[c];
                    q[k] -= M[k * R + c] * u[c];
                }}
            }}
            NSF_SYNC;
        }}
        if (lane == 0) {{
            if (!linear || !going) error = left();
            for (int i = done; i <= iterations; ++i)
                residuals.data[n * (iterations + 1) + i] = real(sqrt(error / sample));
            for (int i = done; i < iterations; ++i) updates.data[n * iterations + i] = real(0);
            row.data[0] = n + 1;
            first.data[0] = 0;
            step.data[0] += 1;
        }}
        #pragma unroll 1
        for (int i = lane; i < R; i += lanes) {{
            xhat_previous.data[i] = xhat.data[i];
            xhat.data[i] = real(x[i]);
            xhats.data[(n + 1) * R + i] = real(x[i]);
            latent.data[i] = x[i];
        }}
    }}
    #pragma unroll 1
    for (int k = lane; k < K; k += lanes) {{
        rate.data[k] = (at[k] - a_n[k]) / dt;
        a.data[k] = at[k];
    }}
    #undef NSF_SHARED
    #undef NSF_SYNC
    """

    @wp.func_native(snippet)
    def solve(
        weights: wp.array(dtype=wp.float32),
        scale: wp.float64,
        sigma: wp.array(dtype=wp.float64),
        G: wp.array(dtype=wp.float64),
        b: wp.array(dtype=wp.float64),
        sample: wp.float64,
        mode: int,
        iterations: int,
        tolerance: wp.float64,
        linear: int,
        dt: wp.float64,
        latent: wp.array(dtype=wp.float64),
        a: wp.array(dtype=wp.float64),
        rate: wp.array(dtype=wp.float64),
        xhat: wp.array(dtype=real),
        xhat_previous: wp.array(dtype=real),
        xhats: wp.array(dtype=real),
        residuals: wp.array(dtype=real),
        updates: wp.array(dtype=real),
        row: wp.array(dtype=wp.int64),
        first: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
        prepared: wp.array(dtype=wp.float64),
        shares: wp.array(dtype=wp.float64),
        arrived: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(
        enable_backward=False, module="unique", grid_stride=False, launch_bounds=projection_block(widths)
    )
    def projection(
        weights: wp.array(dtype=wp.float32),
        scale: wp.float64,
        sigma: wp.array(dtype=wp.float64),
        G: wp.array(dtype=wp.float64),
        b: wp.array2d(dtype=wp.float64),
        sample: wp.float64,
        mode: int,
        iterations: int,
        tolerance: wp.float64,
        linear: int,
        dt: wp.float64,
        latent: wp.array2d(dtype=wp.float64),
        a: wp.array2d(dtype=wp.float64),
        rate: wp.array2d(dtype=wp.float64),
        xhat: wp.array2d(dtype=real),
        xhat_previous: wp.array2d(dtype=real),
        xhats: wp.array2d(dtype=real),
        residuals: wp.array2d(dtype=real),
        updates: wp.array2d(dtype=real),
        row: wp.array2d(dtype=wp.int64),
        first: wp.array2d(dtype=wp.int32),
        step: wp.array2d(dtype=wp.int32),
        prepared: wp.array2d(dtype=wp.float64),
        shares: wp.array2d(dtype=wp.float64),
        arrived: wp.array2d(dtype=wp.int32),
        threads: int,
    ):
        s = copy_of(wp.tid(), threads)
        solve(
            weights, scale, sigma, G, b[s], sample, mode, iterations, tolerance, linear, dt, latent[s], a[s],
            rate[s], xhat[s], xhat_previous[s], xhats[s], residuals[s], updates[s], row[s], first[s], step[s],
            prepared[s], shares[s], arrived[s],
        )  # fmt: skip

    return projection
