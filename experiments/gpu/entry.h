// Stands behind the C++ that Warp writes of a kernel: ways to run its items. KERNEL, ARGUMENTS and DIMENSIONS are the
// kernel's.

extern "C" {

#ifdef CHECKED
void conflicts_item(uint32_t item, void* stack);

// All items one after the other, each being told to the checker as a thread of its own.
void run_checked(wp::launch_bounds_t<DIMENSIONS>* bounds, void* arguments)
{
    for (size_t item = 0; item < bounds->size; ++item) {
        conflicts_item((uint32_t)item, __builtin_frame_address(0));
        KERNEL<false>(*bounds, item, (ARGUMENTS*)arguments);
    }
}
#else
// By `count` threads, each taking every count-th of a shuffled order.
void run_by_threads(wp::launch_bounds_t<DIMENSIONS>* bounds, void* arguments, size_t count, uint64_t seed)
{
    const size_t size = bounds->size;
    if (size == 0)
        return;
    size_t stride = seed % size | 1;
    while (std::gcd(stride, size) != 1)
        ++stride;
    const size_t start = (seed >> 32) % size;
    auto share = [=](size_t first) {
        for (size_t k = first; k < size; k += count)
            KERNEL<false>(*bounds, (start + k * stride) % size, (ARGUMENTS*)arguments);
    };
    std::vector<std::thread> others;
    for (size_t thread = 1; thread < count && thread < size; ++thread)
        others.emplace_back(share, thread);
    share(0);
    for (std::thread& other : others)
        other.join();
}
#endif

} // extern "C"
