// Adds `needs`, 0 or 1, to count[run, 0]; threads of a warp that are of one run add together.
#if defined(__CUDA_ARCH__)
unsigned long long* at = (unsigned long long*)count.data + size_t(run) * count.shape[1];
#if __CUDA_ARCH__ >= 700
const unsigned in_warp = __activemask();
const unsigned of_run = __match_any_sync(in_warp, run);
const unsigned needing = __ballot_sync(in_warp, needs != 0) & of_run;
const bool first = (threadIdx.x & 31) == __ffs(of_run) - 1;
if (first && needing != 0) atomicAdd(at, (unsigned long long)__popc(needing));
#else
if (needs != 0) atomicAdd(at, 1ull);
#endif
#else
count.data[size_t(run) * count.shape[1]] += needs;
#endif
