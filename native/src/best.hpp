// The best of many, in the order in which libstdc++ leaves them, which OpenCV's keypoints have.
//
// Musser, Introspective sorting and selection algorithms, 1997: parts are split at the median of three until the last
// of the best is in its place.  Which of equals comes first follows from the order of the exchanges alone, so that
// order is part of what is computed here.
#pragma once

#include <cstdint>

namespace rse_pf {

struct Ranked {
    float rank;
    int32_t index;
};

inline void exchange(Ranked& a, Ranked& b) {
    const Ranked held = a;
    a = b;
    b = held;
}

// Exchange *first* and the median of three by rank; of equals the one that libstdc++ takes.
inline void take_median(Ranked* first, Ranked* a, Ranked* b, Ranked* c) {
    Ranked *const high = a->rank > b->rank ? a : b, *const low = high == a ? b : a;
    exchange(*first, low->rank > c->rank ? *low : high->rank > c->rank ? *c : *high);
}

// Split from *begin* to before *end* at *pivot*, which ends both searches; return where the lower part begins.
inline Ranked* split(Ranked* begin, Ranked* end, const Ranked* pivot) {
    for (;;) {
        while (begin->rank > pivot->rank) ++begin;
        --end;
        while (pivot->rank > end->rank) --end;
        if (!(begin < end)) return begin;
        exchange(*begin, *end);
        ++begin;
    }
}

// Put the best *wanted* of *count* and all that equal the last of them to the front; return how many those are, -1 if
// the parts are so unequal that the order would be another one.
inline int64_t keep_best(Ranked* values, int64_t count, int64_t wanted) {
    if (count <= wanted || wanted <= 0) return count <= wanted ? count : 0;
    Ranked *begin = values, *end = values + count, *const last = values + wanted - 1;
    int64_t splits = 2 * (63 - __builtin_clzll(static_cast<uint64_t>(count)));
    while (end - begin > 3) {
        if (splits-- == 0) return -1;
        take_median(begin, begin + 1, begin + (end - begin) / 2, end - 1);
        Ranked* const lower = split(begin + 1, end, begin);
        if (lower <= last)
            begin = lower;
        else
            end = lower;
    }
    for (Ranked* each = begin + 1; each < end; ++each)
        for (Ranked* at = each; at > begin && at->rank > (at - 1)->rank; --at) exchange(*at, *(at - 1));
    const float least = last->rank;
    Ranked *front = values + wanted, *back = values + count;
    for (;;) {
        while (front != back && front->rank >= least) ++front;
        if (front == back) break;
        --back;
        while (front != back && !(back->rank >= least)) --back;
        if (front == back) break;
        exchange(*front, *back);
        ++front;
    }
    return front - values;
}

}  // namespace rse_pf
