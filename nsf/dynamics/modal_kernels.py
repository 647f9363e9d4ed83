"""Kernels of a reduced step whose fields are modes times coefficients (`field=basis`).

Nothing here is read back to the host, and no launch depends on a value, so a step is one CUDA graph.
A few sums go over the threads of a block or of a warp by native code; on a CPU a block is one thread.
"""

import itertools
from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.grid import inside
from nsf.mpm.shape import shape_functions

WARP = 32  # threads that share a dot product on a GPU
BLOCK = 128  # threads that share a sum over S
#: Threads of the block that projects, and bytes of shared memory for its partial sums.
PROJECTION_BLOCK, _PARTIAL_BYTES = 512, 24576


_WARP_SUM = """
#if defined(__CUDA_ARCH__)
    for (int d = 16; d > 0; d /= 2) value += __shfl_xor_sync(0xffffffffu, value, d);
#endif
    return value;
"""


@cache
def _make_warp_sum(precision: Precision):
    """Function: the sum of a value over the threads of a warp, for each of them."""
    real = precision.real

    @wp.func_native(_WARP_SUM)
    def warp_sum(value: real) -> real: ...

    return warp_sum


_BLOCK_SUM = """
#if defined(__CUDA_ARCH__)
    __shared__ double partial[32];
    for (int d = 16; d > 0; d /= 2) value += __shfl_xor_sync(0xffffffffu, value, d);
    if (threadIdx.x % 32 == 0) partial[threadIdx.x / 32] = value;
    __syncthreads();
    value = 0.0;
    for (int w = 0; w < blockDim.x / 32; ++w) value += partial[w];
#endif
    return value;
"""


@wp.func_native(_BLOCK_SUM)
def block_sum(value: wp.float64) -> wp.float64:
    """The sum of a value over the threads of a block, for each of them; once a kernel."""
    ...


@cache
def make_position(precision: Precision):
    """Kernel of x and v at N, one thread a particle.

    x = mean + Σ_k b_k a_k and v = Σ_k b_k ȧ_k, where ȧ is the backward difference of a (paper section 5.1:
    there is no v field); in the first step v is the initial velocity.
    """
    real, vec3 = precision.real, precision.vec3

    @wp.kernel(enable_backward=False, module="unique")
    def position(
        mean: wp.array(dtype=vec3),
        modes: wp.array3d(dtype=wp.float32),
        a: wp.array(dtype=wp.float64),
        rate: wp.array(dtype=wp.float64),
        initial_velocity: wp.array(dtype=vec3),
        first: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        p = wp.tid()
        moved, moving = vec3(), vec3()
        for k in range(modes.shape[2]):
            b = vec3(real(modes[p, 0, k]), real(modes[p, 1, k]), real(modes[p, 2, k]))
            moved += real(a[k]) * b
            moving += real(rate[k]) * b
        x[p] = mean[p] + moved
        if first[0] != 0:
            moving = initial_velocity[p]
        v[p] = moving

    return position


@cache
def make_selection(precision: Precision, shape_name: str):
    """Kernels that find the particles which the step of S needs, exactly as in the paper.

    `stamp` writes the number of the step to every cell from which a stencil meets one of S's, `select` takes
    the particles in these cells and moves the others off the grid, where the transfers pass over them.
    Cells are those of a box that starts at `lower`.

    Source: paper section 5.4, a and b.
    """
    real, vec3 = precision.real, precision.vec3
    shape = shape_functions(precision, shape_name)
    base_node, reach = shape.base_node, shape.degree
    across = 2 * reach + 1

    @wp.func
    def cell(base: wp.vec3i, lower: wp.vec3i, extent: wp.vec3i):
        at = base - lower
        if not inside(at, 1, extent):
            return -1
        return (at[0] * extent[1] + at[1]) * extent[2] + at[2]

    @wp.kernel(enable_backward=False, module="unique")
    def stamp(
        x: wp.array(dtype=vec3),
        inv_dx: real,
        lower: wp.vec3i,
        extent: wp.vec3i,
        step: wp.array(dtype=wp.int32),
        stamps: wp.array(dtype=wp.int32),
    ):
        p, offset = wp.tid()
        base = base_node(x[p], inv_dx)
        place = wp.vec3i(offset / (across * across), (offset / across) % across, offset % across)
        c = cell(base + place - wp.vec3i(reach, reach, reach), lower, extent)
        if c >= 0:
            stamps[c] = step[0]

    @wp.kernel(enable_backward=False, module="unique")
    def select(
        inv_dx: real,
        lower: wp.vec3i,
        extent: wp.vec3i,
        step: wp.array(dtype=wp.int32),
        stamps: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vec3),
        needed: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int64),
    ):
        p = wp.tid()
        c = cell(base_node(x[p], inv_dx), lower, extent)
        taken = 0
        if c >= 0:  # noqa: SIM102 - Warp evaluates both sides of an `and`
            if stamps[c] == step[0]:
                taken = 1
        needed[p] = taken
        if taken == 0:
            x[p] = vec3(real(-1.0), real(-1.0), real(-1.0))  # the grid starts at the origin
        else:
            wp.atomic_add(count, 0, wp.int64(1))
        if p == 0:
            count[1] = count[1] + wp.int64(1)

    return stamp, select


@cache
def make_contraction(precision: Precision, symmetric: bool, coefficients):
    """Kernel of a matrix field at N, mean + Σ_k modes_k a_k, three components a thread.

    The six components of a symmetric field are xx xy xz yy yz zz, the nine of another go row by row.
    Particles that are not needed are passed over. `coefficients` is the type of a.
    """
    real = precision.real

    @wp.kernel(enable_backward=False, module="unique")
    def contraction(
        needed: wp.array(dtype=wp.int32),
        mean: wp.array2d(dtype=real),
        modes: wp.array3d(dtype=wp.float32),
        a: wp.array(dtype=coefficients),
        found: wp.array3d(dtype=real),
    ):
        group, p = wp.tid()
        if needed[p] == 0:
            return
        c = 3 * group
        one, two, three = real(0.0), real(0.0), real(0.0)
        for k in range(modes.shape[2]):
            a_k = real(a[k])
            one += real(modes[p, c, k]) * a_k
            two += real(modes[p, c + 1, k]) * a_k
            three += real(modes[p, c + 2, k]) * a_k
        one, two, three = one + mean[p, c], two + mean[p, c + 1], three + mean[p, c + 2]
        if wp.static(not symmetric):
            found[p, group, 0] = one
            found[p, group, 1] = two
            found[p, group, 2] = three
        elif group == 0:
            found[p, 0, 0] = one
            found[p, 0, 1] = two
            found[p, 1, 0] = two
            found[p, 0, 2] = three
            found[p, 2, 0] = three
        else:
            found[p, 1, 1] = one
            found[p, 1, 2] = two
            found[p, 2, 1] = two
            found[p, 2, 2] = three

    return contraction


@cache
def make_layer(precision: Precision):
    """Kernel of one layer of two networks at once, one warp an output: act(W x + b), W [out, in].

    SiLU where `active`, else the identity; the second network's outputs follow the first's.
    """
    real, warp_sum = precision.real, _make_warp_sum(precision)

    @wp.func
    def row(
        W: wp.array2d(dtype=real), b: wp.array(dtype=real), x: wp.array(dtype=real), o: int, lane: int, n: int
    ):
        total = real(0.0)
        for i in range(lane, x.shape[0], n):
            total += W[o, i] * x[i]
        return warp_sum(total) + b[o]

    @wp.func
    def silu(z: real):
        return z / (real(1.0) + wp.exp(-z))

    @wp.kernel(enable_backward=False, module="unique")
    def layer(
        W_1: wp.array2d(dtype=real),
        b_1: wp.array(dtype=real),
        x_1: wp.array(dtype=real),
        W_2: wp.array2d(dtype=real),
        b_2: wp.array(dtype=real),
        x_2: wp.array(dtype=real),
        active: int,
        lanes: int,
        y_1: wp.array(dtype=real),
        y_2: wp.array(dtype=real),
    ):
        t = wp.tid()
        o, lane = t / lanes, t % lanes
        first = b_1.shape[0]
        z = real(0.0)
        if o < first:  # noqa: SIM108 - Warp evaluates both sides of a conditional expression
            z = row(W_1, b_1, x_1, o, lane, lanes)
        else:
            z = row(W_2, b_2, x_2, o - first, lane, lanes)
        if active != 0:
            z = silu(z)
        if lane == 0:
            if o < first:
                y_1[o] = z
            else:
                y_2[o - first] = z

    return layer


@cache
def make_gathering(precision: Precision):
    """Kernel of what the projection needs of S, one block a mode: b_k = Σ_p w_p B_p,kᵀ Δt v_p.

    The displacement of S in the step is Δt v_p, as its positions before it lie on the manifold. The last
    block gives Σ_p w_p |Δt v_p|².
    """
    vec3 = precision.vec3

    @wp.kernel(enable_backward=False, module="unique")
    def gathering(
        modes: wp.array3d(dtype=wp.float32),
        v: wp.array(dtype=vec3),
        weights: wp.array(dtype=wp.float64),
        dt: wp.float64,
        lanes: int,
        b: wp.array(dtype=wp.float64),
    ):
        t = wp.tid()
        k, lane = t / lanes, t % lanes
        total = wp.float64(0.0)
        for p in range(lane, weights.shape[0], lanes):
            moved = dt * wp.vec3d(wp.float64(v[p][0]), wp.float64(v[p][1]), wp.float64(v[p][2]))
            if k < modes.shape[2]:
                mode = wp.vec3d(
                    wp.float64(modes[p, 0, k]), wp.float64(modes[p, 1, k]), wp.float64(modes[p, 2, k])
                )
                total += weights[p] * wp.dot(mode, moved)
            else:
                total += weights[p] * wp.dot(moved, moved)
        total = block_sum(total)
        if lane == 0:
            b[k] = total

    return gathering


@cache
def make_projection(precision: Precision, widths: tuple[int, ...], latents: int, modes: int):
    """Kernel of the inversion on one block: Gauss-Newton in the coefficients of the modes.

    With d = Δt v the displacement of S in the step and δa = a(x̂) − a(x̂_n), the error of the positions is
    d − B δa, so that all the projection takes from S is b = Bᵀw d, G = Bᵀw B and dᵀw d: an iteration does
    not depend on |S|. With A = ∂a/∂x̂ it solves (AᵀG A) u = Aᵀ(b − G δa), and the squared error is
    dᵀw d − δa·b − δa·(b − G δa).

    The coefficients are a = [σ x̂ ; closure(x̂)]; the closure is a network with SiLU between its layers, and
    its derivative goes forward with its value. Without iterations the kernel only evaluates a and A.

    Args:
        precision: of the closure; sums and the solution are fp64.
        widths: of the closure's layers (r, hidden..., K − r); empty without one.
        latents: r.
        modes: K.

    Source: paper section 5.3.
    """
    real = precision.real
    R, K, C = latents, modes, latents + 1
    widest = max((*widths[1:], 1))
    size = 4 if precision.name == "fp32" else 8
    splits = max(1, min(PROJECTION_BLOCK // widest, _PARTIAL_BYTES // (widest * C * size)))
    layers, offset = "", 0
    for n, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        last = "true" if n == len(widths) - 2 else "false"
        layers += f"layer({inputs}, {outputs}, weights.data + {offset}, {last});\n"
        offset += (inputs + 1) * outputs
    scalar = "float" if precision.name == "fp32" else "double"
    snippet = f"""
    typedef {scalar} real;
#if defined(__CUDA_ARCH__)
    #define NSF_SHARED __shared__
    #define NSF_SYNC __syncthreads()
    const int lane = threadIdx.x, lanes = blockDim.x;
#else
    #define NSF_SHARED
    #define NSF_SYNC
    const int lane = 0, lanes = 1;
#endif
    const int R = {R}, K = {K}, C = {C}, S = {splits};
    NSF_SHARED real h[{max(widest, R) * C}], partial[{splits * widest * C}];
    NSF_SHARED double x[R], a_n[K], at[K], A[K * R], q[K], M[K * R], g[R], H[R * R];
    NSF_SHARED double error;
    NSF_SHARED int going;

    // A layer of the closure and its tangents: column 0 is the value, column c the derivative along x_c.
    // W is [in, out], followed by the biases.
    auto layer = [&](int in, int out, const real* W, bool last) {{
        const real* bias = W + in * out;
        for (int e = lane; e < out * S; e += lanes) {{
            const int o = e % out, part = e / out;
            real sum[C];
            for (int c = 0; c < C; ++c) sum[c] = real(0);
            for (int i = part; i < in; i += S) {{
                const real w = W[i * out + o];
                for (int c = 0; c < C; ++c) sum[c] += w * h[i * C + c];
            }}
            for (int c = 0; c < C; ++c) partial[(part * out + o) * C + c] = sum[c];
        }}
        NSF_SYNC;
        for (int o = lane; o < out; o += lanes) {{
            real z[C];
            for (int c = 0; c < C; ++c) z[c] = real(0);
            for (int part = 0; part < S; ++part)
                for (int c = 0; c < C; ++c) z[c] += partial[(part * out + o) * C + c];
            z[0] += bias[o];
            if (last) {{
                at[R + o] = z[0];
                for (int c = 1; c < C; ++c) A[(R + o) * R + c - 1] = z[c];
            }} else {{
                const real s = real(1) / (real(1) + exp(-z[0]));
                const real slope = s * (real(1) + z[0] * (real(1) - s));
                h[o * C] = z[0] * s;
                for (int c = 1; c < C; ++c) h[o * C + c] = slope * z[c];
            }}
        }}
        NSF_SYNC;
    }};
    auto evaluate = [&]() {{
        for (int e = lane; e < R * C; e += lanes) {{
            const int i = e / C, c = e % C;
            h[e] = c == 0 ? real(x[i]) : real(c - 1 == i);
            if (c == 0) at[i] = sigma.data[i] * x[i];
            else A[i * R + c - 1] = c - 1 == i ? sigma.data[i] : 0.0;
        }}
        NSF_SYNC;
        {layers}
    }};
    // q = b - G da and the squared error.
    auto residual = [&]() {{
        for (int k = lane; k < K; k += lanes) {{
            double sum = b.data[k];
            for (int j = 0; j < K; ++j) sum -= G.data[j * K + k] * (at[j] - a_n[j]);
            q[k] = sum;
        }}
        NSF_SYNC;
        if (lane == 0) {{
            double sum = b.data[K];
            for (int k = 0; k < K; ++k) sum -= (at[k] - a_n[k]) * (b.data[k] + q[k]);
            error = sum > 0.0 ? sum : (sum <= 0.0 ? 0.0 : sum);
        }}
        NSF_SYNC;
    }};

    for (int i = lane; i < R; i += lanes) x[i] = latent.data[i];
    for (int k = lane; k < K; k += lanes) a_n[k] = at[k] = a.data[k];
    for (int e = lane; e < K * R; e += lanes) A[e] = tangents.data[e];
    if (lane == 0) going = 1;
    NSF_SYNC;
    if (iterations == 0) evaluate();
    const long long n = row.data[0];
    int done = 0;
    for (; done < iterations; ++done) {{
        residual();
        for (int e = lane; e < K * R; e += lanes) {{
            const int k = e / R, c = e % R;
            double sum = 0.0;
            for (int j = 0; j < K; ++j) sum += G.data[j * K + k] * A[j * R + c];
            M[e] = sum;
        }}
        NSF_SYNC;
        for (int e = lane; e < R * C; e += lanes) {{
            const int c = e / C, d = e % C;
            double sum = 0.0;
            for (int k = 0; k < K; ++k) sum += A[k * R + c] * (d < R ? M[k * R + d] : q[k]);
            if (d < R) H[c * R + d] = sum; else g[c] = sum;
        }}
        NSF_SYNC;
        if (lane == 0) {{
            // Cholesky in place; a matrix that is not positive definite gives a NaN, not a wrong update.
            double L[R * R], u[R], length = 0.0, change = 0.0;
            for (int i = 0; i < R; ++i)
                for (int j = 0; j <= i; ++j) {{
                    double sum = H[i * R + j];
                    for (int m = 0; m < j; ++m) sum -= L[i * R + m] * L[j * R + m];
                    L[i * R + j] = i == j ? sqrt(sum) : sum / L[j * R + j];
                }}
            for (int i = 0; i < R; ++i) {{
                double sum = g[i];
                for (int m = 0; m < i; ++m) sum -= L[i * R + m] * u[m];
                u[i] = sum / L[i * R + i];
                change += u[i] * u[i];
            }}
            for (int i = R - 1; i >= 0; --i) {{
                double sum = u[i];
                for (int m = i + 1; m < R; ++m) sum -= L[m * R + i] * u[m];
                u[i] = sum / L[i * R + i];
                length += u[i] * u[i];
            }}
            for (int i = 0; i < R; ++i) x[i] += u[i];
            length = sqrt(length);
            residuals.data[n * (iterations + 1) + done] = real(sqrt(error / sample));
            updates.data[n * iterations + done] = real(length);
            // What a linearised model leaves: |e - J u|² = |e|² - uᵀ(AᵀG A)u at the minimum.
            if (linear) error = error > change ? error - change : 0.0;
            going = !(length <= tolerance);
        }}
        NSF_SYNC;
        evaluate();
        NSF_SYNC;
        if (!going) {{ ++done; break; }}
    }}
    if (iterations > 0 && !linear) residual();
    if (lane == 0 && iterations > 0) {{
        for (int i = done; i <= iterations; ++i)
            residuals.data[n * (iterations + 1) + i] = real(sqrt(error / sample));
        for (int i = done; i < iterations; ++i) updates.data[n * iterations + i] = real(0);
        row.data[0] = n + 1;
        first.data[0] = 0;
        step.data[0] += 1;
    }}
    for (int i = lane; i < R; i += lanes) {{
        if (iterations > 0) {{
            xhat_previous.data[i] = xhat.data[i];
            xhat.data[i] = real(x[i]);
            xhats.data[(n + 1) * R + i] = real(x[i]);
        }}
        latent.data[i] = x[i];
    }}
    for (int k = lane; k < K; k += lanes) {{
        rate.data[k] = (at[k] - a_n[k]) / dt;
        a.data[k] = at[k];
    }}
    for (int e = lane; e < K * R; e += lanes) tangents.data[e] = A[e];
    #undef NSF_SHARED
    #undef NSF_SYNC
    """

    @wp.func_native(snippet)
    def solve(
        weights: wp.array(dtype=real),
        sigma: wp.array(dtype=wp.float64),
        G: wp.array(dtype=wp.float64),
        b: wp.array(dtype=wp.float64),
        sample: wp.float64,
        iterations: int,
        tolerance: wp.float64,
        linear: int,
        dt: wp.float64,
        latent: wp.array(dtype=wp.float64),
        a: wp.array(dtype=wp.float64),
        tangents: wp.array(dtype=wp.float64),
        rate: wp.array(dtype=wp.float64),
        xhat: wp.array(dtype=real),
        xhat_previous: wp.array(dtype=real),
        xhats: wp.array(dtype=real),
        residuals: wp.array(dtype=real),
        updates: wp.array(dtype=real),
        row: wp.array(dtype=wp.int64),
        first: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=PROJECTION_BLOCK)
    def projection(
        weights: wp.array(dtype=real),
        sigma: wp.array(dtype=wp.float64),
        G: wp.array(dtype=wp.float64),
        b: wp.array(dtype=wp.float64),
        sample: wp.float64,
        iterations: int,
        tolerance: wp.float64,
        linear: int,
        dt: wp.float64,
        latent: wp.array(dtype=wp.float64),
        a: wp.array(dtype=wp.float64),
        tangents: wp.array(dtype=wp.float64),
        rate: wp.array(dtype=wp.float64),
        xhat: wp.array(dtype=real),
        xhat_previous: wp.array(dtype=real),
        xhats: wp.array(dtype=real),
        residuals: wp.array(dtype=real),
        updates: wp.array(dtype=real),
        row: wp.array(dtype=wp.int64),
        first: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
    ):
        solve(
            weights, sigma, G, b, sample, iterations, tolerance, linear, dt, latent, a, tangents, rate,
            xhat, xhat_previous, xhats, residuals, updates, row, first, step,
        )  # fmt: skip

    return projection
