// The messages of docs/protocol.md, section 2: those of the robot as bytes, those of the server as one struct.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "msgpack.hpp"

namespace rse_pf::detail {

/// Limits in a server's Welcome.
struct Limits {
    std::size_t max_message_bytes = 262144;
    std::size_t max_in_flight = 8;
    double max_commands_per_s = 0;  // 0: not limited
    double command_burst = 0;
};

/// A message of the server; `type` decides which fields are set.
struct ServerMessage {
    std::string_view type, server, session, robot, code, message, hint, trace, topic, key, object, what, reason;
    std::optional<std::uint64_t> id;
    std::uint64_t seq = 0;
    double queue_ms = 0, compute_ms = 0, received_s = 0, sent_s = 0, answered_s = 0, within_ms = 0, done = 0;
    std::optional<double> retry_after_ms, token_s;
    Limits limits;
    std::string_view reply, payload;  // MessagePack; empty: null
};

inline Limits read_limits(msgpack::Reader& reader) {
    Limits limits;
    for (std::uint32_t n = reader.map(); n > 0; --n) {
        const auto key = reader.text();
        if (key == "max_message_bytes") limits.max_message_bytes = reader.integer();
        else if (key == "max_in_flight") limits.max_in_flight = reader.integer();
        else if (key == "max_commands_per_s") limits.max_commands_per_s = reader.number();
        else if (key == "command_burst") limits.command_burst = static_cast<double>(reader.integer());
        else reader.value();
    }
    return limits;
}

/// Return the message in *data*, whose strings point into it; throws RsePfError `bad-message`.
inline ServerMessage read_message(std::string_view data) {
    msgpack::Reader reader(data);
    ServerMessage out;
    for (std::uint32_t n = reader.map(); n > 0; --n) {
        const auto key = reader.text();
        const auto text = [&](std::string_view& field) { field = reader.nil() ? std::string_view() : reader.text(); };
        const auto maybe = [&](std::optional<double>& field) {
            if (reader.nil()) field.reset();
            else field = reader.number();
        };
        if (key == "type") text(out.type);
        else if (key == "id") {
            if (reader.nil()) out.id.reset();
            else out.id = reader.integer();
        } else if (key == "reply") out.reply = reader.value();
        else if (key == "payload") out.payload = reader.value();
        else if (key == "server") text(out.server);
        else if (key == "queue_ms") out.queue_ms = reader.number();
        else if (key == "compute_ms") out.compute_ms = reader.number();
        else if (key == "received_s") out.received_s = reader.number();
        else if (key == "sent_s") out.sent_s = reader.number();
        else if (key == "answered_s") out.answered_s = reader.number();
        else if (key == "object") text(out.object);
        else if (key == "code") text(out.code);
        else if (key == "message") text(out.message);
        else if (key == "hint") text(out.hint);
        else if (key == "retry_after_ms") maybe(out.retry_after_ms);
        else if (key == "trace") text(out.trace);
        else if (key == "session") text(out.session);
        else if (key == "robot") text(out.robot);
        else if (key == "limits") out.limits = read_limits(reader);
        else if (key == "token_s") maybe(out.token_s);
        else if (key == "reason") text(out.reason);
        else if (key == "within_ms") out.within_ms = reader.number();
        else if (key == "topic") text(out.topic);
        else if (key == "key") text(out.key);
        else if (key == "seq") out.seq = reader.integer();
        else if (key == "done") out.done = reader.number();
        else if (key == "what") text(out.what);
        else reader.value();
    }
    if (!reader.done()) throw RsePfError("bad-message", "bytes follow the message");
    return out;
}

inline Failure failure_of(const ServerMessage& message) {
    return {std::string(message.code), std::string(message.message), std::string(message.hint),
            message.retry_after_ms,    std::string(message.server),  std::string(message.trace)};
}

inline std::string hello(std::string_view sdk) {
    std::string out;
    msgpack::Writer(out).map(3).text("type").text("hello").text("sdk").text(sdk).text("capabilities").list(3)
        .text("move").text("progress").text("updates");
    return out;
}

inline std::string ping(double sent_s) {
    std::string out;
    msgpack::Writer(out).map(2).text("type").text("ping").text("sent_s").number(sent_s);
    return out;
}

inline std::string renew(std::string_view token) {
    std::string out;
    msgpack::Writer(out).map(2).text("type").text("renew").text("token").text(token);
    return out;
}

/// Return a message whose only field is an id: `cancel` or `unsubscribe`.
inline std::string message_with_id(std::string_view type, std::uint64_t id) {
    std::string out;
    msgpack::Writer(out).map(2).text("type").text(type).text("id").integer(id);
    return out;
}

inline std::string subscribe(std::uint64_t id, std::string_view topic) {
    std::string out;
    msgpack::Writer(out).map(3).text("type").text("subscribe").text("id").integer(id).text("topic").text(topic);
    return out;
}

}  // namespace rse_pf::detail
