"""The closure of a deformation of `field=basis`, with its tangents, within the projection's kernel."""

from collections.abc import Sequence

import torch

from nsf.mpm.access import WARP

#: Threads that share a sum over a layer's inputs; each has two outputs, to read its inputs once for both.
PARTS = 8


def projection_block(widths: tuple[int, ...]) -> int:
    """Threads of a block: enough to take the widest layer in one turn, if there may be."""
    widest = max((*widths[1:], 1))
    return min(1024, WARP * -(-(-(-widest // 2) * PARTS) // WARP))


def packed_weights(layers: Sequence[tuple[torch.Tensor, torch.Tensor]], is_cuda: bool) -> torch.Tensor:
    """Weights [out, in] and biases [out] of a network, layer by layer, in the order in which they are read.

    A thread has two outputs, half of all apart, and every `PARTS`-th input (on a CPU every one): what a warp
    reads at once lies side by side.
    """
    parts, tile = (PARTS, WARP) if is_cuda else (1, 1)
    found = []
    for W, b in layers:
        (out, inputs), across = W.shape, tile // parts
        half, steps = -(-out // 2), -(-inputs // parts)
        tiles = -(-half // across)
        padded = W.new_zeros(2, tiles * across, steps * parts)
        padded[0, :half, :inputs], padded[1, : out - half, :inputs] = W[:half], W[half:]
        shaped = padded.unflatten(2, (steps, parts)).unflatten(1, (tiles, across))
        found += [shaped.permute(1, 3, 2, 4, 0).flatten(), torch.nn.functional.pad(b, (0, out % 2))]
    return torch.cat(found)


def inputs_of_widest(widths: tuple[int, ...], latents: int) -> int:
    """Inputs of the widest layer, filled up to whole turns of the threads that share them."""
    return -(-max((*widths[:-1], latents)) // PARTS) * PARTS


# Native code of the closure and its tangents, all layers in one piece: code that a step meets for the first
# time must be short. Values are summed in the precision of the step, tangents in fp32: they steer
# Gauss-Newton, and miss its fixed point by no more than their round-off times the residual.
CLOSURE = """
        const int width[] = {widths};
        #pragma unroll 1
        for (int member = block; member < {members}; member += blocks) {{
            const slope_t* W = weights.data + size_t(member) * (weights.shape[0] / {members});
            const bool begun = member > block;  // a share of another member is there already
            #pragma unroll 1
            for (int e = lane; e < R * R; e += lanes) {{
                slope[0][e / R * ROW + e % R] = e / R == e % R ? 1.0f : 0.0f;
                if (e < R) value[0][e] = real(x[e]);
            }}
            NSF_SYNC;
            #pragma unroll 1
            for (int l = 0; l < {layers}; ++l) {{
                const int in = width[l], out = width[l + 1], half = (out + 1) / 2;
                const int steps = (in + PARTS - 1) / PARTS, tiles = (half * PARTS + TILE - 1) / TILE;
                const int from = l % 2, to = 1 - from;
                const bool last = l == {layers} - 1;
                const slope_t* bias = W + 2 * tiles * TILE * steps;
                #pragma unroll 1
                for (int e = lane; e < tiles * TILE; e += lanes) {{
                    const int part = e % PARTS, o = e / PARTS;
                    const pair_t* w = (const pair_t*)W + e / TILE * TILE * steps + e % TILE;
                    real v_1 = 0, v_2 = 0;
                    slope_t u_1[R], u_2[R];
                    for (int c = 0; c < R; ++c) u_1[c] = u_2[c] = 0.0f;
                    #pragma unroll 1
                    for (int start = 0; start < steps; start += AHEAD) {{
                        pair_t ahead[AHEAD];
                        #pragma unroll
                        for (int j = 0; j < AHEAD; ++j)
                            if (start + j < steps) ahead[j] = w[(start + j) * TILE];
                        #pragma unroll
                        for (int j = 0; j < AHEAD; ++j) {{
                            if (start + j >= steps) break;
                            const int i = (start + j) * PARTS + part;
                            const real h = value[from][i];
                            v_1 += real(ahead[j].one) * h;
                            v_2 += real(ahead[j].two) * h;
                            const slope_t* t = slope[from] + i * ROW;
                            for (int c = 0; c < R; ++c) {{
                                u_1[c] += ahead[j].one * t[c];
                                u_2[c] += ahead[j].two * t[c];
                            }}
                        }}
                    }}
#if defined(__CUDA_ARCH__)
                    #pragma unroll 1
                    for (int d = PARTS / 2; d > 0; d /= 2) {{
                        v_1 += __shfl_xor_sync(0xffffffffu, v_1, d);
                        v_2 += __shfl_xor_sync(0xffffffffu, v_2, d);
                        for (int c = 0; c < R; ++c) {{
                            u_1[c] += __shfl_xor_sync(0xffffffffu, u_1[c], d);
                            u_2[c] += __shfl_xor_sync(0xffffffffu, u_2[c], d);
                        }}
                    }}
#endif
                    #pragma unroll 1
                    for (int side = part; side < 2; side += PARTS) {{
                        const int k = o + side * half;
                        if (o >= half || k >= out) continue;
                        const real z = (side == 0 ? v_1 : v_2) + real(bias[k]);
                        const real s = real(1) / (real(1) + exp(-z));
                        const slope_t rise = slope_t(s * (real(1) + z * (real(1) - s)));
                        if (last) at[R + k] = (begun ? at[R + k] : 0.0) + scale * z;
                        else value[to][k] = z * s;
                        for (int c = 0; c < R; ++c) {{
                            const slope_t u = side == 0 ? u_1[c] : u_2[c];
                            if (last) {{
                                double& tangent = A[(R + k) * R + c];
                                tangent = (begun ? tangent : 0.0) + scale * u;
                            }} else slope[to][k * ROW + c] = rise * u;
                        }}
                    }}
                }}
                W = bias + (out + 1) / 2 * 2;
                NSF_SYNC;
            }}
        }}
        if (blocks > 1) meet();
"""

# Native code of `meet`: the blocks add up their shares in the closure. They alternate between two places, as
# a block may be in the next evaluation while another one still reads.
MEETING = """
    auto meet = [&]() {
#if defined(__CUDA_ARCH__)
        const int count = (K - R) * (R + 1);
        double* place = shares.data + size_t(met) * blocks * count;
        for (int e = lane; e < count; e += lanes)
            place[block * count + e] = e < K - R ? at[R + e] : A[R * R + e - (K - R)];
        __threadfence();
        __syncthreads();
        if (lane == 0) {
            volatile int* turn = arrived.data + 1;
            const int before = *turn;
            if (atomicAdd(arrived.data, 1) == blocks - 1) {
                arrived.data[0] = 0;
                __threadfence();
                *turn = before + 1;
            } else {
                while (*turn == before) {}
            }
            __threadfence();
        }
        __syncthreads();
        for (int e = lane; e < count; e += lanes) {
            double sum = 0.0;
            for (int other = 0; other < blocks; ++other) sum += __ldcg(place + other * count + e);
            if (e < K - R) at[R + e] = sum; else A[R * R + e - (K - R)] = sum;
        }
        met = 1 - met;
        __syncthreads();
#endif
    };
"""
