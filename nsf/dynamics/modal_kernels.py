"""Kernels of a reduced step whose fields are modes times coefficients (`field=basis`).

Nothing here is read back to the host, and no launch depends on a value, so a step is one CUDA graph.
A few sums go over the threads of a block or of a warp by native code; on a CPU a block is one thread.
"""

from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.grid import inside
from nsf.mpm.shape import shape_functions

THREADS = 128  # of a block that shares coefficients, or a sum over S
_AHEAD = 4  # vectors of modes whose loads are under way together


def _combination(names: str, coefficient: str) -> str:
    """Native code of the sums name_1..name_3 = Σ_k modes[p, c..c+2, k] name_k, for each name.

    The K modes lie in vectors of four, on a GPU those of neighbouring particles side by side (`Arena.modes`):
    what is under way then covers the time that memory takes, even for few particles. A GPU first takes the
    coefficients into shared memory, for which all threads of a block are needed, also those beyond the last
    particle; one that is not `live` only helps with that. A CPU may change the order of additions, so that it
    works on several at once.
    """
    names = names.split()
    each = "".join
    sums = each(f"real {n}_1 = 0, {n}_2 = 0, {n}_3 = 0;" for n in names)

    def terms(mode: str, coefficient: str) -> str:
        return each(
            f"{n}_{i + 1} += real({mode.format(i)}) * real({coefficient.format(n)});"
            for n in names
            for i in range(3)
        )

    of_four = each(terms(f"w{{}}.{x}", f"shared_{{}}[4 * q + {i}]") for i, x in enumerate("xyzw"))
    shared = each(f"__shared__ {coefficient} shared_{n}[4 * Q];" for n in names)
    filled = each(f"shared_{n}[k] = k < {n}.shape[0] ? {n}.data[k] : 0;" for n in names)
    return f"""
    {sums}
#if defined(__CUDA_ARCH__)
    {shared}
    for (int k = threadIdx.x; k < 4 * Q; k += blockDim.x) {{ {filled} }}
    __syncthreads();
    if (live) {{
        const float4* first = (const float4*)modes.data + size_t(c) * Q * particles + p;
        #pragma unroll {_AHEAD}
        for (int q = 0; q < Q; ++q) {{
            const float4 w0 = __ldcs(first + size_t(q) * particles);
            const float4 w1 = __ldcs(first + size_t(Q + q) * particles);
            const float4 w2 = __ldcs(first + size_t(2 * Q + q) * particles);
            {of_four}
        }}
    }}
#else
    if (live) {{
        #pragma clang fp reassociate(on)
        const wp::float32* first = modes.data + (size_t(p) * components + c) * 4 * Q;
        for (int k = 0; k < {names[0]}.shape[0]; ++k) {{
            const wp::float32 w0 = first[k], w1 = first[4 * Q + k], w2 = first[8 * Q + k];
            {terms("w{}", "{}.data[k]")}
        }}
    }}
#endif
"""


def _scalar(precision: Precision) -> str:
    return {"fp32": "float", "fp64": "double"}[precision.name]


@cache
def make_position(precision: Precision, vectors: int):
    """Kernel of x and v at N, one thread a particle, launched over whole blocks.

    x = mean + Σ_k b_k a_k and v = Σ_k b_k ȧ_k, where ȧ is the backward difference of a (paper section 5.1:
    there is no v field); in the first step v is the initial velocity.
    """
    real, vec3 = precision.real, precision.vec3
    vec6 = wp.types.vector(length=6, dtype=real)
    snippet = f"""
    typedef {_scalar(precision)} real;
    const int Q = {vectors}, c = 0, components = 3, particles = x.shape[0];
    const bool live = p < particles;
    {_combination("a rate", "double")}
    return wp::vec_t<6, real>({{a_1, a_2, a_3, rate_1, rate_2, rate_3}});
    """

    @wp.func_native(snippet)
    def combined(
        modes: wp.array(dtype=wp.float32),
        a: wp.array(dtype=wp.float64),
        rate: wp.array(dtype=wp.float64),
        x: wp.array(dtype=vec3),
        p: int,
    ) -> vec6: ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def position(
        mean: wp.array(dtype=vec3),
        modes: wp.array(dtype=wp.float32),
        a: wp.array(dtype=wp.float64),
        rate: wp.array(dtype=wp.float64),
        initial_velocity: wp.array(dtype=vec3),
        first: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        p = wp.tid()
        moved = combined(modes, a, rate, x, p)
        if p >= x.shape[0]:
            return
        x[p] = mean[p] + vec3(moved[0], moved[1], moved[2])
        if first[0] != 0:
            v[p] = initial_velocity[p]
        else:
            v[p] = vec3(moved[3], moved[4], moved[5])

    return position


@cache
def make_selection(precision: Precision, shape_name: str):
    """Kernels that find the particles which the step of S needs, exactly as in the paper.

    `stamp` writes the number of the step to every cell from which a stencil meets one of S's, `select` takes
    S and the particles in these cells, and moves the others off the grid, where the transfers pass over them.
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

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def stamp(
        x: wp.array(dtype=vec3),
        inv_dx: real,
        lower: wp.vec3i,
        extent: wp.vec3i,
        step: wp.array(dtype=wp.int32),
        stamps: wp.array(dtype=wp.int32),
    ):
        t = wp.tid()
        p, offset = t / wp.static(across**3), t % wp.static(across**3)
        base = base_node(x[p], inv_dx)
        place = wp.vec3i(offset / (across * across), (offset / across) % across, offset % across)
        c = cell(base + place - wp.vec3i(reach, reach, reach), lower, extent)
        if c >= 0:
            stamps[c] = step[0]

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def select(
        inv_dx: real,
        lower: wp.vec3i,
        extent: wp.vec3i,
        step: wp.array(dtype=wp.int32),
        stamps: wp.array(dtype=wp.int32),
        sample: int,
        grid_shape: wp.vec3i,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        needed: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int64),
    ):
        p = wp.tid()
        base = base_node(x[p], inv_dx)
        taken = 0
        if p < sample:
            taken = 1
            if not inside(base, wp.static(reach + 1), grid_shape):
                v[p] = vec3()  # no transfer will move it
        else:
            c = cell(base, lower, extent)
            if c >= 0 and stamps[c] == step[0]:
                taken = 1
            else:
                x[p] = vec3(real(-1.0), real(-1.0), real(-1.0))  # the grid starts at the origin
        needed[p] = taken
        if taken != 0:
            wp.atomic_add(count, 0, wp.int64(1))
        if p == 0:
            count[1] = count[1] + wp.int64(1)

    return stamp, select


@cache
def make_contraction(precision: Precision, vectors: int, symmetric: bool, coefficients):
    """Kernel of a matrix field at N, mean + Σ_k modes_k a_k, three components a thread, over whole blocks.

    The six components of a symmetric field are xx xy xz yy yz zz, the nine of another go row by row.
    Particles that are not needed are passed over. `coefficients` is the type of a.
    """
    real, vec3 = precision.real, precision.vec3
    scalar = {wp.float32: "float", wp.float64: "double"}[coefficients]
    snippet = f"""
    typedef {_scalar(precision)} real;
    const int Q = {vectors}, components = mean.shape[1], particles = mean.shape[0];
    {_combination("a", scalar)}
    return wp::vec_t<3, real>(a_1, a_2, a_3);
    """

    @wp.func_native(snippet)
    def combined(
        modes: wp.array(dtype=wp.float32),
        mean: wp.array2d(dtype=real),
        a: wp.array(dtype=coefficients),
        p: int,
        c: int,
        live: bool,
    ) -> vec3: ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def contraction(
        needed: wp.array(dtype=wp.int32),
        mean: wp.array2d(dtype=real),
        modes: wp.array(dtype=wp.float32),
        a: wp.array(dtype=coefficients),
        found: wp.array3d(dtype=real),
    ):
        t = wp.tid()
        n = needed.shape[0]
        group, p = t / n, t % n
        c = 3 * group
        live = c < mean.shape[1] and needed[p] != 0
        value = combined(modes, mean, a, p, c, live)
        if not live:
            return
        one, two, three = value[0] + mean[p, c], value[1] + mean[p, c + 1], value[2] + mean[p, c + 2]
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

    SiLU where `active`, else the identity; the second network's outputs follow the first's. Where W has fewer
    columns than x has entries, both are of several members, whose rows and entries follow each other.
    """
    real = precision.real
    snippet = f"""
    typedef {_scalar(precision)} real;
    const int n = W.shape[1], members = x.shape[0] / n;
    const real* row = W.data + size_t(o) * n;
    const real* inputs = x.data + o / (W.shape[0] / members) * n;
    real sum = 0;
    #pragma unroll 4
    for (int i = lane; i < n; i += lanes) sum += row[i] * inputs[i];
#if defined(__CUDA_ARCH__)
    for (int d = 16; d > 0; d /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, d);
#endif
    return sum + b.data[o];
    """

    @wp.func_native(snippet)
    def row(
        W: wp.array2d(dtype=real),
        b: wp.array(dtype=real),
        x: wp.array(dtype=real),
        o: int,
        lane: int,
        lanes: int,
    ) -> real: ...

    @wp.func
    def silu(z: real):
        return z / (real(1.0) + wp.exp(-z))

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
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
        if o < first:  # noqa: SIM108 - one call each, not one call of chosen arrays
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
    snippet = """
    double sum = 0.0;
    #pragma unroll 4
    for (int p = lane; p < weights.shape[0]; p += lanes) {
        const double x = double(v.data[p][0]), y = double(v.data[p][1]), z = double(v.data[p][2]);
        double one = dt * x, two = dt * y, three = dt * z;
        if (k < modes) {
#if defined(__CUDA_ARCH__)
            const size_t next = size_t(vectors) * particles * 4;
            const wp::float32* at = displacement.data + (size_t(k / 4) * particles + p) * 4 + k % 4;
#else
            const size_t next = 4 * vectors;
            const wp::float32* at = displacement.data + size_t(p) * 3 * next + k;
#endif
            one = at[0];
            two = at[next];
            three = at[2 * next];
        }
        sum += weights.data[p] * (one * x + two * y + three * z);
    }
    sum *= dt;
#if defined(__CUDA_ARCH__)
    __shared__ double partial[32];
    for (int d = 16; d > 0; d /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, d);
    if (threadIdx.x % 32 == 0) partial[threadIdx.x / 32] = sum;
    __syncthreads();
    sum = 0.0;
    for (int w = 0; w < blockDim.x / 32; ++w) sum += partial[w];
#endif
    return sum;
    """

    @wp.func_native(snippet)
    def share(
        displacement: wp.array(dtype=wp.float32),
        particles: int,
        vectors: int,
        modes: int,
        v: wp.array(dtype=vec3),
        weights: wp.array(dtype=wp.float64),
        dt: wp.float64,
        k: int,
        lane: int,
        lanes: int,
    ) -> wp.float64: ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def gathering(
        displacement: wp.array(dtype=wp.float32),
        particles: int,
        vectors: int,
        v: wp.array(dtype=vec3),
        weights: wp.array(dtype=wp.float64),
        dt: wp.float64,
        lanes: int,
        b: wp.array(dtype=wp.float64),
    ):
        t = wp.tid()
        k, lane = t / lanes, t % lanes
        total = share(displacement, particles, vectors, b.shape[0] - 1, v, weights, dt, k, lane, lanes)
        if lane == 0:
            b[k] = total

    return gathering
