// The inversion of one run by a block of a GPU or a thread of a CPU; `make_projection` says how.
typedef float slope_t;  // as Warp takes float(x) for its own
struct alignas(8) pair_t { slope_t one, two; };
#if defined(__CUDA_ARCH__)
#define NSF_SHARED __shared__
#define NSF_SYNC __syncthreads()
const int lane = threadIdx.x, lanes = blockDim.x;
constexpr int PARTS = SHARERS, TILE = WARP;
#else
#define NSF_SHARED
#define NSF_SYNC
constexpr int lane = 0, lanes = 1, PARTS = 1, TILE = 1;
#endif
constexpr int ROW = (R + 3) / 4 * 4;  // whole vectors of four
constexpr int AHEAD = ROWS / SHARERS < 18 ? ROWS / SHARERS : 18;  // weights whose loads are under way together
NSF_SHARED real value[2][ROWS];
NSF_SHARED alignas(16) slope_t slope[2][ROWS * ROW];
NSF_SHARED double x[R], at[K], a_n[K], d[K + 1], A[K * R], q[K], M[K * R], g[R], u[R], E[2][2 * R * R];
NSF_SHARED double error, copied[IN_SHARED ? K * K : 1];
const double* gram = IN_SHARED ? copied : inversion.G.data;
// A run has a row of each array of two dimensions.
auto own = [&](const auto& values) { return values.data + size_t(run) * values.shape[1]; };
double *const latent = own(inversion.latent), *const a = own(inversion.a);
const double* b = own(inversion.b);
double *const x_0 = own(inversion.prepared), *const a_0 = x_0 + R, *const q_0 = a_0 + K;
double *const A_0 = q_0 + K, *const M_0 = A_0 + K * R, *const inverse = M_0 + K * R;
real *const xhat = own(inversion.xhat), *const xhat_previous = own(inversion.xhat_previous);
real *const xhats = own(inversion.xhats);
real *const residuals = own(inversion.residuals), *const updates = own(inversion.updates);
const int iterations = inversion.iterations;
const bool linear = inversion.linear;
auto evaluate = [&]() {
    #pragma unroll 1
    for (int e = lane; e < R * R; e += lanes) {
        A[e] = e / R == e % R ? inversion.sigma.data[e / R] : 0.0;
        if (e < R) at[e] = inversion.sigma.data[e] * x[e];
    }
    NSF_SYNC;
    if constexpr (LAYERS > 0) {
#include "closure.h"
    }
};
// Once, before anything is evaluated. Padding of the widest layer is read, times a weight of zero.
auto begin = [&]() {
    #pragma unroll 1
    for (int e = lane; e < 2 * ROWS; e += lanes) (&value[0][0])[e] = 0;
    #pragma unroll 1
    for (int e = lane; e < 2 * ROWS * ROW; e += lanes) (&slope[0][0])[e] = 0.0f;
    if constexpr (IN_SHARED)
        for (int e = lane; e < K * K; e += lanes) copied[e] = inversion.G.data[e];
    NSF_SYNC;
};
// q = d - G da, where d holds b, or zeros while b is not known; with them the columns of M = G A.
auto residual = [&](int columns) {
    #pragma unroll 1
    for (int e = lane; e < K * (columns + 1); e += lanes) {
        const int k = e % K, c = e / K;
        double sum = 0.0;
        #pragma unroll 8
        for (int j = 0; j < K; ++j)
            sum += gram[j * K + k] * (c == columns ? at[j] - a_n[j] : A[j * R + c]);
        if (c == columns) q[k] = d[k] - sum; else M[k * R + c] = sum;
    }
    NSF_SYNC;
};
// E[0] = [AᵀG A | Aᵀq], or beside AᵀG A the identity; g = Aᵀq.
auto assemble = [&](bool identity) {
    const int right = identity ? R : 1, C = R + right;
    #pragma unroll 1
    for (int e = lane; e < R * (R + 1); e += lanes) {
        const int c = e / (R + 1), other = e % (R + 1);
        double sum = 0.0;
        #pragma unroll 8
        for (int k = 0; k < K; ++k) sum += A[k * R + c] * (other < R ? M[k * R + other] : q[k]);
        if (other < R) E[0][c * C + other] = sum;
        else g[c] = sum;
        if (other == R)
            for (int i = 0; i < right; ++i) E[0][c * C + R + i] = !identity ? sum : i == c ? 1.0 : 0.0;
    }
    NSF_SYNC;
};
// Gauss and Jordan; AᵀG A is positive definite, so that no pivot is sought. Gives what is on the right.
auto eliminate = [&](int right) {
    const int C = R + right;
    #pragma unroll 1
    for (int m = 0; m < R; ++m) {
        const double* from = E[m % 2];
        #pragma unroll 1
        for (int e = lane; e < R * C; e += lanes) {
            const int i = e / C, c = e % C;
            const double row = from[m * C + c] / from[m * C + m];
            E[1 - m % 2][e] = i == m ? row : from[e] - from[i * C + m] * row;
        }
        NSF_SYNC;
    }
    return E[R % 2] + R;
};
// Where sums cancel to less than their round-off, nothing is left; a NaN stays one.
auto least = [](double sum) { return sum < 0.0 ? 0.0 : sum; };
// The squared error, of which q is known.
auto left = [&]() {
    double sum = d[K];
    #pragma unroll 8
    for (int k = 0; k < K; ++k) sum -= (at[k] - a_n[k]) * (d[k] + q[k]);
    return least(sum);
};

const long long n = own(inversion.row)[0];
#pragma unroll 1
for (int k = lane; k < K; k += lanes) a_n[k] = a[k];
if (task != SOLVE) {
    #pragma unroll 1
    for (int i = lane; i < R; i += lanes) {
        x[i] = latent[i];
        if (task == PREPARE && !linear) {
            const double before = xhat_previous[i], change = latent[i] - before;
            x[i] += change;
            if (n > 1) x[i] += change - before + xhats[(n - 2) * R + i];
        }
    }
    #pragma unroll 1
    for (int k = lane; k <= K; k += lanes) d[k] = 0.0;
    begin();
    evaluate();
    if (task == PREPARE) {
        residual(R);
        assemble(true);
        const double* found = eliminate(R);
        #pragma unroll 1
        for (int e = lane; e < K * R; e += lanes) {
            A_0[e] = A[e];
            M_0[e] = M[e];
            if (e < K) { a_0[e] = at[e]; q_0[e] = q[e]; }
            if (e < R * R) inverse[e] = found[e / R * 2 * R + e % R];
            if (e < R) x_0[e] = x[e];
        }
        return;
    }
} else {
    #pragma unroll 1
    for (int e = lane; e < K * R; e += lanes) {
        A[e] = A_0[e];
        M[e] = M_0[e];
        if (e < K) { at[e] = a_0[e]; q[e] = b[e] + q_0[e]; }
        if (e < R) x[e] = x_0[e];
    }
    #pragma unroll 1
    for (int k = lane; k <= K; k += lanes) d[k] = b[k];
    NSF_SYNC;
    // g = Aᵀq, and the squared error at the start; a warp for each.
#if defined(__CUDA_ARCH__)
    const int each = 32;
#else
    const int each = 1;
#endif
    #pragma unroll 1
    for (int c = lane / each; c <= R; c += lanes / each) {
        double sum = 0.0;
        #pragma unroll 1
        for (int k = lane % each; k < K; k += each)
            sum += c < R ? A[k * R + c] * q[k] : -(at[k] - a_n[k]) * (d[k] + q[k]);
#if defined(__CUDA_ARCH__)
        for (int half = 16; half > 0; half /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, half);
#endif
        if (lane % each == 0) {
            if (c < R) g[c] = sum;
            else error = least(d[K] + sum);
        }
    }
    NSF_SYNC;
    #pragma unroll 1
    for (int i = lane; i < R; i += lanes) {
        double sum = 0.0;
        for (int c = 0; c < R; ++c) sum += inverse[i * R + c] * g[c];
        u[i] = sum;
    }
    NSF_SYNC;
    int done = 0;
    bool going = true;
    while (true) {
        double length = 0.0, change = 0.0;
        for (int i = 0; i < R; ++i) {
            length += u[i] * u[i];
            change += u[i] * g[i];
        }
        going = !(length <= inversion.tolerance);
        if (lane == 0) {
            residuals[n * (iterations + 1) + done] = real(sqrt(error / inversion.sample));
            updates[n * iterations + done] = real(sqrt(length));
        }
        #pragma unroll 1
        for (int i = lane; i < R; i += lanes) x[i] += u[i];
        ++done;
        if (!going) break;
        if (done == 1) begin(); else NSF_SYNC;
        evaluate();
        if (done == iterations) {
            // What a linearised model leaves: |e - J u|² = |e|² - uᵀ(AᵀG A)u at the minimum.
            if (linear && lane == 0) error = least(error - change);
            break;
        }
        residual(R);
        assemble(false);
        const double* found = eliminate(1);
        #pragma unroll 1
        for (int i = lane; i < R; i += lanes) u[i] = found[i * (R + 1)];
        if (lane == 0) error = left();
        NSF_SYNC;
    }
    if (going && !linear) {
        residual(0);
    } else if (!going) {
        #pragma unroll 1
        for (int k = lane; k < K; k += lanes) {
            for (int c = 0; c < R; ++c) {
                at[k] += A[k * R + c] * u[c];
                q[k] -= M[k * R + c] * u[c];
            }
        }
        NSF_SYNC;
    }
    if (lane == 0) {
        if (!linear || !going) error = left();
        for (int i = done; i <= iterations; ++i)
            residuals[n * (iterations + 1) + i] = real(sqrt(error / inversion.sample));
        for (int i = done; i < iterations; ++i) updates[n * iterations + i] = real(0);
        own(inversion.row)[0] = n + 1;
        own(inversion.first)[0] = 0;
        own(inversion.step)[0] += 1;
    }
    #pragma unroll 1
    for (int i = lane; i < R; i += lanes) {
        xhat_previous[i] = xhat[i];
        xhat[i] = real(x[i]);
        xhats[(n + 1) * R + i] = real(x[i]);
        latent[i] = x[i];
    }
}
#pragma unroll 1
for (int k = lane; k < K; k += lanes) {
    own(inversion.rate)[k] = (at[k] - a_n[k]) / inversion.dt;
    a[k] = at[k];
}
#undef NSF_SHARED
#undef NSF_SYNC
