// Deflate the text of a reply with a fixed code of its own: numbers have no repetitions that pay.
//
// Source: RFC 1950 and RFC 1951, Sect. 3.2.7.
#pragma once

#include <cstdint>
#include <cstring>

#include "codec_inflate.hpp"
#include "reply_code.hpp"

namespace rse_pf_codec {

// Write the zlib stream of `text`, which needs at most 2 * bytes + 256 bytes, and return its size.
inline int64_t deflate(const uint8_t* text, int64_t bytes, uint8_t* deflated) {
    constexpr int kWhole = kHeadBits / 8;
    static_assert(sizeof kHead < 200 && sizeof kHead >= kWhole);
    std::memcpy(deflated, kHead, kWhole);
    uint8_t* out = deflated + kWhole;
    uint64_t bits = kHeadBits % 8 == 0 ? 0 : kHead[kWhole];
    int count = kHeadBits % 8;
    const auto put = [&](uint32_t code) {
        bits |= static_cast<uint64_t>(code >> 4) << count;
        count += static_cast<int>(code & 15);
    };
    const auto flush = [&] {
        for (; count >= 8; count -= 8, bits >>= 8) *out++ = static_cast<uint8_t>(bits);
    };
    int64_t at = 0;
    // At most 7 bits wait, and three codes have 45.
    for (; at + 3 <= bytes; at += 3) {
        put(kCodes[text[at]]);
        put(kCodes[text[at + 1]]);
        put(kCodes[text[at + 2]]);
#if __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__
        std::memcpy(out, &bits, 8);
        out += count >> 3;
        bits >>= count & ~7;
        count &= 7;
#else
        flush();
#endif
    }
    for (; at < bytes; ++at) {
        put(kCodes[text[at]]);
        flush();
    }
    put(kCodes[256]);
    flush();
    if (count > 0) *out++ = static_cast<uint8_t>(bits);
    const uint32_t checksum = adler32(text, bytes);
    for (int shift = 24; shift >= 0; shift -= 8) *out++ = static_cast<uint8_t>(checksum >> shift);
    return out - deflated;
}

}  // namespace rse_pf_codec
