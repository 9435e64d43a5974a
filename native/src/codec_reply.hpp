// Write a solved pose as the reply of `pnp`: JSON text, or MessagePack with raw arrays.
//
// The bytes are those that `rse_pf.services.pnp.PnpReply` is encoded to.
#pragma once

#include <cstdint>
#include <cstring>

#include "codec_shortest.hpp"
#include "rse_pf_codec.h"
#include "rse_pf_native.h"

namespace rse_pf_codec {

// Numbers of a pose and of the upper triangle of a covariance.
constexpr int64_t kPose = 16, kTriangle = 21;
// An extension of MessagePack has 16 bits for its length.
constexpr int64_t kMaxInliers = 16383;
constexpr int64_t kNamesBytes = 256, kDigitsOfRow = 6;
constexpr int64_t kMaxJsonNumbers = (kPose + kTriangle + 1) * (kMaxNumberBytes + 1);

// Room that a reply of `rows` rows takes at most.
inline int64_t reply_bytes(int64_t rows, bool is_json) {
    const int64_t others = is_json ? kMaxJsonNumbers : 8 * kPose + 4 * kTriangle + 9;
    return kNamesBytes + others + rows * (is_json ? kDigitsOfRow : 4);
}

struct ReplyText {
    const char* verdict;
    const char* reason;
};

inline ReplyText text_of(int32_t reason) {
    static constexpr const char* kReasons[] = {"",          "few-inliers",        "low-inlier-ratio", "nearly-collinear",
                                               "clustered", "poorly-constrained", "ambiguous"};
    return {reason == RSE_PF_PNP_OK ? "ok" : "weak", kReasons[reason]};
}

inline void upper_triangle(const double (&covariance)[36], float (&triangle)[kTriangle]) {
    float* next = triangle;
    for (int row = 0; row < 6; ++row) {
        for (int column = row; column < 6; ++column) *next++ = static_cast<float>(covariance[6 * row + column]);
    }
}

// Write the number of a row and return what is behind it.
inline uint8_t* write_row(int64_t row, uint8_t* at) {
    uint8_t digits[8];
    int first = 8;
    do {
        digits[--first] = static_cast<uint8_t>('0' + row % 10);
        row /= 10;
    } while (row != 0);
    const int count = 8 - first;
    for (int i = 0; i < count; ++i) at[i] = digits[first + i];
    return at + count;
}

class MsgpackReply {
public:
    explicit MsgpackReply(uint8_t* at) : at_(at) {}

    bool write(const rse_pf_pnp_result& result, const int64_t* inliers) {
        float triangle[kTriangle];
        upper_triangle(result.covariance, triangle);
        const ReplyText text = text_of(result.reason);
        *at_++ = 0x87;
        word("T_camera_world");
        extension(3, result.T_camera_world, sizeof result.T_camera_world);
        word("inliers");
        head(2, 4 * result.count);
        for (int64_t i = 0; i < result.count; ++i) {
            const auto row = static_cast<uint32_t>(inliers[i]);
            std::memcpy(at_, &row, 4);
            at_ += 4;
        }
        word("rmse_px");
        uint64_t bits;
        std::memcpy(&bits, &result.rmse_px, 8);
        *at_++ = 0xCB;
        for (int shift = 56; shift >= 0; shift -= 8) *at_++ = static_cast<uint8_t>(bits >> shift);
        word("covariance");
        extension(1, triangle, sizeof triangle);
        word("verdict");
        word(text.verdict);
        word("reason");
        word(text.reason);
        word("engine");
        word("native");
        return true;
    }
    const uint8_t* end() const { return at_; }

private:
    void word(const char* text) {
        const size_t bytes = std::strlen(text);
        *at_++ = static_cast<uint8_t>(0xA0 | bytes);
        std::memcpy(at_, text, bytes);
        at_ += bytes;
    }
    void head(uint8_t kind, int64_t bytes) {
        if (bytes == 16) {
            *at_++ = 0xD8;
        } else if (bytes < 256) {
            *at_++ = 0xC7;
            *at_++ = static_cast<uint8_t>(bytes);
        } else {
            *at_++ = 0xC8;
            *at_++ = static_cast<uint8_t>(bytes >> 8);
            *at_++ = static_cast<uint8_t>(bytes);
        }
        *at_++ = kind;
    }
    void extension(uint8_t kind, const void* numbers, size_t bytes) {
        head(kind, static_cast<int64_t>(bytes));
        std::memcpy(at_, numbers, bytes);
        at_ += bytes;
    }

    uint8_t* at_;
};

class JsonReply {
public:
    explicit JsonReply(uint8_t* at) : at_(at) {}

    // Return false for a number that is not finite, which JSON does not have.
    bool write(const rse_pf_pnp_result& result, const int64_t* inliers) {
        float triangle[kTriangle];
        upper_triangle(result.covariance, triangle);
        const ReplyText text = text_of(result.reason);
        put("{\"T_camera_world\":[");
        for (const double number : result.T_camera_world) put(number);
        ends_list("],\"inliers\":[");
        for (int64_t i = 0; i < result.count; ++i) {
            at_ = write_row(inliers[i], at_);
            *at_++ = ',';
        }
        ends_list("],\"rmse_px\":");
        put(result.rmse_px);
        ends_list(",\"covariance\":[");
        for (const float number : triangle) put(static_cast<double>(number));
        ends_list("],\"verdict\":\"");
        put(text.verdict);
        put("\",\"reason\":\"");
        put(text.reason);
        put("\",\"engine\":\"native\"}");
        return is_finite_;
    }
    const uint8_t* end() const { return at_; }

private:
    void put(const char* text) {
        const size_t bytes = std::strlen(text);
        std::memcpy(at_, text, bytes);
        at_ += bytes;
    }
    void put(double number) {
        constexpr double kLargest = 1.7976931348623157e308;
        if (!(number <= kLargest && number >= -kLargest)) {
            is_finite_ = false;
            return;
        }
        at_ = write_double(number, at_);
        *at_++ = ',';
    }
    // Write `text` in the place of the last comma; no list is empty.
    void ends_list(const char* text) {
        --at_;
        put(text);
    }

    uint8_t* at_;
    bool is_finite_ = true;
};

}  // namespace rse_pf_codec
