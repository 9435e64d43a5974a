// The C ABI of the codecs' hot path.
#include "rse_pf_codec.h"

#include <cstddef>

#include "codec_deflate.hpp"
#include "codec_guards.hpp"
#include "codec_inflate.hpp"
#include "codec_pnp.hpp"
#include "codec_reply.hpp"

#define RSE_PF_CODEC_VISIBLE __attribute__((visibility("default")))

namespace {

using namespace rse_pf_codec;

void forget(rse_pf_codec_call& call) {
    constexpr size_t kFirst = offsetof(rse_pf_codec_call, text_bytes);
    std::memset(reinterpret_cast<char*>(&call) + kFirst, 0, sizeof call - kFirst);
}

// No command of `pnp` has more levels or lists than these, so they need not be counted in one.
bool holds_any_command(const rse_pf_codec_budget& budget) {
    return budget.depth >= kLevels && budget.containers >= kContainers && budget.values >= kOtherValues &&
           budget.mixed_values >= kOtherValues;
}

int32_t read_json(const uint8_t* text, int64_t bytes, const rse_pf_codec_budget& budget, rse_pf_codec_call& call) {
    JsonReader reader(text, bytes);
    if (holds_any_command(budget) && kMaxBytesPerByte * bytes <= budget.memory_bytes &&
        PnpCommand<JsonReader>(reader, text, call).read() && reader.values() < budget.values) {
        return RSE_PF_CODEC_READ;
    }
    return check_json(text, bytes, budget);
}

int32_t read_msgpack(const uint8_t* data, int64_t bytes, const rse_pf_codec_budget& budget, rse_pf_codec_call& call) {
    MsgpackReader reader(data, bytes);
    if (holds_any_command(budget) && PnpCommand<MsgpackReader>(reader, data, call).read()) return RSE_PF_CODEC_READ;
    // What is too short to exceed a count is judged by its decoder, as in rse_pf/budget.py.
    const bool is_short = bytes <= budget.containers && bytes * kMapValues <= budget.mixed_values;
    return is_short ? RSE_PF_CODEC_UNKNOWN : check_msgpack(data, bytes, budget);
}

template <class Reply>
int64_t write_reply(const rse_pf_codec_answer& answer) {
    Reply reply(answer.reply);
    return reply.write(answer.result, answer.inliers) ? reply.end() - answer.reply : 0;
}

}  // namespace

extern "C" {

RSE_PF_CODEC_VISIBLE uint32_t rse_pf_codec_abi(void) { return RSE_PF_CODEC_ABI; }

RSE_PF_CODEC_VISIBLE int32_t rse_pf_codec_check(const uint8_t* data, int64_t bytes, const rse_pf_codec_budget* budget,
                                                int32_t encoding) {
    if (bytes < 0) return RSE_PF_CODEC_UNKNOWN;
    if (encoding == RSE_PF_CODEC_JSON) return check_json(data, bytes, *budget);
    return encoding == RSE_PF_CODEC_MSGPACK ? check_msgpack(data, bytes, *budget) : RSE_PF_CODEC_UNKNOWN;
}

RSE_PF_CODEC_VISIBLE int32_t rse_pf_codec_read(const uint8_t* data, int64_t bytes, const rse_pf_codec_budget* budget,
                                               int32_t encoding, rse_pf_codec_call* call) {
    forget(*call);
    if (bytes < 0 || call->text_room < 0 || call->numbers_room < 0) return RSE_PF_CODEC_UNKNOWN;
    if (encoding == RSE_PF_CODEC_MSGPACK) return read_msgpack(data, bytes, *budget, *call);
    if (encoding == RSE_PF_CODEC_JSON) return read_json(data, bytes, *budget, *call);
    if (encoding != RSE_PF_CODEC_ZLIB || !(budget->inflate_ratio >= 1.0)) return RSE_PF_CODEC_UNKNOWN;
    const bool is_limited = budget->short_bytes > 0 && budget->short_bytes < call->text_room;
    const int64_t room = is_limited ? budget->short_bytes : call->text_room;
    Inflater inflater(data, bytes, *budget, call->text, room);
    const int32_t status = inflater.inflate();
    call->text_bytes = inflater.bytes();
    call->limit = inflater.limit();
    if (status != RSE_PF_CODEC_READ) return status;
    return read_json(call->text, call->text_bytes, *budget, *call);
}

RSE_PF_CODEC_VISIBLE int64_t rse_pf_codec_solve(const rse_pf_pnp_request* request, const double* numbers, int64_t rows,
                                                int32_t encoding, rse_pf_codec_answer* answer) {
    answer->result.status = RSE_PF_PNP_SOLVED;
    const bool is_json = encoding != RSE_PF_CODEC_MSGPACK;
    const bool fits = rows >= 4 && rows <= kMaxInliers && rows <= answer->inliers_room &&
                      reply_bytes(rows, is_json) <= answer->reply_room &&
                      reinterpret_cast<uintptr_t>(numbers) % alignof(double) == 0;
    if (!fits) return 0;
    rse_pf_pnp_request whole = *request;
    whole.rows = rows;
    whole.points_world = numbers;
    whole.pixels = numbers + 3 * rows;
    rse_pf_pnp_solve(&whole, answer->inliers, &answer->result);
    if (answer->result.status != RSE_PF_PNP_SOLVED) return 0;
    return is_json ? write_reply<JsonReply>(*answer) : write_reply<MsgpackReply>(*answer);
}

RSE_PF_CODEC_VISIBLE int64_t rse_pf_codec_deflate(const uint8_t* text, int64_t bytes, uint8_t* deflated, int64_t room) {
    if (bytes < 0 || room < 2 * bytes + 256) return 0;
    return deflate(text, bytes, deflated);
}
}
