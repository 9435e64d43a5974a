// Selection of the best keypoints, in the very order in which std::nth_element and std::partition of libstdc++ leave
// them, because OpenCV's keypoints have that order.
//
// The method is introselect (Musser, Introspective sorting and selection algorithms, 1997): ranges are split at the
// median of three until the last wanted element is in its place.  The order of equal elements depends on the sequence
// of exchanges, so every exchange below is part of the result.
#pragma once

#include <cstdint>

namespace rse_pf {

// A candidate keypoint: its response (larger is better) and the index of its pixel in the level.
struct Ranked {
    float rank;
    int32_t index;
};

inline void exchange(Ranked& a, Ranked& b) {
    const Ranked held = a;
    a = b;
    b = held;
}

// Exchange *first* with the median of *a, *b and *c by rank; of equal ranks, with the one that libstdc++ takes.
inline void move_median_to_first(Ranked* first, Ranked* a, Ranked* b, Ranked* c) {
    Ranked *const high = a->rank > b->rank ? a : b, *const low = high == a ? b : a;
    exchange(*first, low->rank > c->rank ? *low : high->rank > c->rank ? *c : *high);
}

// Partition [begin, end) in place into ranks above and below that of the pivot; return where the lower part begins.
// The range must hold a rank on either side of the pivot's, because the two searches do not test for its ends.
inline Ranked* partition(Ranked* begin, Ranked* end, const Ranked* pivot) {
    for (;;) {
        while (begin->rank > pivot->rank) ++begin;
        --end;
        while (pivot->rank > end->rank) --end;
        if (!(begin < end)) return begin;
        exchange(*begin, *end);
        ++begin;
    }
}

// Move the `wanted` best of `count` candidates, and all that equal the last of them, to the front, and return how many
// these are: all, in their order, if there are not more than wanted.  Return -1 if the ranges become so unequal that
// libstdc++ would change to heap selection, whose order is not known here.
inline int64_t keep_best(Ranked* values, int64_t count, int64_t wanted) {
    if (count <= wanted || wanted <= 0) return count <= wanted ? count : 0;
    // 1. Narrow the range around the last wanted element until at most three elements are left.
    Ranked *begin = values, *end = values + count, *const last = values + wanted - 1;
    int64_t splits = 2 * (63 - __builtin_clzll(static_cast<uint64_t>(count)));
    while (end - begin > 3) {
        if (splits-- == 0) return -1;
        move_median_to_first(begin, begin + 1, begin + (end - begin) / 2, end - 1);
        Ranked* const lower = partition(begin + 1, end, begin);
        if (lower <= last)
            begin = lower;
        else
            end = lower;
    }
    // 2. Sort the rest by insertion.
    for (Ranked* next = begin + 1; next < end; ++next)
        for (Ranked* at = next; at > begin && at->rank > (at - 1)->rank; --at) exchange(*at, *(at - 1));
    // 3. Move the other candidates that equal the last wanted one directly behind it, as std::partition does.
    const float min_rank = last->rank;
    Ranked *front = values + wanted, *back = values + count;
    for (;;) {
        while (front != back && front->rank >= min_rank) ++front;
        if (front == back) break;
        --back;
        while (front != back && !(back->rank >= min_rank)) --back;
        if (front == back) break;
        exchange(*front, *back);
        ++front;
    }
    return front - values;
}

}  // namespace rse_pf
