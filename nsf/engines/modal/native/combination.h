// The sums Σ_k modes[p, c + i, k] a_k, i < 3, for each run of a tile, the first of which is `start`; where
// SUMS is 2, those with b follow those with a. On a GPU the modes lie in vectors of four, and the vectors of
// neighbouring particles side by side (`Arena.modes`): enough loads are then under way to cover the time that
// memory takes, even for few particles. On a CPU those of a particle lie together, in a row of the table.
const int K = a.shape[1], runs = a.shape[0];
const decltype(a.data) coefficients[] = {a.data, b.data};
wp::vec_t<3 * SUMS * TILE, real> sum;
#if defined(__CUDA_ARCH__)
// All threads of a block take the coefficients into shared memory, also those that are not `live`.
constexpr bool HALF = sizeof(stored) == 2;  // each mode over its length
__shared__ real shared[SUMS][TILE][4 * Q];
for (int e = threadIdx.x; e < TILE * 4 * Q; e += blockDim.x) {
    const int s = e / (4 * Q), k = e % (4 * Q);
    const bool known = k < K && start + s < runs;
    for (int m = 0; m < SUMS; ++m) {
        const auto* of = coefficients[m] + (start + s) * K + k;
        if constexpr (HALF) shared[m][s][k] = known ? real(*of * lengths.data[k]) : real(0);
        else shared[m][s][k] = known ? real(*of) : real(0);
    }
}
__syncthreads();
if (live) {
    auto four = [](auto one) {
        if constexpr (sizeof(one) == 2) return uint2();
        else return float4();
    }(stored());
    typedef decltype(four) four_t;
    auto widened = [](auto of) {
        if constexpr (sizeof(of) == sizeof(float4)) {
            return of;
        } else {
            float4 w;
            asm("{.reg .f16 a, b; mov.b32 {a, b}, %2; cvt.f32.f16 %0, a; cvt.f32.f16 %1, b;}"
                : "=f"(w.x), "=f"(w.y) : "r"(of.x));
            asm("{.reg .f16 a, b; mov.b32 {a, b}, %2; cvt.f32.f16 %0, a; cvt.f32.f16 %1, b;}"
                : "=f"(w.z), "=f"(w.w) : "r"(of.y));
            return w;
        }
    };
    constexpr int AHEAD = HALF ? 8 : 4;  // vectors of modes whose loads are under way together
    const four_t* first = (const four_t*)modes.data + size_t(c) * Q * particles + p;
    #pragma unroll 1
    for (int begin = 0; begin < Q; begin += AHEAD) {
        four_t under_way[AHEAD][3];
        #pragma unroll
        for (int j = 0; j < AHEAD; ++j) {
            for (int i = 0; i < 3; ++i) {
                if (begin + j >= Q) break;
                const four_t* at = first + size_t(i * Q + begin + j) * particles;
                // Another tile will read the same modes, or nothing will.
                under_way[j][i] = SEVERAL ? __ldcg(at) : __ldcs(at);
            }
        }
        // Else the compiler puts each load beside its use, which is of no harm in fp64.
        if constexpr (sizeof(real) == 4) __syncwarp(__activemask());
        #pragma unroll
        for (int j = 0; j < AHEAD; ++j) {
            const int q = begin + j;
            if (q >= Q) break;
            const float4 x = widened(under_way[j][0]), y = widened(under_way[j][1]);
            const float4 z = widened(under_way[j][2]);
            const float w[4][3] = {{x.x, y.x, z.x}, {x.y, y.y, z.y}, {x.z, y.z, z.z}, {x.w, y.w, z.w}};
            #pragma unroll
            for (int s = 0; s < TILE; ++s)
                #pragma unroll
                for (int k = 0; k < 4; ++k)
                    #pragma unroll
                    for (int m = 0; m < SUMS; ++m)
                        #pragma unroll
                        for (int i = 0; i < 3; ++i)
                            sum[3 * (SUMS * s + m) + i] += real(w[k][i]) * shared[m][s][4 * q + k];
        }
    }
}
#else
if (live) {
    #pragma clang fp reassociate(on)  // a CPU works on several modes at once
    const auto row = [&](int of) { return modes.data + (size_t(rows.data[of]) * components + c) * K; };
    const wp::float32 *first = row(p), *next = row(p + 1 < rows.shape[0] ? p + 1 : p);
    for (int k = 0; k < 3 * K; k += 16) __builtin_prefetch(next + k);  // rows of neighbours lie apart
    for (int s = 0; s < TILE && start + s < runs; ++s) {
        real found[3 * SUMS] = {};
        for (int k = 0; k < K; ++k)
            for (int m = 0; m < SUMS; ++m)
                for (int i = 0; i < 3; ++i)
                    found[3 * m + i] += real(first[K * i + k]) * real(coefficients[m][(start + s) * K + k]);
        for (int i = 0; i < 3 * SUMS; ++i) sum[3 * SUMS * s + i] = found[i];
    }
}
#endif
return sum;
