// The closure of a deformation goes to `at`, and its tangents to A: the sum over the members of a committee. The
// layers share one piece of code, since a step often meets it for the first time. Values are summed in the
// precision of the step, tangents in fp32: they steer Gauss-Newton, and miss its fixed point by no more than
// their round-off times the residual.
#pragma unroll 1
for (int member = 0; member < MEMBERS; ++member) {
    const slope_t* W = inversion.weights.data + size_t(member) * (inversion.weights.shape[0] / MEMBERS);
    const bool begun = member > 0;  // a share of another member is there already
    #pragma unroll 1
    for (int e = lane; e < R * R; e += lanes) {
        slope[0][e / R * ROW + e % R] = e / R == e % R ? 1.0f : 0.0f;
        if (e < R) value[0][e] = real(x[e]);
    }
    NSF_SYNC;
    #pragma unroll 1
    for (int l = 0; l < LAYERS; ++l) {
        const int in = WIDTHS[l], out = WIDTHS[l + 1], half = (out + 1) / 2;
        const int steps = (in + PARTS - 1) / PARTS, tiles = (half * PARTS + TILE - 1) / TILE;
        const int from = l % 2, to = 1 - from;
        const bool last = l == LAYERS - 1;
        const slope_t* bias = W + 2 * tiles * TILE * steps;
        #pragma unroll 1
        for (int e = lane; e < tiles * TILE; e += lanes) {
            const int part = e % PARTS, o = e / PARTS;
            const pair_t* w = (const pair_t*)W + e / TILE * TILE * steps + e % TILE;
            real v_1 = 0, v_2 = 0;
            slope_t u_1[R], u_2[R];
            for (int c = 0; c < R; ++c) u_1[c] = u_2[c] = 0.0f;
            #pragma unroll 1
            for (int start = 0; start < steps; start += AHEAD) {
                pair_t ahead[AHEAD];
                #pragma unroll
                for (int j = 0; j < AHEAD; ++j)
                    if (start + j < steps) ahead[j] = w[(start + j) * TILE];
                #pragma unroll
                for (int j = 0; j < AHEAD; ++j) {
                    if (start + j >= steps) break;
                    const int i = (start + j) * PARTS + part;
                    const real h = value[from][i];
                    v_1 += real(ahead[j].one) * h;
                    v_2 += real(ahead[j].two) * h;
                    const slope_t* t = slope[from] + i * ROW;
                    for (int c = 0; c < R; ++c) {
                        u_1[c] += ahead[j].one * t[c];
                        u_2[c] += ahead[j].two * t[c];
                    }
                }
            }
#if defined(__CUDA_ARCH__)
            #pragma unroll 1
            for (int d = PARTS / 2; d > 0; d /= 2) {
                v_1 += __shfl_xor_sync(0xffffffffu, v_1, d);
                v_2 += __shfl_xor_sync(0xffffffffu, v_2, d);
                for (int c = 0; c < R; ++c) {
                    u_1[c] += __shfl_xor_sync(0xffffffffu, u_1[c], d);
                    u_2[c] += __shfl_xor_sync(0xffffffffu, u_2[c], d);
                }
            }
#endif
            #pragma unroll 1
            for (int side = part; side < 2; side += PARTS) {
                const int k = o + side * half;
                if (o >= half || k >= out) continue;
                const real z = (side == 0 ? v_1 : v_2) + real(bias[k]);
                const real s = real(1) / (real(1) + exp(-z));
                const slope_t rise = slope_t(s * (real(1) + z * (real(1) - s)));
                if (last) at[R + k] = (begun ? at[R + k] : 0.0) + inversion.scale * z;
                else value[to][k] = z * s;
                for (int c = 0; c < R; ++c) {
                    const slope_t u = side == 0 ? u_1[c] : u_2[c];
                    if (last) {
                        double& tangent = A[(R + k) * R + c];
                        tangent = (begun ? tangent : 0.0) + inversion.scale * u;
                    } else {
                        slope[to][k * ROW + c] = rise * u;
                    }
                }
            }
        }
        W = bias + (out + 1) / 2 * 2;
        NSF_SYNC;
    }
}
