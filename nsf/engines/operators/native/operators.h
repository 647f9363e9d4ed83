// Steps of one run by a block of threads, or by a CPU's one; `make_recurrence` says what of.
#if defined(__CUDA_ARCH__)
#define NSF_SHARED __shared__
#define NSF_SYNC __syncthreads()
const int lane = threadIdx.x, lanes = blockDim.x;
#else
#define NSF_SHARED
#define NSF_SYNC
constexpr int lane = 0, lanes = 1;
#endif
constexpr int LAGS = MEMORY * R, IN = R + STATES + LAGS;
NSF_SHARED double x[R], d[R], lag[LAGS + 1];
NSF_SHARED alignas(32) real in[IN], one[WIDTH], two[WIDTH], out[OUTPUTS];
// A layer has a column of each output: W [inputs, outputs], so that neighbours read neighbours.
struct First { enum { inputs = IN, outputs = WIDTH }; };
struct Middle { enum { inputs = WIDTH, outputs = WIDTH }; };
struct Last { enum { inputs = WIDTH, outputs = OUTPUTS }; };
auto silu = [](real z) { return z / (real(1) + exp(-z)); };
#if defined(__CUDA_ARCH__)
__shared__ real kept[KEPT ? IN * WIDTH + WIDTH * OUTPUTS : 1];
real column[COLUMN ? WIDTH : 1];  // the thread's own of the middle layer
if (KEPT) {
    for (int e = lane; e < IN * WIDTH; e += lanes) kept[e] = given.first.data[e];
    for (int e = lane; e < WIDTH * OUTPUTS; e += lanes) kept[IN * WIDTH + e] = given.last.data[e];
}
if (COLUMN) {
    #pragma unroll
    for (int i = 0; i < WIDTH; ++i) column[i] = lane < WIDTH ? given.middle.data[i * WIDTH + lane] : real(0);
}
const real* first = KEPT ? kept : given.first.data;
const real* last = KEPT ? kept + IN * WIDTH : given.last.data;
// Four sums, since an addition waits for the one before it. A column in registers asks for every turn unrolled;
// of wide layers that would take minutes to compile.
auto dot = [](auto weight, const real* values, auto count) {
    constexpr int inputs = decltype(count)::inputs, turns = inputs / 4;
    constexpr int unrolled = turns < 1 ? 1 : COLUMN || turns <= 32 ? turns : 8;
    real sum[4] = {};
    #pragma unroll unrolled
    for (int i = 0; i < turns; ++i) {
        #pragma unroll
        for (int j = 0; j < 4; ++j) sum[j] += weight(4 * i + j) * values[4 * i + j];
    }
    #pragma unroll
    for (int i = 4 * turns; i < inputs; ++i) sum[i % 4] += weight(i) * values[i];
    return (sum[0] + sum[1]) + (sum[2] + sum[3]);
};
auto layer = [&](auto size, const real* W, const real* bias, const real* values, real* result, auto act) {
    constexpr int outputs = decltype(size)::outputs;
    for (int o = lane; o < outputs; o += lanes)
        result[o] = act(bias[o] + dot([&](int i) { return W[i * outputs + o]; }, values, size));
};
#else
const real *first = given.first.data, *last = given.last.data;
auto layer = [](auto size, const real* W, const real* bias, const real* values, real* result, auto act) {
    constexpr int inputs = decltype(size)::inputs, outputs = decltype(size)::outputs;
    alignas(32) real sum[outputs];
    for (int o = 0; o < outputs; ++o) sum[o] = bias[o];
    for (int i = 0; i < inputs; ++i) {
        const real value = values[i];
        for (int o = 0; o < outputs; ++o) sum[o] += W[i * outputs + o] * value;
    }
    for (int o = 0; o < outputs; ++o) result[o] = act(sum[o]);
};
#endif
auto same = [](real z) { return z; };
const real* bias = given.bias.data + size_t(run) * WIDTH;
const real* gravity = given.gravity.data;
if (given.gravity.shape[0] > 1) gravity += size_t(run) * given.gravity.shape[1];
const real* states = given.states.data;
if (given.states.shape[0] > 1) states += size_t(run) * given.states.shape[1];
const double* push = given.push.data;
if (PUSHED) push += size_t(run) * given.push.shape[1];
real* xhats = given.xhats.data + size_t(run) * given.xhats.shape[1];
const long long begin = given.row.data[run];
for (int i = lane; i < R; i += lanes) {
    x[i] = given.latent.data[run * R + i];
    d[i] = given.change.data[run * R + i];
}
for (int i = lane; i < LAGS; i += lanes) lag[i] = given.lag.data[run * LAGS + i];
NSF_SYNC;
for (long long n = begin; n < begin + steps; ++n) {
    for (int i = lane; i < IN; i += lanes)
        in[i] = i < R ? real(x[i]) : i < R + STATES ? states[n * STATES + i - R] : real(lag[i - R - STATES]);
    NSF_SYNC;
    layer(First(), first, bias, in, one, silu);
    NSF_SYNC;
#if defined(__CUDA_ARCH__)
    if (COLUMN) {
        if (lane < WIDTH)
            two[lane] = silu(given.middle_bias.data[lane] + dot([&](int i) { return column[i]; }, one, Middle()));
    } else
#endif
    layer(Middle(), given.middle.data, given.middle_bias.data, one, two, silu);
    NSF_SYNC;
    layer(Last(), last, given.last_bias.data, two, out, same);
    NSF_SYNC;
    // Every thread finds all of d' that it needs from d as it was: R is small.
    double next[R];
    for (int i = 0; i < R; ++i) {
        double sum = out[R * R + i];
        for (int j = 0; j < R; ++j) sum += double(out[i * R + j]) * d[j];
        if (GRAVITY)
            for (int j = 0; j < 3; ++j) sum += double(out[R * R + R + 3 * i + j]) * double(gravity[3 * n + j]);
        if (PUSHED) sum += push[n * R + i];
        next[i] = d[i] + sum;
    }
    NSF_SYNC;
    for (int i = lane; i < R; i += lanes) {
        d[i] = next[i];
        x[i] += next[i];
        xhats[(n + 1) * R + i] = real(x[i]);
        for (int k = 0; k < MEMORY; ++k) lag[k * R + i] = given.decay.data[k] * (lag[k * R + i] + next[i]);
    }
    NSF_SYNC;
}
for (int i = lane; i < R; i += lanes) {
    given.latent.data[run * R + i] = x[i];
    given.change.data[run * R + i] = d[i];
    given.xhat.data[run * R + i] = real(x[i]);
    given.before.data[run * R + i] = begin + steps > 0 ? xhats[(begin + steps - 1) * R + i] : real(x[i]);
}
for (int i = lane; i < LAGS; i += lanes) given.lag.data[run * LAGS + i] = lag[i];
if (lane == 0) given.row.data[run] = begin + steps;
#undef NSF_SHARED
#undef NSF_SYNC
