// Vectors of eight numbers ("lanes"), whose results are the same bytes on every processor.
//
// A vector is one register, or a pair of narrower vectors where registers are narrower.  The width changes no result,
// because every operation is a single IEEE 754 operation (the build forbids contraction), and because the eight lanes
// are summed in one fixed order.
//
// This header is compiled once for each set of instructions, inside the namespace RSE_PF_ISA.  It uses no templates of
// the standard library: the linker could otherwise take a function compiled for AVX2 into the portable solver.
#pragma once

#include <cstdint>

#define RSE_PF_INLINE static inline __attribute__((always_inline))

namespace RSE_PF_ISA {

// Numbers in a vector: eight doubles fill a register of AVX-512.
constexpr int64_t kLanes = 8;

typedef float Float4 __attribute__((vector_size(16)));
typedef float Float8 __attribute__((vector_size(32)));
typedef double Double2 __attribute__((vector_size(16)));
typedef double Double4 __attribute__((vector_size(32)));
typedef double Double8 __attribute__((vector_size(64)));

template <class V>
struct Pair {
    V low, high;
};

#ifdef __AVX512F__
typedef Float8 Floats;
typedef Double8 Doubles;
#elif defined(__AVX2__)
typedef Float8 Floats;
typedef Pair<Double4> Doubles;
#else
typedef Pair<Float4> Floats;
typedef Pair<Pair<Double2>> Doubles;
#endif

template <class V>
RSE_PF_INLINE Pair<V> operator+(const Pair<V>& a, const Pair<V>& b) {
    return {a.low + b.low, a.high + b.high};
}
template <class V>
RSE_PF_INLINE Pair<V> operator-(const Pair<V>& a, const Pair<V>& b) {
    return {a.low - b.low, a.high - b.high};
}
template <class V>
RSE_PF_INLINE Pair<V> operator*(const Pair<V>& a, const Pair<V>& b) {
    return {a.low * b.low, a.high * b.high};
}
template <class V>
RSE_PF_INLINE Pair<V> operator/(const Pair<V>& a, const Pair<V>& b) {
    return {a.low / b.low, a.high / b.high};
}

// Return for each lane the value of `yes` where a < b, else (also where a or b is nan) the value of `no`.
RSE_PF_INLINE Float4 where_less(Float4 a, Float4 b, Float4 yes, Float4 no) { return a < b ? yes : no; }
RSE_PF_INLINE Float8 where_less(Float8 a, Float8 b, Float8 yes, Float8 no) { return a < b ? yes : no; }
RSE_PF_INLINE Double2 where_less(Double2 a, Double2 b, Double2 yes, Double2 no) { return a < b ? yes : no; }
RSE_PF_INLINE Double4 where_less(Double4 a, Double4 b, Double4 yes, Double4 no) { return a < b ? yes : no; }
RSE_PF_INLINE Double8 where_less(Double8 a, Double8 b, Double8 yes, Double8 no) { return a < b ? yes : no; }
template <class V>
RSE_PF_INLINE Pair<V> where_less(const Pair<V>& a, const Pair<V>& b, const Pair<V>& yes, const Pair<V>& no) {
    return {where_less(a.low, b.low, yes.low, no.low), where_less(a.high, b.high, yes.high, no.high)};
}

template <class V>
struct LanesOf;
template <>
struct LanesOf<float> {
    typedef Floats type;
};
template <>
struct LanesOf<double> {
    typedef Doubles type;
};
template <class T>
using Lanes = typename LanesOf<T>::type;

// Read eight numbers from an address that is aligned to 32 bytes: the arrays of a Workspace are aligned to 64 bytes and
// padded to a multiple of eight.
template <class T>
RSE_PF_INLINE Lanes<T> load(const T* from) {
    Lanes<T> lanes;
    __builtin_memcpy(&lanes, __builtin_assume_aligned(from, 32), sizeof lanes);
    return lanes;
}
template <class T>
RSE_PF_INLINE void store(T* to, const Lanes<T>& lanes) {
    __builtin_memcpy(__builtin_assume_aligned(to, 32), &lanes, sizeof lanes);
}
RSE_PF_INLINE void fill(Float4& lanes, float value) { lanes = Float4{value, value, value, value}; }
RSE_PF_INLINE void fill(Float8& lanes, float value) {
    lanes = Float8{value, value, value, value, value, value, value, value};
}
RSE_PF_INLINE void fill(Double2& lanes, double value) { lanes = Double2{value, value}; }
RSE_PF_INLINE void fill(Double4& lanes, double value) { lanes = Double4{value, value, value, value}; }
RSE_PF_INLINE void fill(Double8& lanes, double value) {
    lanes = Double8{value, value, value, value, value, value, value, value};
}
template <class V, class T>
RSE_PF_INLINE void fill(Pair<V>& lanes, T value) {
    fill(lanes.low, value);
    fill(lanes.high, value);
}
// Return a vector with a value in all eight lanes.
template <class T>
RSE_PF_INLINE Lanes<T> all(T value) {
    Lanes<T> lanes;
    fill(lanes, value);
    return lanes;
}

// Return the sum of the eight lanes, in one order on every processor.
template <class T>
RSE_PF_INLINE T sum(const Lanes<T>& lanes) {
    alignas(64) T x[kLanes];
    store(x, lanes);
    return ((x[0] + x[1]) + (x[2] + x[3])) + ((x[4] + x[5]) + (x[6] + x[7]));
}

// Return the number of rows, rounded up to whole vectors.
RSE_PF_INLINE int64_t padded(int64_t rows) { return (rows + kLanes - 1) / kLanes * kLanes; }

}  // namespace RSE_PF_ISA
