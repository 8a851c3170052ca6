// Stands before the C++ that Warp writes of a kernel: atomic sums and maxima that hold between threads.
// Warp's own are plain on the CPU. These are found first, being no templates.

#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <sched.h>
#include <thread>
#include <vector>

#pragma once

inline void stop_now_and_then()
{
#ifndef CHECKED
    // Lets another thread run, so that threads that share a core meet within an update.
    static thread_local uint32_t state = 1u + (uint32_t)(uintptr_t)&state;
    state = state * 1664525u + 1013904223u;
    if (state >> 24 == 0)
        sched_yield();
#endif
}

template <typename Number, typename Next> inline Number updated(Number* at, Next next)
{
    Number old, wanted;
    __atomic_load(at, &old, __ATOMIC_RELAXED);
    do {
        wanted = next(old);
        stop_now_and_then();
    } while (!__atomic_compare_exchange(at, &old, &wanted, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
    return old;
}

namespace wp {
#define WITH_ATOMICS(Number)                                                                                           \
    inline Number atomic_add(Number* at, Number amount)                                                                \
    {                                                                                                                  \
        return updated(at, [=](Number old) { return Number(old + amount); });                                          \
    }                                                                                                                  \
    inline Number atomic_max(Number* at, Number other)                                                                 \
    {                                                                                                                  \
        return updated(at, [=](Number old) { return old < other ? other : old; });                                     \
    }
WITH_ATOMICS(float)
WITH_ATOMICS(double)
WITH_ATOMICS(int)
#undef WITH_ATOMICS
} // namespace wp
