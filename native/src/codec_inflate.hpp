// Inflate one zlib stream from a stranger, within limits that hold while it is inflated.
//
// Source: RFC 1950 and RFC 1951.  What is refused is what zlib refuses.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__SSSE3__)
#include <tmmintrin.h>
#endif

#include "rse_pf_codec.h"

namespace rse_pf_codec {

constexpr uint64_t kAdlerBase = 65521;

// Add blocks of 32 bytes to both sums, at most 173 of them; return how many bytes were taken.
#if defined(__SSSE3__)
inline int64_t add_blocks(const uint8_t* bytes, int64_t count, uint64_t& a, uint64_t& b) {
    const __m128i first = _mm_setr_epi8(32, 31, 30, 29, 28, 27, 26, 25, 24, 23, 22, 21, 20, 19, 18, 17);
    const __m128i second = _mm_setr_epi8(16, 15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1);
    const __m128i zero = _mm_setzero_si128(), ones = _mm_set1_epi16(1);
    __m128i sum = zero, sums_before = zero, weighted = zero;
    const int64_t blocks = count / 32;
    for (int64_t i = 0; i < blocks; ++i, bytes += 32) {
        const __m128i low = _mm_loadu_si128(reinterpret_cast<const __m128i*>(bytes));
        const __m128i high = _mm_loadu_si128(reinterpret_cast<const __m128i*>(bytes + 16));
        sums_before = _mm_add_epi64(sums_before, sum);
        sum = _mm_add_epi64(sum, _mm_add_epi64(_mm_sad_epu8(low, zero), _mm_sad_epu8(high, zero)));
        weighted = _mm_add_epi32(weighted, _mm_madd_epi16(_mm_maddubs_epi16(low, first), ones));
        weighted = _mm_add_epi32(weighted, _mm_madd_epi16(_mm_maddubs_epi16(high, second), ones));
    }
    uint64_t of_bytes[2], before[2];
    uint32_t by_place[4];
    std::memcpy(of_bytes, &sum, 16);
    std::memcpy(before, &sums_before, 16);
    std::memcpy(by_place, &weighted, 16);
    b += a * 32 * static_cast<uint64_t>(blocks) + 32 * (before[0] + before[1]);
    for (const uint32_t lane : by_place) b += lane;
    a += of_bytes[0] + of_bytes[1];
    return 32 * blocks;
}
#else
inline int64_t add_blocks(const uint8_t* bytes, int64_t count, uint64_t& a, uint64_t& b) {
    int64_t at = 0;
    for (; count - at >= 32; at += 32) {
        uint32_t sum = 0, weighted = 0;
        for (uint32_t i = 0; i < 32; ++i) {
            sum += bytes[at + i];
            weighted += (32 - i) * bytes[at + i];
        }
        b += 32 * a + weighted;
        a += sum;
    }
    return at;
}
#endif

inline uint32_t adler32(const uint8_t* bytes, int64_t count) {
    constexpr int64_t kBlocks = 173 * 32;
    uint64_t a = 1, b = 0;
    while (count > 0) {
        const int64_t some = count < kBlocks ? count : kBlocks;
        int64_t taken = add_blocks(bytes, some, a, b);
        for (; taken < some; ++taken) b += a += bytes[taken];
        bytes += some;
        count -= some;
        a %= kAdlerBase;
        b %= kAdlerBase;
    }
    return static_cast<uint32_t>(b << 16 | a);
}

// A table of one Huffman code: the entries of all codes up to kRoot bits, and behind them those of longer ones.
// An entry is value << 8 | kind << 4 | bits: `bits` are taken; a kLink says where its second table begins.  A
// kLiteral and a kTwoLiterals hold as many bytes as their kind, the first one lowest.
enum Kind : uint32_t { kLiteral = 1, kTwoLiterals = 2, kMatch = 3, kEnd = 4, kLink = 5, kInvalid = 6 };

template <int kRootBits, int kEntries>
struct HuffmanTable {
    uint32_t entries[kEntries];
    int root_bits;  // at most kRootBits, and no more than the longest code has: short codes cost little

    uint64_t root_mask() const { return (uint64_t{1} << root_bits) - 1; }
    uint32_t find(uint64_t bits) const {
        const uint32_t entry = entries[bits & root_mask()];
        if ((entry >> 4 & 15) != kLink) return entry;
        return entries[(entry >> 8) + (bits >> root_bits & ((1u << (entry & 15)) - 1))];
    }

    // Fill the table for codes of `lengths`; false if they are no code, or one that zlib refuses.
    template <class EntryOf>
    constexpr bool fill(const uint8_t* lengths, int symbols, bool may_be_incomplete, EntryOf entry_of) {
        int count[16] = {};
        for (int symbol = 0; symbol < symbols; ++symbol) ++count[lengths[symbol]];
        int longest = 15;
        while (longest > 0 && count[longest] == 0) --longest;
        int left = 1;
        for (int length = 1; length <= 15; ++length) {
            left = 2 * left - count[length];
            if (left < 0) return false;
        }
        if (left > 0 && longest != 0 && !(may_be_incomplete && longest == 1)) return false;
        const int root = longest > kRootBits ? kRootBits : longest > 0 ? longest : 1;
        root_bits = root;
        if (left > 0) {
            for (int i = 0; i < 1 << root; ++i) entries[i] = kInvalid << 4 | 1;
        }
        int offsets[16] = {};
        uint16_t sorted[320] = {};
        offsets[1] = 0;
        for (int length = 1; length < 15; ++length) offsets[length + 1] = offsets[length] + count[length];
        for (int symbol = 0; symbol < symbols; ++symbol) {
            if (lengths[symbol] != 0) sorted[offsets[lengths[symbol]]++] = static_cast<uint16_t>(symbol);
        }
        uint32_t code = 0;  // with its first bit lowest, as it stands in the stream
        int next = 0, begin = 1 << root, second_bits = 0;
        uint32_t prefix = ~0u;
        for (int length = 1; length <= longest; ++length) {
            for (int remaining = count[length]; remaining > 0; --remaining, ++next) {
                const int symbol = sorted[next];
                const uint32_t entry = entry_of(symbol) | static_cast<uint32_t>(length);
                if (length <= root) {
                    for (uint32_t i = code; i < 1u << root; i += 1u << length) entries[i] = entry;
                } else {
                    const uint32_t low = code & ((1u << root) - 1);
                    if (low != prefix) {
                        if (prefix != ~0u) begin += 1 << second_bits;
                        prefix = low;
                        second_bits = length - root;
                        for (int space = (1 << second_bits) - remaining, bits = length; space > 0 && bits < longest;) {
                            ++second_bits;
                            ++bits;
                            space = 2 * space - count[bits];
                        }
                        if (begin + (1 << second_bits) > kEntries) return false;
                        entries[low] = static_cast<uint32_t>(begin) << 8 | kLink << 4 |
                                       static_cast<uint32_t>(second_bits);
                    }
                    for (uint32_t i = code >> root; i < 1u << second_bits; i += 1u << (length - root)) {
                        entries[static_cast<uint32_t>(begin) + i] = entry;
                    }
                }
                // The next code: add one at its last bit, which stands highest.
                uint32_t bit = 1u << (length - 1);
                while ((code & bit) != 0) bit >>= 1;
                code = bit == 0 ? 0 : (code & (bit - 1)) | bit;
            }
        }
        return true;
    }

    // Let an entry that has room for the bits of two literals hold both; where its first one ends stands at 24.
    constexpr void join_literals() {
        const auto root = static_cast<uint32_t>(root_bits);
        for (uint32_t i = 1u << root; i-- > 0;) {
            const uint32_t first = entries[i];
            if ((first >> 4 & 15) != kLiteral) continue;
            const uint32_t bits = first & 15, second = entries[i >> bits];
            const uint32_t both = bits + (second & 15);
            if ((second >> 4 & 15) != kLiteral || both > root) continue;
            entries[i] = bits << 24 | (second >> 8 & 255) << 16 | (first & 0xFF00) | kTwoLiterals << 4 | both;
        }
    }
};

// At most 286 codes of 15 bits need 852 entries with a root of 9 bits, and 30 need 402 with one of 8 (zlib's
// `enough.c`); `fill` refuses more in any case.
typedef HuffmanTable<9, 852> LiteralTable;
typedef HuffmanTable<8, 402> DistanceTable;

// zlib with the least memory ends a block after 127 symbols; nobody has a reason to end it sooner.
constexpr int64_t kFreeBlocks = 64, kBytesPerBlock = 100, kMaxBlocks = 2048;
// Blocks of fewer bytes, at the mean, are not worth the larger part of their tables.
constexpr int64_t kBytesToJoin = 2048;
// The time that a table takes follows the symbols in it; a block of numbers has about 40.
constexpr int64_t kMaxSymbols = 32 * kMaxBlocks;

// Of each code for a length: the shortest one, and the number of extra bits.
constexpr uint16_t kLengths[29] = {3,  4,  5,  6,  7,  8,  9,  10, 11,  13,  15,  17,  19,  23, 27,
                                   31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
constexpr uint8_t kLengthBits[29] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0};

constexpr uint32_t literal_entry(int symbol) {
    if (symbol < 256) return static_cast<uint32_t>(symbol) << 8 | kLiteral << 4;
    if (symbol == 256) return kEnd << 4;
    if (symbol > 285) return kInvalid << 4;
    const int k = symbol - 257;
    return static_cast<uint32_t>(kLengthBits[k]) << 24 | static_cast<uint32_t>(kLengths[k]) << 8 | kMatch << 4;
}

constexpr uint32_t distance_entry(int symbol) {
    if (symbol > 29) return kInvalid << 4;
    const auto code = static_cast<uint32_t>(symbol);
    const uint32_t extra = code < 4 ? 0 : code / 2 - 1;
    const uint32_t base = code < 4 ? code + 1 : (2 + (code & 1)) * (1u << extra) + 1;
    return extra << 24 | base << 8 | kMatch << 4;
}

// Both codes of a block.
struct Codes {
    LiteralTable literals;
    DistanceTable distances;
};

constexpr Codes fixed_codes() {
    Codes codes = {};
    uint8_t lengths[288] = {};
    for (int symbol = 0; symbol < 288; ++symbol) lengths[symbol] = symbol < 144 ? 8 : symbol < 256 ? 9 : symbol < 280 ? 7 : 8;
    codes.literals.fill(lengths, 288, true, literal_entry);
    for (int symbol = 0; symbol < 32; ++symbol) lengths[symbol] = 5;
    codes.distances.fill(lengths, 32, true, distance_entry);
    return codes;
}

constexpr Codes kFixedCodes = fixed_codes();

class Inflater {
public:
    Inflater(const uint8_t* data, int64_t bytes, const rse_pf_codec_budget& budget, uint8_t* text, int64_t room)
        : begin_(data), in_(data), end_(data + bytes), text_(text), out_(text) {
        const double by_ratio = static_cast<double>(bytes) * budget.inflate_ratio;
        int64_t most = by_ratio < 9e15 ? static_cast<int64_t>(by_ratio) : int64_t{1} << 53;
        if (most < budget.free_bytes) most = budget.free_bytes;
        most_ = most < budget.inflated_bytes ? most : budget.inflated_bytes;
        head_most_ = most_ < budget.free_bytes ? most_ : budget.free_bytes;
        const double head = static_cast<double>(budget.free_bytes) / budget.inflate_ratio;
        head_bytes_ = head < 9e15 ? static_cast<int64_t>(head) : int64_t{1} << 53;
        room_ = room;
        is_head_ = true;
        set_stop();
    }

    int32_t inflate() {
        if (end_ - in_ < 2) return RSE_PF_CODEC_NOT_ONE_STREAM;
        const uint32_t header = static_cast<uint32_t>(in_[0]) << 8 | in_[1];
        // Deflate with a window of at most 32 KiB, and no dictionary; zlib reads the name of one before it refuses it.
        if (header % 31 != 0 || (in_[0] & 15) != 8 || in_[0] >> 4 > 7) return RSE_PF_CODEC_NOT_ZLIB;
        if ((in_[1] & 32) != 0) return end_ - in_ < 6 ? RSE_PF_CODEC_NOT_ONE_STREAM : RSE_PF_CODEC_NOT_ZLIB;
        in_ += 2;
        for (bool is_last = false; !is_last;) {
            refill();
            if (count_ < 3) return RSE_PF_CODEC_NOT_ONE_STREAM;
            is_last = (bits_ & 1) != 0;
            const uint32_t kind = static_cast<uint32_t>(bits_ >> 1 & 3);
            drop(3);
            int32_t status = RSE_PF_CODEC_NOT_ZLIB;
            if (kind == 0) {
                status = stored();
            } else if (kind == 1) {
                codes_ = &kFixedCodes;
                status = coded();
            } else if (kind == 2) {
                // Tables are made for each block, so tiny blocks cost far more than their bytes.
                if (++blocks_ > kFreeBlocks + bytes() / kBytesPerBlock || blocks_ > kMaxBlocks) {
                    limit_ = blocks_ - 1;
                    return RSE_PF_CODEC_MANY_BLOCKS;
                }
                status = dynamic_codes();
                if (status == RSE_PF_CODEC_READ) status = coded();
            }
            if (status != RSE_PF_CODEC_READ) return status;
        }
        drop(count_ & 7);
        unread();
        if (end_ - in_ < 4) return RSE_PF_CODEC_NOT_ONE_STREAM;
        const uint32_t stated = static_cast<uint32_t>(in_[0]) << 24 | static_cast<uint32_t>(in_[1]) << 16 |
                                static_cast<uint32_t>(in_[2]) << 8 | in_[3];
        if (stated != adler32(text_, bytes())) return RSE_PF_CODEC_NOT_ZLIB;
        return end_ - in_ == 4 ? RSE_PF_CODEC_READ : RSE_PF_CODEC_NOT_ONE_STREAM;
    }

    int64_t bytes() const { return out_ - text_; }
    int64_t limit() const { return limit_; }

private:
    void refill() {
        if (end_ - in_ >= 8) {
            uint64_t more;
            std::memcpy(&more, in_, 8);
#if __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
            more = __builtin_bswap64(more);
#endif
            bits_ |= more << count_;
            in_ += (63 - count_) >> 3;
            count_ |= 56;
        } else {
            while (count_ <= 56 && in_ < end_) {
                bits_ |= static_cast<uint64_t>(*in_++) << count_;
                count_ += 8;
            }
        }
    }
    void drop(int count) {
        bits_ >>= count;
        count_ -= count;
    }
    // Give whole bytes back to the input.
    void unread() {
        in_ -= count_ >> 3;
        bits_ = 0;
        count_ = 0;
    }

    void set_stop() {
        int64_t most = is_head_ ? head_most_ : most_;
        if (room_ < most) most = room_;
        stop_ = text_ + most;
    }
    // Say what it means that `more` bytes do not fit before the stop; READ if they fit now.
    int32_t beyond(int64_t more) {
        if (is_head_ && bytes() + more > head_most_) {
            // A bomb shows itself here, at a quarter of the cost of inflating all that is allowed.
            const int64_t taken = (8 * (in_ - begin_) - count_ + 7) / 8;
            if (taken <= head_bytes_ || head_most_ == most_) {
                limit_ = head_most_;
                return RSE_PF_CODEC_TOO_LARGE;
            }
            is_head_ = false;
            set_stop();
        }
        if (out_ + more <= stop_) return RSE_PF_CODEC_READ;
        if (bytes() + more > most_) {
            limit_ = most_;
            return RSE_PF_CODEC_TOO_LARGE;
        }
        return RSE_PF_CODEC_NEEDS_ROOM;
    }

    int32_t stored() {
        drop(count_ & 7);
        unread();
        if (end_ - in_ < 4) return RSE_PF_CODEC_NOT_ONE_STREAM;
        const int64_t size = in_[0] | in_[1] << 8, inverse = in_[2] | in_[3] << 8;
        if (size != (inverse ^ 0xFFFF)) return RSE_PF_CODEC_NOT_ZLIB;
        in_ += 4;
        for (int64_t left = size; left > 0;) {
            const int64_t there = end_ - in_ < left ? end_ - in_ : left;
            if (there == 0) return RSE_PF_CODEC_NOT_ONE_STREAM;
            const int64_t fits = stop_ - out_ < there ? stop_ - out_ : there;
            std::memcpy(out_, in_, static_cast<size_t>(fits));
            in_ += fits;
            out_ += fits;
            left -= fits;
            if (fits < there) {
                ++in_;
                const int32_t status = beyond(1);
                --in_;
                if (status != RSE_PF_CODEC_READ) return status;
            }
        }
        return RSE_PF_CODEC_READ;
    }

    int32_t dynamic_codes() {
        static constexpr uint8_t kOrder[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
        refill();
        if (count_ < 14) return RSE_PF_CODEC_NOT_ONE_STREAM;
        const int literals = static_cast<int>(bits_ & 31) + 257, distances = static_cast<int>(bits_ >> 5 & 31) + 1;
        const int codes = static_cast<int>(bits_ >> 10 & 15) + 4;
        drop(14);
        if (literals > 286 || distances > 30) return RSE_PF_CODEC_NOT_ZLIB;
        uint8_t lengths[320] = {};
        for (int i = 0; i < codes; ++i) {
            if (count_ < 3) refill();
            if (count_ < 3) return RSE_PF_CODEC_NOT_ONE_STREAM;
            lengths[kOrder[i]] = static_cast<uint8_t>(bits_ & 7);
            drop(3);
        }
        HuffmanTable<7, 128> table;
        if (!table.fill(lengths, 19, false, [](int symbol) { return static_cast<uint32_t>(symbol) << 8; })) {
            return RSE_PF_CODEC_NOT_ZLIB;
        }
        std::memset(lengths, 0, sizeof lengths);
        for (int at = 0; at < literals + distances;) {
            refill();
            const uint32_t entry = table.find(bits_);
            const int taken = static_cast<int>(entry & 15);
            const uint32_t symbol = entry >> 8;
            if (taken > count_) return RSE_PF_CODEC_NOT_ONE_STREAM;
            if (symbol < 16) {
                drop(taken);
                lengths[at++] = static_cast<uint8_t>(symbol);
                continue;
            }
            const int extra = symbol == 16 ? 2 : symbol == 17 ? 3 : 7;
            if (taken + extra > count_) return RSE_PF_CODEC_NOT_ONE_STREAM;
            drop(taken);
            if (symbol == 16 && at == 0) return RSE_PF_CODEC_NOT_ZLIB;
            const int times = (symbol == 18 ? 11 : 3) + static_cast<int>(bits_ & ((1u << extra) - 1));
            drop(extra);
            if (at + times > literals + distances) return RSE_PF_CODEC_NOT_ZLIB;
            std::memset(lengths + at, symbol == 16 ? lengths[at - 1] : 0, static_cast<size_t>(times));
            at += times;
        }
        if (lengths[256] == 0) return RSE_PF_CODEC_NOT_ZLIB;
        for (int symbol = 0; symbol < literals + distances; ++symbol) symbols_ += lengths[symbol] != 0;
        if (symbols_ > kMaxSymbols) {
            limit_ = blocks_ - 1;
            return RSE_PF_CODEC_MANY_BLOCKS;
        }
        codes_ = &own_;
        if (!own_.literals.fill(lengths, literals, true, literal_entry)) return RSE_PF_CODEC_NOT_ZLIB;
        if (!own_.distances.fill(lengths + literals, distances, true, distance_entry)) return RSE_PF_CODEC_NOT_ZLIB;
        // Two bytes at once pay in long blocks only.
        if (blocks_ == 1 || bytes() >= blocks_ * kBytesToJoin) own_.literals.join_literals();
        return RSE_PF_CODEC_READ;
    }

    // Inflate a block as long as no limit and no end is near; `coded` does the rest.
    void coded_in_the_middle() {
        // Bytes may be what a pointer points to: only locals stay in registers.
        const uint8_t* in = in_;
        uint8_t* out = out_;
        uint64_t bits = bits_;
        int count = count_;
        const uint8_t* const in_stop = end_ - 16;
        uint8_t* const out_stop = stop_ - (258 + 16);
        const LiteralTable& literals = codes_->literals;
        const DistanceTable& distances = codes_->distances;
        const uint64_t mask = literals.root_mask();
        const auto refilled = [&] {
            uint64_t more;
            std::memcpy(&more, in, 8);
#if __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
            more = __builtin_bswap64(more);
#endif
            bits |= more << count;
            in += (63 - count) >> 3;
            count |= 56;
        };
        while (in <= in_stop && out <= out_stop) {
            refilled();
            uint32_t entry = literals.entries[bits & mask];
            // Five entries of at most 9 bits.
            for (int i = 0; i < 5 && (entry >> 4 & 15) <= kTwoLiterals; ++i) {
                const auto two = static_cast<uint16_t>(entry >> 8);
                out[0] = static_cast<uint8_t>(two);
                out[1] = static_cast<uint8_t>(two >> 8);
                out += entry >> 4 & 15;
                bits >>= entry & 15;
                count -= static_cast<int>(entry & 15);
                entry = literals.entries[bits & mask];
            }
            if ((entry >> 4 & 15) <= kTwoLiterals) continue;
            refilled();
            entry = literals.find(bits);
            const uint32_t kind = entry >> 4 & 15;
            if (kind == kLiteral) {
                *out++ = static_cast<uint8_t>(entry >> 8);
                bits >>= entry & 15;
                count -= static_cast<int>(entry & 15);
                continue;
            }
            if (kind != kMatch) break;
            // At most 48 of the 56 bits: a code and extra bits for the length, the same for the distance.
            uint64_t rest = bits >> (entry & 15);
            int taken = static_cast<int>((entry & 15) + (entry >> 24));
            const int64_t length = (entry >> 8 & 0xFFFF) + (static_cast<uint32_t>(rest) & ((1u << (entry >> 24)) - 1));
            rest >>= entry >> 24;
            const uint32_t far = distances.find(rest);
            if ((far >> 4 & 15) != kMatch) break;
            rest >>= far & 15;
            const int64_t distance = (far >> 8 & 0xFFFF) + (static_cast<uint32_t>(rest) & ((1u << (far >> 24)) - 1));
            if (distance > out - text_) break;
            taken += static_cast<int>((far & 15) + (far >> 24));
            bits >>= taken;
            count -= taken;
            out = copied(out, length, distance);
        }
        in_ = in;
        out_ = out;
        bits_ = bits;
        count_ = count;
    }

    int32_t coded() {
        for (;;) {
            if (end_ - in_ >= 16 && stop_ - out_ >= 258 + 16) coded_in_the_middle();
            refill();
            uint32_t entry = codes_->literals.find(bits_);
            if ((entry >> 4 & 15) == kTwoLiterals) {
                // One after the other, because a limit may lie between them.
                entry = (entry & 0xFF00) | kLiteral << 4 | entry >> 24;
            }
            const int taken = static_cast<int>(entry & 15);
            const uint32_t kind = entry >> 4 & 15;
            if (taken > count_) return RSE_PF_CODEC_NOT_ONE_STREAM;
            if (kind == kInvalid) return RSE_PF_CODEC_NOT_ZLIB;
            drop(taken);
            if (kind == kEnd) return RSE_PF_CODEC_READ;
            if (kind == kLiteral) {
                if (out_ == stop_) {
                    const int32_t status = beyond(1);
                    if (status != RSE_PF_CODEC_READ) return status;
                }
                *out_++ = static_cast<uint8_t>(entry >> 8);
                continue;
            }
            const int extra = static_cast<int>(entry >> 24);
            if (extra > count_) return RSE_PF_CODEC_NOT_ONE_STREAM;
            const int64_t length = (entry >> 8 & 0xFFFF) + (static_cast<uint32_t>(bits_) & ((1u << extra) - 1));
            drop(extra);
            const int32_t status = copy(length);
            if (status != RSE_PF_CODEC_READ) return status;
        }
    }

    // Copy bytes that may overlap, and up to 15 too many; return where the next one stands.
    static uint8_t* copied(uint8_t* to, int64_t length, int64_t distance) {
        const uint8_t* from = to - distance;
        uint8_t* const last = to + length;
        if (distance >= 16) {
            for (; to < last; to += 16, from += 16) std::memcpy(to, from, 16);
        } else if (distance == 1) {
            std::memset(to, *from, static_cast<size_t>(length));
        } else {
            while (to < last) *to++ = *from++;
        }
        return last;
    }

    int32_t copy(int64_t length) {
        const uint32_t entry = codes_->distances.find(bits_);
        const int taken = static_cast<int>(entry & 15), extra = static_cast<int>(entry >> 24);
        if (taken > count_) return RSE_PF_CODEC_NOT_ONE_STREAM;
        if ((entry >> 4 & 15) == kInvalid) return RSE_PF_CODEC_NOT_ZLIB;
        drop(taken);
        if (extra > count_) return RSE_PF_CODEC_NOT_ONE_STREAM;
        const int64_t distance = (entry >> 8 & 0xFFFF) + (static_cast<uint32_t>(bits_) & ((1u << extra) - 1));
        drop(extra);
        if (distance > bytes()) return RSE_PF_CODEC_NOT_ZLIB;
        if (length > stop_ - out_) {
            const int32_t status = beyond(length);
            if (status != RSE_PF_CODEC_READ) return status;
        }
        // The slack behind the buffer takes what is too many.
        out_ = copied(out_, length, distance);
        return RSE_PF_CODEC_READ;
    }

    const uint8_t* const begin_;
    const uint8_t* in_;
    const uint8_t* const end_;
    uint8_t* const text_;
    uint8_t* out_;
    uint8_t* stop_ = nullptr;
    int64_t room_ = 0, most_ = 0, head_most_ = 0, head_bytes_ = 0, limit_ = 0;
    int64_t blocks_ = 0;   // those with codes of their own
    int64_t symbols_ = 0;  // in those codes
    bool is_head_ = true;
    uint64_t bits_ = 0;  // the next bits of the stream, the first one lowest
    int count_ = 0;      // how many of them are valid
    const Codes* codes_ = &kFixedCodes;
    Codes own_;
};

}  // namespace rse_pf_codec
