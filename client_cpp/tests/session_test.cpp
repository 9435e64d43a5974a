// The rules of a session and the codec, without a socket and without waiting: times are arguments.
#include <random>
#include <vector>

#include <rse_pf/detail/session.hpp>
#include <rse_pf/pnp.hpp>

#include "check.hpp"

using namespace rse_pf;
using detail::Command;
using detail::ServerRequest;
using detail::Link;
using detail::Session;

namespace {

using LinkPtr = std::shared_ptr<Link>;

std::string bytes_of(const json& message) { return encoded(message); }

/// A session with one connection of given *limits*; records how each command ended, by its id.
struct Bench {
    Session session{{}, "test"};
    LinkPtr link;
    std::map<std::uint64_t, std::vector<std::string>> ends;
    std::uint64_t next = 1;

    explicit Bench(const json& limits = {{"max_in_flight", 2}}) { link = welcomed("server-1", 0, limits); }
    LinkPtr welcomed(const std::string& server, double now, const json& limits = {{"max_in_flight", 2}}) {
        auto fresh = session.open(now);
        fresh->outgoing.clear();
        hear(fresh, {{"type", "welcome"}, {"server", server}, {"limits", limits}}, now);
        session.adopt(fresh, now);
        return fresh;
    }
    ServerRequest hear(const LinkPtr& from, const json& message, double now) { return session.receive(from, bytes_of(message), now); }
    std::uint64_t send(double now, CallOptions options = {}) {
        const auto id = next++;
        session.submit({id, "echo", encoded({{"value", 1}}), std::move(options), [this, id](Outcome<Answer> outcome) {
                            ends[id].push_back(outcome.ok() ? "ok" : outcome.failure().code);
                        }}, now);
        return id;
    }
    std::uint64_t send(double now, const std::string& stream) {
        CallOptions options;
        options.stream = stream;
        return send(now, options);
    }
    std::vector<json> said(const LinkPtr& to) {
        std::vector<json> messages;
        for (const auto& each : to->outgoing) messages.push_back(json::from_msgpack(each));
        to->outgoing.clear();
        return messages;
    }
    std::string end(std::uint64_t id) { return ends[id].size() == 1 ? ends[id][0] : std::to_string(ends[id].size()) + " ends"; }
};

json result(std::uint64_t id) { return {{"type", "result"}, {"id", id}, {"reply", {{"value", 1}}}}; }

void sends_no_more_than_the_limits_allow() {
    Bench bench;
    for (int i = 0; i < 5; ++i) bench.send(0);
    expect(bench.said(bench.link).size() == 2, "two commands are in flight");
    bench.hear(bench.link, result(1), 0.1);
    expect(bench.end(1) == "ok" && bench.said(bench.link).size() == 1, "an answer lets the next one go");
    Bench paced({{"max_in_flight", 100}, {"max_commands_per_s", 10}, {"command_burst", 10}});
    for (int i = 0; i < 50; ++i) paced.send(0);
    expect(paced.said(paced.link).size() == 9, "nine tenths of the burst");
    paced.session.due(1.0);
    expect(paced.said(paced.link).size() == 9, "nine tenths of the rate");
    expect(paced.session.next_due(1.0) > 1.05, "no busy loop while the rate is used up");
}

void the_newest_of_a_stream_wins() {
    Bench bench;
    for (int i = 0; i < 5; ++i) bench.send(0, "front");
    expect(bench.end(3) == "stale" && bench.end(4) == "stale", "those that waited are replaced");
    bench.hear(bench.link, result(2), 0.1);
    expect(bench.end(2) == "ok", "the second is answered");
    bench.hear(bench.link, result(1), 0.2);
    expect(bench.end(1) == "stale", "an older answer comes too late");
    bench.hear(bench.link, result(5), 0.3);
    expect(bench.end(5) == "ok", "the newest is answered");
}

void commands_survive_the_loss_of_a_connection_and_end_once() {
    Bench bench;
    const auto id = bench.send(0);
    bench.said(bench.link);
    bench.session.lose(bench.link);
    const auto second = bench.welcomed("server-2", 1);
    const auto again = bench.said(second);
    expect(again.size() == 1 && again[0]["id"] == id, "sent again with the same id");
    expect(again[0]["deadline_ms"] == 4000.0, "with the time that is left");
    bench.hear(second, result(id), 1.1);
    bench.hear(second, result(id), 1.2);
    expect(bench.end(id) == "ok" && bench.session.stats.dropped_answers == 1, "answered once");
    expect(bench.session.stats.resent == 1, "one was sent again");
}

void a_move_leaves_the_outstanding_where_they_are() {
    Bench bench;
    const auto id = bench.send(0);
    const auto old = bench.link;
    bench.said(old);
    expect(bench.hear(old, {{"type", "move"}, {"reason", "drain"}, {"within_ms", 5000}}, 0.1).kind == ServerRequest::move, "a move");
    const auto fresh = bench.welcomed("server-2", 0.2);
    expect(old->leaving && bench.said(fresh).empty() && bench.session.unanswered_on(old) == 1, "not sent again");
    bench.hear(old, result(id), 0.3);
    expect(bench.end(id) == "ok" && bench.session.unanswered_on(old) == 0, "answered on the old connection");
}

void deadlines_end_commands_and_busy_ones_wait() {
    Bench bench;
    CallOptions short_one;
    short_one.deadline_s = 0.5;
    const auto late = bench.send(0, short_one);
    expect(bench.session.next_due(0.4) <= 0.5, "woken for the deadline");
    bench.session.due(0.5);
    expect(bench.end(late) == "expired", "ended at its deadline");
    const auto busy = bench.send(1);
    bench.said(bench.link);
    bench.hear(bench.link, {{"type", "failure"}, {"id", busy}, {"code", "busy"}, {"message", "m"}, {"retry_after_ms", 200}}, 1.1);
    bench.session.due(1.2);
    expect(bench.said(bench.link).empty() && bench.ends[busy].empty(), "waits as long as retry_after_ms says");
    bench.session.due(1.31);
    expect(bench.said(bench.link).size() == 1, "then it is sent again");
    short_one.deadline_s = -1;
    expect(bench.end(bench.send(2, short_one)) == "usage", "a deadline in the past is refused");
}

json busy(std::uint64_t id, const json& retry_after_ms) {
    return {{"type", "failure"}, {"id", id}, {"code", "busy"}, {"message", "m"}, {"retry_after_ms", retry_after_ms}};
}

const json roomy = {{"max_in_flight", 100}};

void a_busy_command_is_sent_again_once() {
    Bench bench(roomy);
    const auto id = bench.send(0);
    bench.said(bench.link);
    bench.hear(bench.link, busy(id, 200), 0.2);
    bench.hear(bench.link, busy(id, 200), 0.2);
    bench.session.due(0.39);
    expect(bench.said(bench.link).empty() && bench.ends[id].empty(), "a busy one waits");
    bench.session.due(0.41);
    expect(bench.said(bench.link).size() == 1 && bench.session.stats.held_back.at("busy") == 1, "and is sent again, once");
    const auto old = bench.link;
    bench.session.lose(old);
    bench.welcomed("server-2", 1);
    bench.hear(old, {{"type", "failure"}, {"id", id}, {"code", "forbidden"}, {"message", "m"}}, 1.1);
    expect(bench.ends[id].empty(), "a connection that was left ends nothing");
}

void after_busy_a_stream_waits() {
    Bench bench(roomy);
    CallOptions options;
    options.stream = "front";
    options.deadline_s = 0.2;
    const auto first = bench.send(0, options);
    bench.said(bench.link);
    bench.hear(bench.link, busy(first, 300), 0.1);
    expect(bench.end(first) == "busy", "its deadline comes first");
    options = {};
    options.stream = "front";
    options.keep = true;
    bench.send(0.2, options);
    expect(bench.said(bench.link).empty() && bench.session.next_due(0.2) <= 0.4, "no frame of the stream before that");
    bench.send(0.2, "rear");
    bench.send(0.2);
    expect(bench.said(bench.link).size() == 2, "others go");
    bench.session.due(0.41);
    expect(bench.said(bench.link).size() == 1, "then it goes");
    expect(bench.session.stats.held_back.at("busy") == 1, "counted");
    Bench full;
    for (int i = 0; i < 5; ++i) full.send(0);
    expect(full.session.stats.held_back.at("own-limit") == 3, "what the Welcome does not allow");
}

void a_frame_that_a_pause_outlasts_ends_at_once() {
    Bench bench(roomy);
    CallOptions options;
    options.stream = "front";
    options.deadline_s = 1;
    const auto first = bench.send(0, options);
    bench.said(bench.link);
    bench.hear(bench.link, busy(first, 3000), 0.1);
    Failure failure;
    options.trace = "t";
    bench.session.submit({99, "echo", encoded({{"value", 1}}), options, [&](Outcome<Answer> outcome) { failure = outcome.failure(); }}, 0.2);
    expect(failure.code == "busy" && failure.message == "m" && failure.trace == "t", "by the answer of the server");
    expect(std::abs(failure.retry_after_ms.value_or(0) - 2900) < 1, "with the time that is left");
    expect(bench.session.unanswered() == 0 && bench.said(bench.link).empty(), "and is not sent");
    options.deadline_s = 4;
    const auto patient = bench.send(0.3, options);
    expect(bench.ends[patient].empty(), "one that can wait does");
    bench.session.due(3.15);
    expect(bench.said(bench.link).size() == 1, "and goes");
    bench.hear(bench.link, busy(patient, 3000), 3.2);
    const auto fresh = bench.welcomed("server-2", 3.3, roomy);
    bench.said(fresh);
    options.deadline_s = 1;
    const auto there = bench.send(3.4, options);
    expect(bench.said(fresh).size() == 1 && bench.ends[there].empty(), "a pause does not count for the next server");
}

void pauses_without_sense_hold_nothing_back() {
    Bench slow(roomy);
    const auto first = slow.send(0, "front");
    slow.said(slow.link);
    slow.hear(slow.link, busy(first, 1e300), 1);
    CallOptions options;
    options.deadline_s = 3000;
    options.stream = "front";
    slow.send(2, options);
    slow.session.due(60.9);
    expect(slow.said(slow.link).empty(), "waits");
    slow.session.due(61.1);
    expect(slow.said(slow.link).size() == 1, "for a minute at the most");
    for (const double pause : {std::nan(""), -5.0, 0.0}) {
        Bench bench(roomy);
        const auto id = bench.send(0, "front");
        bench.said(bench.link);
        bench.hear(bench.link, busy(id, pause), 0.1);
        expect(bench.said(bench.link).size() == 1, "no pause");
    }
}

void silence_and_missing_pongs_lose_a_connection() {
    Bench bench;
    bool renewal = false;
    expect(bench.session.check(bench.link, 0.1, renewal) == nullptr, "a ping is sent");
    expect(bench.said(bench.link)[0]["type"] == "ping", "at once");
    const char* why = nullptr;
    for (double now = 0.3; now < 3.3 && why == nullptr; now += 0.3) why = bench.session.check(bench.link, now, renewal);
    expect(why != nullptr && std::string(why) == "no pong", "no pong in 3 s");
    Bench waiting;
    waiting.send(0);
    why = nullptr;
    double now = 0;
    for (; now < 2 && why == nullptr; now += 0.1) why = waiting.session.check(waiting.link, now, renewal);
    expect(why != nullptr && std::string(why) == "silence" && now < 1.3, "silence while a command waits");
}

void long_commands_have_no_deadline_and_can_be_cancelled() {
    Bench bench;
    double share = 0;
    CallOptions options;
    options.on_progress = [&](double done, const std::string&) { share = done; };
    const auto id = bench.send(0, options);
    bench.said(bench.link);
    bench.hear(bench.link, {{"type", "progress"}, {"id", id}, {"done", 0.25}, {"what", "x"}}, 1);
    bench.session.due(1000);
    expect(share == 0.25 && bench.ends[id].empty(), "progress, and no deadline");
    bench.session.cancel(id);
    const auto said = bench.said(bench.link);
    expect(bench.end(id) == "cancelled" && said.size() == 1 && said[0]["type"] == "cancel", "the server is asked to cancel");
}

void subscriptions_begin_again_on_the_next_connection() {
    Bench bench;
    int values = 0;
    std::string ended;
    bench.session.subscribe(90, "live/a", [&](const std::string&, const json& payload) { values += payload["n"].get<int>(); },
                            [&](const Failure& failure) { ended = failure.code; }, 0);
    bench.said(bench.link);
    bench.hear(bench.link, {{"type", "update"}, {"id", 90}, {"topic", "live/a"}, {"seq", 1}, {"key", "k"}, {"payload", {{"n", 5}}}}, 0);
    bench.session.lose(bench.link);
    const auto second = bench.welcomed("server-2", 1);
    const auto said = bench.said(second);
    expect(values == 5 && said.size() == 1 && said[0]["topic"] == "live/a", "subscribed again");
    bench.hear(second, {{"type", "failure"}, {"id", 90}, {"code", "forbidden"}, {"message", "m"}}, 1);
    expect(ended == "forbidden", "ended by the server");
}

void no_exception_leaves_a_callback() {
    Bench bench;
    bench.session.submit({70, "echo", {}, {}, [](Outcome<Answer>) { throw std::runtime_error("of a callback"); }}, 0);
    bench.hear(bench.link, result(70), 0.1);
    expect(bench.session.stats.callback_errors == 1 && bench.session.stats.last_error == "of a callback", "counted, not thrown");
}

void bytes_of_a_stranger_are_refused() {
    Bench bench;
    expect_error("bad-message", [&] { bench.session.receive(bench.link, "", 0); }, "nothing");
    expect_error("bad-message", [&] { bench.session.receive(bench.link, std::string(100000, '\x91'), 0); }, "deep nesting");
    expect_error("bad-message", [&] { bench.session.receive(bench.link, bytes_of({{"type", "new"}}), 0); }, "an unknown type");
    const std::string nested = "\x81\xa5reply" + std::string(100000, '\x91');
    expect_error("bad-message", [&] { bench.session.receive(bench.link, nested, 0); }, "a deep reply");
    std::mt19937 random(7);
    const std::string good = bytes_of({{"type", "result"}, {"id", 1}, {"reply", {{"T_camera_world", std::vector<double>(16, 0.5)}, {"verdict", "ok"}}}});
    for (int i = 0; i < 20000; ++i) {
        std::string bad = good.substr(0, random() % (good.size() + 1));
        for (int k = 0; k < 3 && !bad.empty(); ++k) bad[random() % bad.size()] = static_cast<char>(random());
        try {
            Answer answer;
            answer.reply_msgpack = std::string(detail::read_message(bad).reply);
            pose_of(answer);
            answer.reply();
        } catch (const RsePfError&) {
        }
    }
}

void a_pose_request_reads_back() {
    PnpRequest request;
    request.camera = {500, 501, 320, 240, 640, 480};
    for (int i = 0; i < 70; ++i) {
        request.points_world.push_back({0.1 * i, 1, 2.5});
        request.pixels.push_back({i + 0.25, 7});
    }
    request.options.max_iterations = 300;
    for (const bool is_double : {false, true}) {
        request.is_double = is_double;
        const json read = json::from_msgpack(encoded(request));
        const auto points = numbers(read["points_world"]);
        expect(points.size() == 210 && std::abs(points[3] - 0.1) < (is_double ? 1e-15 : 1e-8), "the points");
        expect(numbers(read["pixels"])[2] == 1.25 && read["camera"]["width"] == 640, "pixels and camera");
        expect(read["options"] == json({{"max_iterations", 300}}), "the options");
    }
    request.pixels.pop_back();
    expect_error("usage", [&] { encoded(request); }, "one pixel too few");
    expect(numbers(array({1.5, -2})) == std::vector<double>({1.5, -2}) && numbers(json({1, 2.5})) == std::vector<double>({1, 2.5}), "arrays");
}

void the_offset_of_the_clock_is_that_of_the_shortest_exchange() {
    detail::ClockOffset clock;
    clock.add(10, 110.5, 110.5, 11);
    clock.add(20, 120.05, 120.06, 20.11);
    clock.add(30, 130.9, 130.9, 31);
    expect(std::abs(*clock.offset_s() - 100) < 1e-9, "the second one");
}

}  // namespace

int main() {
    sends_no_more_than_the_limits_allow();
    the_newest_of_a_stream_wins();
    commands_survive_the_loss_of_a_connection_and_end_once();
    a_move_leaves_the_outstanding_where_they_are();
    deadlines_end_commands_and_busy_ones_wait();
    a_busy_command_is_sent_again_once();
    after_busy_a_stream_waits();
    a_frame_that_a_pause_outlasts_ends_at_once();
    pauses_without_sense_hold_nothing_back();
    silence_and_missing_pongs_lose_a_connection();
    long_commands_have_no_deadline_and_can_be_cancelled();
    subscriptions_begin_again_on_the_next_connection();
    no_exception_leaves_a_callback();
    bytes_of_a_stranger_are_refused();
    a_pose_request_reads_back();
    the_offset_of_the_clock_is_that_of_the_shortest_exchange();
    std::printf(failures() == 0 ? "all hold\n" : "%d do not hold\n", failures());
    return failures() == 0 ? 0 : 1;
}
