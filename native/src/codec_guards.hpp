// The guards of rse_pf/budget.py: the same verdicts in the same order, in one or two passes over the bytes.
//
// Source: MessagePack specification, https://github.com/msgpack/msgpack/blob/master/spec.md, "Formats".
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

#include "rse_pf_codec.h"

namespace rse_pf_codec {

constexpr int64_t kListValues = 3, kMapValues = 6;
constexpr int64_t kStringBytes = 60, kNumberBytes = 32, kWide = 7, kMaxBytesPerByte = 8, kFewStrings = 2000;

// --- JSON ------------------------------------------------------------------------------------------------

struct Counts {
    int64_t lists, objects, commas, colons, quotes;
    bool is_ascii;

    int64_t containers() const { return lists + objects; }
    int64_t values() const { return commas + colons + kListValues * lists + kMapValues * objects; }
};

typedef uint8_t Bytes16 __attribute__((vector_size(16)));

inline int64_t sum_of(Bytes16 lanes) {
    int64_t sum = 0;
    for (int i = 0; i < 16; ++i) sum += lanes[i];
    return sum;
}

inline Counts count_marks(const uint8_t* text, int64_t bytes) {
    Counts counts = {0, 0, 0, 0, 0, true};
    Bytes16 high = {};
    int64_t at = 0;
    while (bytes - at >= 16) {
        Bytes16 lists = {}, objects = {}, commas = {}, colons = {}, quotes = {};
        // A lane counts to 255.
        for (int i = 0; i < 255 && bytes - at >= 16; ++i, at += 16) {
            Bytes16 piece;
            std::memcpy(&piece, text + at, 16);
            lists -= reinterpret_cast<Bytes16>(piece == '[');
            objects -= reinterpret_cast<Bytes16>(piece == '{');
            commas -= reinterpret_cast<Bytes16>(piece == ',');
            colons -= reinterpret_cast<Bytes16>(piece == ':');
            quotes -= reinterpret_cast<Bytes16>(piece == '"');
            high |= piece;
        }
        counts.lists += sum_of(lists);
        counts.objects += sum_of(objects);
        counts.commas += sum_of(commas);
        counts.colons += sum_of(colons);
        counts.quotes += sum_of(quotes);
    }
    uint8_t any = 0;
    for (; at < bytes; ++at) {
        counts.lists += text[at] == '[';
        counts.objects += text[at] == '{';
        counts.commas += text[at] == ',';
        counts.colons += text[at] == ':';
        counts.quotes += text[at] == '"';
        any = static_cast<uint8_t>(any | text[at]);
    }
    for (int i = 0; i < 16; ++i) any = static_cast<uint8_t>(any | high[i]);
    counts.is_ascii = any < 0x80;
    return counts;
}

// Levels of nesting with and without the brackets inside strings, and the marks outside of strings.
struct Structure {
    int64_t depth_with_strings, depth;
    Counts outside;
};

inline Structure structure_of(const uint8_t* text, int64_t bytes) {
    Structure found = {0, 0, {0, 0, 0, 0, 0, true}};
    int64_t all = 0, level = 0;
    bool is_inside = false, is_escaped = false;  // escaped: after an odd number of backslashes
    for (int64_t at = 0; at < bytes; ++at) {
        const uint8_t byte = text[at];
        if (byte == '\\') {
            is_escaped = !is_escaped;
            continue;
        }
        if (byte == '"') {
            if (!is_escaped) is_inside = !is_inside;
        } else if (byte == '[' || byte == '{') {
            if (++all > found.depth_with_strings) found.depth_with_strings = all;
            if (!is_inside) {
                (byte == '[' ? found.outside.lists : found.outside.objects) += 1;
                if (++level > found.depth) found.depth = level;
            }
        } else if (byte == ']' || byte == '}') {
            --all;
            if (!is_inside) --level;
        } else if (!is_inside) {
            found.outside.commas += byte == ',';
            found.outside.colons += byte == ':';
        }
        is_escaped = false;
    }
    return found;
}

// Return the number of characters between quotes, none of which is escaped.
inline int64_t characters_of(const uint8_t* text, int64_t bytes) {
    const uint8_t* const end = text + bytes;
    const uint8_t* at = text;
    int64_t count = 0;
    while (at < end) {
        const void* const begin = std::memchr(at, '"', static_cast<size_t>(end - at));
        if (begin == nullptr) break;
        at = static_cast<const uint8_t*>(begin) + 1;
        const void* const close = at < end ? std::memchr(at, '"', static_cast<size_t>(end - at)) : nullptr;
        if (close == nullptr) return bytes;
        count += static_cast<const uint8_t*>(close) - static_cast<const uint8_t*>(begin);
        at = static_cast<const uint8_t*>(close) + 1;
    }
    return count;
}

inline bool exceeds_memory(const uint8_t* text, int64_t bytes, const Counts& counts, int64_t max_bytes) {
    if (kMaxBytesPerByte * bytes <= max_bytes) return false;
    bool has_unicode = false, has_quote = false;  // \u and \"
    const uint8_t* const end = text + bytes;
    for (const uint8_t* at = text; at + 1 < end;) {
        const void* const found = std::memchr(at, '\\', static_cast<size_t>(end - 1 - at));
        if (found == nullptr) break;
        at = static_cast<const uint8_t*>(found) + 1;
        has_unicode |= *at == 'u';
        has_quote |= *at == '"';
    }
    const int64_t strings = counts.quotes / 2, width = counts.is_ascii && !has_unicode ? 1 : kWide;
    const int64_t numbers = counts.commas + counts.colons;
    const int64_t other =
        bytes + kStringBytes * strings + kNumberBytes * (numbers > strings ? numbers - strings : 0);
    if (other + width * bytes <= max_bytes) return false;
    const int64_t characters = strings > kFewStrings || has_quote ? bytes : characters_of(text, bytes);
    return other + width * characters > max_bytes;
}

// How many values a number counts as beyond its own, because decoders need longer for it (0.2 to 14 us, not 0.1): many
// digits, the middle between two doubles, and what is about as small or large as a double can be.
constexpr int64_t kLongDigits = 19, kWideDigits = 32, kMiddleDigits = 16, kMiddlePower = -4;
constexpr int64_t kMiddleValues = 10, kFarValues = 160, kFarExponent = 100, kLargeExponent = 20;
constexpr int64_t kMostExponent = 1000000000;
// No text counts for more.
constexpr int64_t kMostValuesPerByte = 40;

inline bool is_digit(uint8_t byte) { return static_cast<uint8_t>(byte - '0') < 10; }
inline bool is_digit_or_point(uint8_t byte) { return is_digit(byte) || byte == '.'; }
inline bool is_exponent(uint8_t byte) { return (byte | 0x20) == 'e'; }

// Read the exponent whose letter stands at `at`; false if no digit follows.
inline bool read_exponent(const uint8_t* at, const uint8_t* end, int64_t& exponent, bool& is_negative) {
    ++at;
    is_negative = at < end && *at == '-';
    if (at < end && (*at == '-' || *at == '+')) ++at;
    if (at == end || !is_digit(*at)) return false;
    exponent = 0;
    for (; at < end && is_digit(*at); ++at) {
        if (exponent < kMostExponent) exponent = 10 * exponent + (*at - '0');
    }
    return true;
}

// Return for how many more values an exponent counts.
inline int64_t values_of_exponent(const uint8_t* at, const uint8_t* end) {
    int64_t exponent;
    bool is_negative;
    if (!read_exponent(at, end, exponent, is_negative)) return 0;
    if (exponent >= kFarExponent) return kFarValues;
    return exponent >= kLargeExponent && !is_negative ? kMiddleValues : 0;
}

// Return for how many more values the digits from `at` to `stop` count, with a point among them.
inline int64_t values_of_digits(const uint8_t* at, const uint8_t* stop, const uint8_t* end) {
    const auto point_from = [&](const uint8_t* from) {
        return static_cast<const uint8_t*>(std::memchr(from, '.', static_cast<size_t>(stop - from)));
    };
    const uint8_t* first = at;
    while (first < stop && (*first == '0' || *first == '.')) ++first;
    const uint8_t* const point = point_from(at);
    const bool has_point = point != nullptr;
    int64_t digits = stop - at, significant = stop - first;
    for (const uint8_t* each = point; each != nullptr; each = point_from(each + 1)) {
        --digits;
        significant -= each >= first;
    }
    const int64_t decimals = has_point ? stop - point - 1 : 0;
    const int64_t values = significant >= kLongDigits || digits >= kWideDigits ? digits / 2 : 0;
    if (significant < kMiddleDigits) return values;
    int64_t exponent = 0;
    bool is_negative = false;
    const bool has_exponent = stop < end && is_exponent(*stop) && read_exponent(stop, end, exponent, is_negative);
    const int64_t power = (is_negative ? -exponent : exponent) - decimals;
    return values + ((has_point || has_exponent) && power >= kMiddlePower ? kMiddleValues : 0);
}

// Say quickly that digits count for nothing more, as those of most real numbers do.
inline bool is_usual(const uint8_t* at, const uint8_t* stop, const uint8_t* end) {
    if (stop - at >= kLongDigits || (stop < end && is_exponent(*stop))) return false;
    const void* const point = std::memchr(at, '.', static_cast<size_t>(stop - at));
    return point == nullptr || static_cast<const uint8_t*>(point) - at < kMiddleDigits + kMiddlePower;
}

// Say which of sixteen bytes are digits or points, and which are an exponent's letter.
inline void marks_of_numbers(const uint8_t* at, uint32_t& digits, uint32_t& letters) {
#if defined(__SSE2__)
    const __m128i bytes = _mm_loadu_si128(reinterpret_cast<const __m128i*>(at));
    const __m128i values = _mm_sub_epi8(bytes, _mm_set1_epi8('0'));
    const __m128i are_digits = _mm_cmpeq_epi8(_mm_min_epu8(values, _mm_set1_epi8(9)), values);
    const __m128i are_points = _mm_cmpeq_epi8(bytes, _mm_set1_epi8('.'));
    digits = static_cast<uint32_t>(_mm_movemask_epi8(_mm_or_si128(are_digits, are_points)));
    letters = static_cast<uint32_t>(
        _mm_movemask_epi8(_mm_cmpeq_epi8(_mm_or_si128(bytes, _mm_set1_epi8(0x20)), _mm_set1_epi8('e'))));
#else
    digits = letters = 0;
    for (int i = 0; i < 16; ++i) {
        digits |= static_cast<uint32_t>(is_digit(at[i]) || at[i] == '.') << i;
        letters |= static_cast<uint32_t>((at[i] | 0x20) == 'e') << i;
    }
#endif
}

// Return for how many more values the numbers between `begin` and `end` count, or at least `enough`.
//
// Only sixteen digits in a row, and exponents, are looked at more closely.
inline int64_t more_values_between(const uint8_t* const begin, const uint8_t* const end, int64_t enough) {
    int64_t values = 0, run = 0;  // run: digits and points directly before `at`
    for (const uint8_t* at = begin; at < end && values < enough;) {
        uint8_t last[16] = {};
        const uint8_t* sixteen = at;
        if (end - at < 16) {
            std::memcpy(last, at, static_cast<size_t>(end - at));
            sixteen = last;
        }
        uint32_t digits, letters;
        marks_of_numbers(sixteen, digits, letters);
        const int leading = __builtin_ctz(~digits);
        letters &= digits << 1 | (run > 0 ? 1u : 0u);
        if (run + leading >= kMiddleDigits) {
            // What is before `at` in this row of digits is known.
            const uint8_t* const from = at - run;
            at += leading;
            if (leading == 16) {
                while (at < end && is_digit_or_point(*at)) ++at;
            }
            if (!is_usual(from, at, end)) values += values_of_digits(from, at, end);
            run = 1;
            continue;
        }
        for (; letters != 0; letters &= letters - 1) values += values_of_exponent(at + __builtin_ctz(letters), end);
        run = __builtin_clz(~(digits << 16));
        at += 16;
    }
    return values;
}

// The same, without the numbers inside strings.
inline int64_t more_values_outside(const uint8_t* const text, int64_t bytes, int64_t enough) {
    const uint8_t* const end = text + bytes;
    const auto next_quote = [&](const uint8_t* at) {
        for (; at < end; ++at) {
            at = static_cast<const uint8_t*>(std::memchr(at, '"', static_cast<size_t>(end - at)));
            if (at == nullptr) return end;
            const uint8_t* escapes = at;
            while (escapes > text && escapes[-1] == '\\') --escapes;
            if (((at - escapes) & 1) == 0) return at;
        }
        return end;
    };
    int64_t values = 0;
    for (const uint8_t* at = text; at < end && values < enough;) {
        const uint8_t* const opens = next_quote(at);
        values += more_values_between(at, opens, enough - values);
        const uint8_t* const closes = opens < end ? next_quote(opens + 1) : end;
        at = closes < end ? closes + 1 : end;
    }
    return values;
}

inline int32_t check_json(const uint8_t* text, int64_t bytes, const rse_pf_codec_budget& budget) {
    const Counts counts = count_marks(text, bytes);
    const bool has_many = counts.containers() > budget.depth;
    const int64_t left = budget.values - counts.values();
    const bool has_values = left <= 0 || (bytes * kMostValuesPerByte >= left &&
                                          more_values_between(text, text + bytes, left) >= left);
    if (has_many || has_values) {
        const Structure found = structure_of(text, bytes);
        if (has_many &&
            !(counts.containers() <= budget.containers && found.depth_with_strings <= budget.depth)) {
            if (found.outside.containers() > budget.containers) return RSE_PF_CODEC_CONTAINERS;
            if (found.depth > budget.depth) return RSE_PF_CODEC_DEPTH;
        }
        if (has_values) {
            const int64_t outside = budget.values - found.outside.values();
            if (outside <= 0 || more_values_outside(text, bytes, outside) >= outside) return RSE_PF_CODEC_VALUES;
        }
    }
    return exceeds_memory(text, bytes, counts, budget.memory_bytes) ? RSE_PF_CODEC_MEMORY : RSE_PF_CODEC_NOT_MINE;
}

// --- MessagePack -----------------------------------------------------------------------------------------

constexpr int64_t kFlatFrom = 32;
constexpr int64_t kMaxDepth = 256;

inline uint64_t big_endian(const uint8_t* at, int bytes) {
    uint64_t value = 0;
    for (int i = 0; i < bytes; ++i) value = value << 8 | at[i];
    return value;
}

// Return the distance from a value to the next one by its first byte; 0 for what states its length or its items.
inline int32_t step_of(uint8_t first) {
    if (first < 0x80 || first >= 0xE0) return 1;
    if (first < 0xA0) return 0;
    if (first < 0xC0) return 1 + (first & 31);
    static constexpr uint8_t kSteps[32] = {
        1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 5, 9, 2, 3, 5, 9,  // c0: nil, -, bool, bool, bin, ext, floats, unsigned
        2, 3, 5, 9, 3, 4, 6, 10, 18, 0, 0, 0, 0, 0, 0, 0,  // d0: signed, fixext, str, lists, maps
    };
    return kSteps[first - 0xC0];
}

// Return the size of `count` numbers of one kind at `at`; 0 if there is something else.
inline int64_t flat_bytes(const uint8_t* data, int64_t at, int64_t end, int64_t count) {
    const uint8_t first = data[at];
    const int64_t step = step_of(first);
    if (first < 0x80) {
        uint8_t any = 0;
        for (int64_t i = 0; i < count; ++i) any = static_cast<uint8_t>(any | data[at + i]);
        return any < 0x80 ? count : 0;
    }
    if (step <= 0 || (first >= 0xA0 && first < 0xC0) || at + step * count > end) return 0;
    for (int64_t i = 0; i < count; ++i) {
        if (data[at + i * step] != first) return 0;
    }
    return step * count;
}

inline int32_t check_msgpack(const uint8_t* data, int64_t end, const rse_pf_codec_budget& budget) {
    if (budget.depth >= kMaxDepth) return RSE_PF_CODEC_UNKNOWN;
    int64_t outer[kMaxDepth];  // of each list or map that is open: how many values follow this one in it
    int64_t open = 0, at = 0, left = 1, values = 0, containers = 0, limit = budget.mixed_values;
    for (;;) {
        while (left != 0) {
            if (at >= end) return RSE_PF_CODEC_CUT_OFF;
            const uint8_t first = data[at];
            const int32_t step = step_of(first);
            --left;
            ++values;
            const bool is_map = (first >= 0x80 && first < 0x90) || first == 0xDE || first == 0xDF;
            const bool is_list = (first >= 0x90 && first < 0xA0) || first == 0xDC || first == 0xDD;
            if (step > 0) {
                at += step;
            } else if (is_map || is_list) {
                const int width = first < 0xA0 ? 0 : (first & 1) == 0 ? 2 : 4;
                if (end - at <= width) return RSE_PF_CODEC_CUT_OFF;
                int64_t count = width == 0 ? first & 15 : static_cast<int64_t>(big_endian(data + at + 1, width));
                at += 1 + width;
                ++containers;
                values += (is_map ? kMapValues : kListValues) - 1;
                if (count > end - at) return RSE_PF_CODEC_CUT_OFF;  // each value takes a byte
                const int64_t flat = count >= kFlatFrom && is_list ? flat_bytes(data, at, end, count) : 0;
                if (flat != 0) {
                    at += flat;
                    values += count;
                    limit = budget.values < limit + count ? budget.values : limit + count;
                    count = 0;
                }
                const int64_t depth = open + 1;
                if (count != 0) {
                    outer[open++] = left;
                    left = is_map ? 2 * count : count;
                }
                if (open >= budget.depth || containers > budget.containers) {
                    if (containers > budget.containers) return RSE_PF_CODEC_CONTAINERS;
                    if (depth > budget.depth) return RSE_PF_CODEC_DEPTH;
                }
            } else {
                const int width = first >= 0xD9 ? 1 << (first - 0xD9) : 1 << ((first - 0xC4) % 3);
                const bool is_extension = first >= 0xC7 && first <= 0xC9;
                ++values;
                if (end - at <= width) {
                    // Cut off within its length: what exceeds the limit is said first.
                    at = end + 1;
                } else {
                    at += 1 + width + is_extension + static_cast<int64_t>(big_endian(data + at + 1, width));
                }
            }
            if (values > limit) return RSE_PF_CODEC_VALUES;
        }
        if (open == 0) break;
        left = outer[--open];
    }
    if (at > end) return RSE_PF_CODEC_CUT_OFF;
    return at == end ? RSE_PF_CODEC_NOT_MINE : RSE_PF_CODEC_FOLLOWED;
}

}  // namespace rse_pf_codec
