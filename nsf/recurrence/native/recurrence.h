// Strides of one run of one member by a block of threads, or by a CPU's one; `make_recurrence` says what of.
#if defined(__CUDA_ARCH__)
#define NSF_SHARED __shared__
#define NSF_SYNC __syncthreads()
const int lane = threadIdx.x, lanes = blockDim.x;
#else
#define NSF_SHARED
#define NSF_SYNC
constexpr int lane = 0, lanes = 1;
#endif
constexpr int FORCED = R + 1, TERMS = R + 1 + (GRAVITY ? 3 : 0) + STRESS;  // columns of [B f G A]
constexpr int SEEN = R + STATES, ALL = SEEN + STRESS + R;  // inputs of the two networks, μ left out
constexpr int MOTION = R * TERMS, RATES = STRESS * (R + 1);
NSF_SHARED double x[R], d[R], next[R], s[STRESS + 1];
NSF_SHARED alignas(32) real in[ALL], one[WIDTH], two[WIDTH], out[MOTION > RATES ? MOTION : RATES];
// A layer has a column of each output: W [inputs, outputs], so that neighbours read neighbours.
struct First { enum { inputs = SEEN, outputs = WIDTH }; };
struct FirstOfAll { enum { inputs = ALL, outputs = WIDTH }; };
struct Middle { enum { inputs = WIDTH, outputs = WIDTH }; };
struct LastOfMotion { enum { inputs = WIDTH, outputs = MOTION }; };
struct LastOfStress { enum { inputs = WIDTH, outputs = RATES + 1 }; };  // one more, as no array is empty
auto silu = [](real z) { return z / (real(1) + exp(-z)); };
auto same = [](real z) { return z; };
#if defined(__CUDA_ARCH__)
// Four sums, since an addition waits for the one before it.
auto layer = [&](auto size, int outputs, const real* W, const real* bias, const real* values, real* result, auto act) {
    constexpr int inputs = decltype(size)::inputs;
    for (int o = lane; o < outputs; o += lanes) {
        real sum[4] = {bias[o], 0, 0, 0};
        #pragma unroll 8
        for (int i = 0; i < inputs; ++i) sum[i % 4] += W[i * outputs + o] * values[i];
        result[o] = act((sum[0] + sum[1]) + (sum[2] + sum[3]));
    }
    NSF_SYNC;
};
#else
auto layer = [](auto size, int outputs, const real* W, const real* bias, const real* values, real* result, auto act) {
    constexpr int inputs = decltype(size)::inputs;
    alignas(32) real sum[decltype(size)::outputs];
    for (int o = 0; o < outputs; ++o) sum[o] = bias[o];
    for (int i = 0; i < inputs; ++i) {
        const real value = values[i];
        for (int o = 0; o < outputs; ++o) sum[o] += W[i * outputs + o] * value;
    }
    for (int o = 0; o < outputs; ++o) result[o] = act(sum[o]);
};
#endif
const int member = run / runs;
// Each array has its part of a member, or of a run, one after the other.
auto part = [](auto& array, int index, size_t size) { return array.data + size_t(index) * size; };
const real* gravity = given.gravity.data;
if (given.gravity.shape[0] > 1) gravity += size_t(run % runs) * given.gravity.shape[1];
const real* states = given.states.data;
if (given.states.shape[0] > 1) states += size_t(run % runs) * given.states.shape[1];
double* latent = part(given.latent, run, R);
double* change = part(given.change, run, R);
double* stress = part(given.stress, run, STRESS);
real* xhats = part(given.xhats, run, given.xhats.shape[1]);
real* stresses = part(given.stresses, run, given.stresses.shape[1]);
for (int i = lane; i < R; i += lanes) { x[i] = latent[i]; d[i] = change[i]; }
for (int i = lane; i < STRESS; i += lanes) s[i] = stress[i];
NSF_SYNC;
for (int n = first; n < first + strides; ++n) {
    for (int i = lane; i < SEEN; i += lanes) in[i] = i < R ? real(x[i]) : states[n * STATES + i - R];
    NSF_SYNC;
    layer(First(), WIDTH, part(given.motion_first, member, SEEN * WIDTH), part(given.motion_bias, run, WIDTH), in, one, silu);
    layer(Middle(), WIDTH, part(given.motion_middle, member, WIDTH * WIDTH), part(given.motion_middle_bias, member, WIDTH), one, two, silu);
    layer(LastOfMotion(), MOTION, part(given.motion_last, member, WIDTH * MOTION), part(given.motion_last_bias, member, MOTION), two, out, same);
    for (int i = lane; i < R; i += lanes) {
        const real* row = out + i * TERMS;
        double sum = d[i] + row[R];
        for (int j = 0; j < R; ++j) sum += double(row[j]) * d[j];
        if (GRAVITY)
            for (int j = 0; j < 3; ++j) sum += double(row[FORCED + j]) * double(gravity[3 * n + j]);
        for (int j = 0; j < STRESS; ++j) sum += double(row[TERMS - STRESS + j]) * s[j];
        next[i] = sum;
    }
    NSF_SYNC;
    if (STRESS) {
        for (int i = lane; i < STRESS + R; i += lanes) in[SEEN + i] = i < STRESS ? real(s[i]) : real(next[i - STRESS]);
        NSF_SYNC;
        layer(FirstOfAll(), WIDTH, part(given.stress_first, member, ALL * WIDTH), part(given.stress_bias, run, WIDTH), in, one, silu);
        layer(Middle(), WIDTH, part(given.stress_middle, member, WIDTH * WIDTH), part(given.stress_middle_bias, member, WIDTH), one, two, silu);
        layer(LastOfStress(), RATES, part(given.stress_last, member, WIDTH * RATES), part(given.stress_last_bias, member, RATES), two, out, same);
        for (int i = lane; i < STRESS; i += lanes) {
            const real* row = out + i * (R + 1);
            double sum = row[R];
            for (int j = 0; j < R; ++j) sum += double(row[j]) * next[j];
            s[i] += sum;
            stresses[(n + 1) * STRESS + i] = real(s[i]);
        }
    }
    for (int i = lane; i < R; i += lanes) {
        d[i] = next[i];
        x[i] += next[i];
        xhats[(n + 1) * R + i] = real(x[i]);
    }
    NSF_SYNC;
}
for (int i = lane; i < R; i += lanes) { latent[i] = x[i]; change[i] = d[i]; }
for (int i = lane; i < STRESS; i += lanes) stress[i] = s[i];
#undef NSF_SHARED
#undef NSF_SYNC
