// Finds conflicts between the items of one launch, each of which is a thread of its own on a GPU.
//
// The compiler's -fsanitize=thread tells of every access to memory by a call. These functions answer the calls in place
// of its own library: they keep, for every four bytes, who wrote, read or summed there within the launch. Nothing orders
// the threads of a launch, so two of them on the same bytes are a conflict unless both only read or both use atomics.
// That holds whatever the order in which the items run here.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <unordered_map>
#include <vector>

namespace {

enum Kind { READ, WRITE, ATOMIC };

const uint32_t NOBODY = 0, MANY = 0xffffffff;

struct Cell {
    uint32_t launch = 0;
    uint32_t by[3] = { NOBODY, NOBODY, NOBODY }; // of each kind: an item + 1
    bool in_conflict = false;
};

struct Range {
    uintptr_t begin, end;
    uintptr_t writable;
};

struct Found {
    uint64_t conflicts; // places of four bytes
    uint64_t outside; // accesses to what is no array of the launch
    uint64_t accesses;
    uint64_t at, outside_at; // the first ones
    uint32_t one, other; // items in the first conflict
};

const uintptr_t PAGE = 4096;
std::unordered_map<uintptr_t, std::vector<Cell>> pages;
std::vector<Range> ranges;
Found found;
uint32_t launch = 0, item = NOBODY;
bool reads_elsewhere = false;
uintptr_t stack_top = 0;

bool another(uint32_t by) { return by != NOBODY && by != item; }

void touch(Cell& cell, Kind kind, uintptr_t at)
{
    if (cell.launch != launch) {
        cell = Cell();
        cell.launch = launch;
    }
    for (Kind before : { READ, WRITE, ATOMIC }) {
        const bool harmless = before == kind && kind != WRITE;
        if (harmless || !another(cell.by[before]) || cell.in_conflict)
            continue;
        cell.in_conflict = true;
        if (found.conflicts++ == 0) {
            found.at = at;
            found.one = cell.by[before] == MANY ? MANY : cell.by[before] - 1;
            found.other = item - 1;
        }
    }
    uint32_t& by = cell.by[kind];
    by = another(by) ? MANY : item;
}

bool is_known(uintptr_t at, uintptr_t size, Kind kind)
{
    if (kind == READ && reads_elsewhere)
        return true;
    auto after = std::upper_bound(
        ranges.begin(), ranges.end(), at, [](uintptr_t place, const Range& range) { return place < range.begin; });
    // Ranges may overlap: all that begin before.
    while (after != ranges.begin()) {
        --after;
        if (at + size <= after->end && (after->writable || kind == READ))
            return true;
    }
    return false;
}

void access(Kind kind, const void* pointer, uintptr_t size)
{
    const uintptr_t at = (uintptr_t)pointer;
    if (item == NOBODY || (at < stack_top && at >= (uintptr_t)__builtin_frame_address(0)))
        return; // outside of a launch, or the item's own variables
    ++found.accesses;
    if (!is_known(at, size, kind)) {
        if (found.outside++ == 0)
            found.outside_at = at;
        if (kind == READ)
            return;
    }
    for (uintptr_t place = at & ~uintptr_t(3); place < at + size; place += 4) {
        static uintptr_t last_page = 0;
        static std::vector<Cell>* cells = nullptr;
        if (cells == nullptr || place / PAGE != last_page) {
            last_page = place / PAGE;
            cells = &pages[last_page];
            cells->resize(PAGE / 4);
        }
        touch((*cells)[place % PAGE / 4], kind, place);
    }
}

template <typename Bits> bool exchanged(volatile Bits* at, Bits* expected, Bits wanted)
{
    access(ATOMIC, (const void*)at, sizeof(Bits));
    const Bits now = *at;
    if (now == *expected) {
        *at = wanted;
        return true;
    }
    *expected = now;
    return false;
}

} // namespace

extern "C" {

// `memory` holds begin, end and whether it may be written, for `count` ranges in order of their begin.
void conflicts_begin(const uint64_t* memory, uint64_t count, uint32_t reads_beyond)
{
    ranges.clear();
    for (uint64_t i = 0; i < count; ++i)
        ranges.push_back({ memory[3 * i], memory[3 * i + 1], memory[3 * i + 2] });
    reads_elsewhere = reads_beyond != 0;
    found = Found {};
    ++launch;
}

void conflicts_item(uint32_t number, void* stack)
{
    item = number + 1;
    stack_top = (uintptr_t)stack;
}

void conflicts_end(Found* answer)
{
    item = NOBODY;
    *answer = found;
}

#define ACCESS(size)                                                                                                   \
    void __tsan_read##size(void* at) { access(READ, at, size); }                                                       \
    void __tsan_write##size(void* at) { access(WRITE, at, size); }                                                     \
    void __tsan_unaligned_read##size(void* at) { access(READ, at, size); }                                             \
    void __tsan_unaligned_write##size(void* at) { access(WRITE, at, size); }                                           \
    void __tsan_volatile_read##size(void* at) { access(READ, at, size); }                                              \
    void __tsan_volatile_write##size(void* at) { access(WRITE, at, size); }
ACCESS(1)
ACCESS(2)
ACCESS(4)
ACCESS(8)
ACCESS(16)

void __tsan_read_range(void* at, unsigned long size) { access(READ, at, size); }
void __tsan_write_range(void* at, unsigned long size) { access(WRITE, at, size); }

uint32_t __tsan_atomic32_load(const volatile uint32_t* at, int)
{
    access(ATOMIC, (const void*)at, 4);
    return *at;
}

uint64_t __tsan_atomic64_load(const volatile uint64_t* at, int)
{
    access(ATOMIC, (const void*)at, 8);
    return *at;
}

int __tsan_atomic32_compare_exchange_strong(volatile uint32_t* at, uint32_t* expected, uint32_t wanted, int, int)
{
    return exchanged(at, expected, wanted);
}

int __tsan_atomic64_compare_exchange_strong(volatile uint64_t* at, uint64_t* expected, uint64_t wanted, int, int)
{
    return exchanged(at, expected, wanted);
}

// What the vector code for the CPU copies with; on a GPU nothing does.
void* conflicts_copy(void* to, const void* from, uint64_t size)
{
    access(READ, from, size);
    access(WRITE, to, size);
    return std::memcpy(to, from, size);
}

void __tsan_init() { }
void __tsan_func_entry(void*) { }
void __tsan_func_exit() { }
void __tsan_vptr_update(void**, void*) { }
void __tsan_vptr_read(void**) { }

} // extern "C"
