// The rules of a session (docs/protocol.md, section 4) as a state machine without socket, thread or clock: its inputs are
// messages and times in seconds, its outputs are bytes and calls of callbacks.
#pragma once

#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "../answer.hpp"
#include "timers.hpp"

namespace rse_pf {

/// Counters of one robot since its construction.
struct Stats {
    std::uint64_t sent = 0, answered = 0, failed = 0, resent = 0, reconnects = 0, moves = 0;
    std::uint64_t dropped_answers = 0;      ///< answers to commands that had ended already
    std::uint64_t callback_errors = 0;      ///< exceptions of callbacks and of the token function
    std::uint64_t bytes_in = 0, bytes_out = 0;
    std::map<std::string, std::uint64_t> failures_by_code{};
    /// Commands that were not sent at once although there was a connection: by `busy` (the server's answer to this command
    /// or another one of its stream) or `own-limit` (limits of the Welcome).
    std::map<std::string, std::uint64_t> held_back{{"busy", 0}, {"own-limit", 0}};
    std::size_t unanswered = 0;
    std::string last_error{};
};

using OnUpdate = std::function<void(const std::string& key, const json& payload)>;
using OnSubscriptionEnd = std::function<void(const Failure&)>;

namespace detail {

/// Timeouts and intervals of a session, in seconds; the defaults are those of docs/protocol.md.
struct SessionTimes {
    double answer_timeout = 5, ping_interval = 2, ping_timeout = 3, hello_timeout = 5, stall_timeout = 1;
    double token_timeout = 30;  ///< longest duration of a call of the token function
};

/// State of one connection.
struct Link {
    double opened = 0, last_heard = 0, last_checked = 0;
    std::optional<double> last_ping, ping_sent;
    bool welcomed = false, leaving = false, lost = false;
    std::string server;
    Limits limits;
    RateLimiter rate;
    ClockOffset clock;
    RenewalTimer renewal;
    std::deque<std::string> outgoing;
    std::size_t in_flight = 0;
};

struct Command {
    std::uint64_t id = 0;
    std::string service, payload;
    CallOptions options;
    OnEnd<Answer> on_end;
};

/// What the connection must do after a message of the server.
struct ServerRequest {
    enum Kind { nothing, welcome, move, notice, renewed } kind = nothing;
    double within_s = 0;
    Failure failure{};
};

class Session {
  public:
    Session(SessionTimes times, std::string sdk) : times_(times), sdk_(std::move(sdk)) {}

    Stats stats;

    const std::shared_ptr<Link>& current() const { return current_; }

    /// Call *callback*; catch and count its exceptions.
    template <class Callback, class... Arguments> void notify(const Callback& callback, Arguments&&... arguments) {
        if (!callback) return;
        try {
            callback(std::forward<Arguments>(arguments)...);
        } catch (const std::exception& error) {
            ++stats.callback_errors;
            stats.last_error = error.what();
        } catch (...) {
            ++stats.callback_errors;
        }
    }

    /// Queue a command, which is sent as soon as there is a connection whose limits allow it.
    void submit(Command command, double now) {
        ++stats.sent;
        const auto& options = command.options;
        const double wait = options.deadline_s.value_or(options.on_progress ? never : times_.answer_timeout);
        if (options.deadline_s && !(wait > 0 && wait <= 3600)) {
            finish(command, Failure{"usage", "deadline_s is not within 0 to 3600", "give the seconds that the call may take"});
            return;
        }
        Pending pending;
        pending.seq = ++sequence_[options.stream];
        pending.submitted = now;
        pending.deadline = now + wait;
        pending.command = std::move(command);
        const std::size_t size = encode(pending, now).size();
        const std::size_t most = current_ ? current_->limits.max_message_bytes : Limits{}.max_message_bytes;
        if (size > most) {
            finish(pending.command,
                   Failure{"too-large", "a command of " + std::to_string(size) + " bytes is above " + std::to_string(most),
                           "send fewer matches, or send large data to the data service"});
            return;
        }
        retries_ = std::min(max_retries, retries_ + 0.1);
        const std::uint64_t id = pending.command.id;
        pending_.emplace(id, std::move(pending));
        waiting_.insert(id);
        flush(now);
    }

    /// Cancel a command: it ends as `cancelled`; the server is asked to cancel a long command as well.
    void cancel(std::uint64_t id) {
        const auto found = pending_.find(id);
        if (found == pending_.end() || found->second.cancelled) return;
        Pending& pending = found->second;
        const Command command = pending.command;
        if (pending.is_long) cancel_on_server(pending);
        else if (!pending.link) erase(found);
        else pending.cancelled = true;
        finish(command, Failure{"cancelled", "the program cancelled the command"});
    }

    void subscribe(std::uint64_t id, std::string topic, OnUpdate on_update, OnSubscriptionEnd on_end, double now) {
        auto& subscription = subscriptions_[id] = {std::move(topic), std::move(on_update), std::move(on_end)};
        if (current_) ask(id, subscription, now);
    }

    void unsubscribe(std::uint64_t id, double now) {
        if (subscriptions_.erase(id) > 0 && current_) say(message_with_id("unsubscribe", id), now);
    }

    void renew(Link& link, const std::string& token, double now) {
        link.outgoing.push_back(detail::renew(token));
        link.rate.spend(now);
    }

    /// Return the state of a connection that was just opened, with a Hello to send.
    std::shared_ptr<Link> open(double now) {
        auto link = std::make_shared<Link>();
        link->opened = link->last_heard = link->last_checked = now;
        link->outgoing.push_back(hello(sdk_));
        return link;
    }

    /// Send on *link* from now on. Commands that the earlier connection has not answered stay there, except long ones.
    void adopt(const std::shared_ptr<Link>& link, double now) {
        const auto before = std::exchange(current_, link);
        busy_.clear();
        if (before && before != link) {
            before->leaving = true;
            for (auto& [id, pending] : pending_) {  // a job continues on any server
                if (pending.link == before && pending.is_long && !pending.cancelled) detach(id, pending);
            }
        }
        for (auto& [id, subscription] : subscriptions_) ask(id, subscription, now);
        flush(now);
    }

    /// Record that *link* was lost; its commands wait for the next connection.
    void lose(const std::shared_ptr<Link>& link) {
        link->lost = true;
        if (current_ == link) current_.reset();
        for (auto each = pending_.begin(); each != pending_.end();) {
            auto here = each++;
            if (here->second.link != link) continue;
            if (here->second.cancelled && !here->second.is_long) erase(here);
            else detach(here->first, here->second);
        }
    }

    /// Handle one message of the server; throws RsePfError `bad-message`.
    ServerRequest receive(const std::shared_ptr<Link>& link, std::string_view data, double now) {
        link->last_heard = now;
        const ServerMessage message = read_message(data);
        const auto type = message.type;
        if (type == "result" || type == "failure") return answered(link, message, now);
        if (type == "pong") {
            link->ping_sent.reset();
            if (message.sent_s >= link->opened && message.sent_s <= now) {
                link->clock.add(message.sent_s, message.received_s, message.answered_s, now);
            }
            return {};
        }
        if (type == "welcome") {
            if (std::exchange(link->welcomed, true)) return {};
            link->server = message.server;
            link->limits = message.limits;
            link->rate = RateLimiter(message.limits, now);
            if (message.token_s) link->renewal.expires_in(*message.token_s, now);
            return {ServerRequest::welcome};
        }
        if (type == "move") return {ServerRequest::move, std::isfinite(message.within_ms) ? message.within_ms / 1e3 : 0};
        if (type == "renewed") {
            link->renewal.expires_in(message.token_s.value_or(3600), now);
            return {ServerRequest::renewed};
        }
        if (type == "update") updated(link, message);
        else if (type == "progress") progressed(link, message);
        else throw RsePfError("bad-message", "a message of a type that the protocol does not have");
        return {};
    }

    /// End the commands whose deadline has passed, and send the commands that may be sent.
    void due(double now) {
        if (now >= next_deadline_) {
            next_deadline_ = never;
            for (auto each = pending_.begin(); each != pending_.end();) {
                auto here = each++;
                Pending& pending = here->second;
                if (now < pending.deadline) {
                    next_deadline_ = std::min(next_deadline_, pending.deadline);
                    continue;
                }
                const Command command = pending.command;
                const bool must_notify = !pending.cancelled;
                if (pending.is_long) cancel_on_server(pending);
                else erase(here);
                if (must_notify) finish(command, Failure{"expired", "no answer within the deadline", {}, {}, {}, command.options.trace});
            }
        }
        flush(now);
    }

    /// Send a ping if one is due; return why the connection counts as lost, or nullptr.
    const char* check(const std::shared_ptr<Link>& link, double now, bool& renewal_is_due) {
        if (link->lost) return nullptr;
        if (now - link->last_checked >= times_.stall_timeout) {  // this process was suspended: the server was not silent
            link->last_heard = now;
            if (link->ping_sent) link->ping_sent = now;
        }
        link->last_checked = now;
        if (!link->welcomed) return now - link->opened >= times_.hello_timeout ? "no welcome" : nullptr;
        if (link->ping_sent && now - *link->ping_sent >= times_.ping_timeout) return "no pong";
        double oldest = never;
        if (link->in_flight > 0) {
            for (const auto& [id, pending] : pending_) {
                if (pending.link == link && !pending.is_long) oldest = std::min(oldest, pending.sent_at);
            }
        }
        if (oldest < never && now - std::max(link->last_heard, oldest) >= times_.stall_timeout) return "silence";
        const double pause = oldest < never ? times_.stall_timeout / 3 : times_.ping_interval;
        if (!link->last_ping || now - *link->last_ping >= pause - 1e-3) {
            if (!link->ping_sent) link->ping_sent = now;
            link->last_ping = now;
            link->outgoing.push_back(ping(now));
            link->rate.spend(now);
        }
        renewal_is_due = !link->leaving && link->renewal.is_due(now);
        return nullptr;
    }

    /// Return when `due` and `check` must be called again.
    double next_due(double now) const {
        return std::max(now, std::min({now + times_.stall_timeout / 3, next_deadline_, next_retry_}));
    }

    /// Return how many commands on *link* are neither answered nor cancelled.
    std::size_t unanswered_on(const std::shared_ptr<Link>& link) const {
        std::size_t n = 0;
        for (const auto& [id, pending] : pending_) n += pending.link == link && !pending.cancelled;
        return n;
    }

    std::size_t unanswered() const {
        std::size_t n = 0;
        for (const auto& [id, pending] : pending_) n += !pending.cancelled;
        return n;
    }

    /// End all commands and subscriptions with *failure*; no further connection will be opened.
    void abandon(const Failure& failure) {
        end_commands(failure);
        auto subscriptions = std::exchange(subscriptions_, {});
        for (auto& [id, each] : subscriptions) notify(each.on_end, failure);
    }

    /// End every command with *failure*; the subscriptions wait for the next connection.
    void end_commands(const Failure& failure) {
        auto pending = std::exchange(pending_, {});
        waiting_.clear();
        for (auto& [id, each] : pending) {
            if (!each.cancelled) finish(each.command, failure);
        }
    }

    /// End *command* with *failure* before it was sent.
    void refuse(const Command& command, const Failure& failure) {
        ++stats.sent;
        finish(command, failure);
    }

  private:
    static constexpr double max_retries = 10;

    struct Pending {
        Command command;
        std::uint64_t seq = 0;
        double submitted = 0, deadline = 0, sent_at = 0, not_before = 0;
        std::shared_ptr<Link> link{};
        bool was_sent = false, cancelled = false, is_long = false, was_lost = false, was_held = false;
    };
    struct Subscription {
        std::string topic;
        OnUpdate on_update;
        OnSubscriptionEnd on_end;
    };
    /// The pause of a stream: its end (seconds), and the `busy` answer that began it.
    struct Busy {
        double until = 0;
        Failure failure{};
    };
    using PendingMap = std::map<std::uint64_t, Pending>;

    std::string encode(const Pending& pending, double now) const {
        const auto& [id, service, payload, options, on_end] = pending.command;
        std::string out;
        out.reserve(payload.size() + 160);
        msgpack::Writer writer(out);
        const bool has_deadline = pending.deadline < never;
        writer.map(6 + (options.keep ? 1 : 0) + (has_deadline ? 1 : 0) + (options.trace.empty() ? 0 : 1));
        writer.text("type").text("command").text("id").integer(id).text("service").text(service);
        writer.text("stream").text(options.stream).text("seq").integer(pending.seq);
        if (options.keep) writer.text("keep").boolean(true);
        if (has_deadline) writer.text("deadline_ms").number(std::clamp((pending.deadline - now) * 1e3, 0.0, 3.6e6));
        if (!options.trace.empty()) writer.text("trace").text(options.trace);
        writer.text("payload");
        return payload.empty() ? (writer.nil(), out) : (writer.raw(payload), out);
    }

    /// Send the waiting commands, oldest first, as far as the limits of the server allow.
    void flush(double now) {
        next_retry_ = never;
        for (auto each = waiting_.begin(); each != waiting_.end();) {
            const auto found = pending_.find(*each++);
            Pending& pending = found->second;
            next_deadline_ = std::min(next_deadline_, pending.deadline);
            const auto& options = pending.command.options;
            if (!options.stream.empty() && !options.keep && pending.seq < sequence_[options.stream]) {
                end(found, Failure{"stale", "a newer command of the stream took its place", {}, {}, {}, options.trace});
                continue;
            }
            if (!current_) continue;
            const auto busy = busy_.find(options.stream);
            const double until = busy == busy_.end() ? 0 : busy->second.until;
            const double held = std::max(pending.not_before, until);
            if (now < until && until >= pending.deadline) {
                Failure failure = busy->second.failure;
                failure.trace = options.trace;
                failure.retry_after_ms = (until - now) * 1e3;
                end(found, std::move(failure));
            } else if (now < held) {
                hold(pending, "busy", held);
            } else if (current_->in_flight >= std::max<std::size_t>(1, current_->limits.max_in_flight)) {
                hold(pending, "own-limit", never);
            } else if (!current_->rate.allows(now)) {
                hold(pending, "own-limit", current_->rate.next_s(now));
            } else {
                write(found, now);
            }
        }
    }

    /// Hold a command back until *until_s*, or until an answer arrives; count the command once.
    void hold(Pending& pending, const char* why, double until_s) {
        next_retry_ = std::min(next_retry_, until_s);
        if (!std::exchange(pending.was_held, true)) ++stats.held_back[why];
    }

    void write(PendingMap::iterator found, double now) {
        Pending& pending = found->second;
        stats.resent += std::exchange(pending.was_sent, true);
        waiting_.erase(found->first);
        pending.link = current_;
        pending.sent_at = now;
        ++current_->in_flight;
        current_->rate.spend(now);
        current_->outgoing.push_back(encode(pending, now));
        if (pending.cancelled) cancel_on_server(pending);
    }

    void cancel_on_server(Pending& pending) {
        pending.cancelled = true;
        pending.deadline = never;
        if (pending.link) pending.link->outgoing.push_back(message_with_id("cancel", pending.command.id));
    }

    void detach(std::uint64_t id, Pending& pending) {
        if (pending.link) --pending.link->in_flight;
        pending.link.reset();
        waiting_.insert(id);
    }

    void erase(PendingMap::iterator found) {
        if (found->second.link) --found->second.link->in_flight;
        waiting_.erase(found->first);
        pending_.erase(found);
    }

    void ask(std::uint64_t id, const Subscription& subscription, double now) {
        say(detail::subscribe(id, subscription.topic), now);
    }

    void say(std::string message, double now) {
        current_->outgoing.push_back(std::move(message));
        current_->rate.spend(now);
    }

    void finish(const Command& command, Outcome<Answer> outcome) {
        if (outcome.ok()) {
            ++stats.answered;
        } else {
            ++stats.failed;
            ++stats.failures_by_code[outcome.failure().code];
        }
        notify(command.on_end, std::move(outcome));
    }

    void end(PendingMap::iterator found, Outcome<Answer> outcome) {
        const Command command = std::move(found->second.command);
        const bool must_notify = !found->second.cancelled;
        erase(found);
        if (must_notify) finish(command, std::move(outcome));
    }

    ServerRequest answered(const std::shared_ptr<Link>& link, const ServerMessage& message, double now) {
        const bool failed = message.type == "failure";
        if (!message.id) return {ServerRequest::notice, 0, failure_of(message)};
        if (failed) {
            const auto subscription = subscriptions_.find(*message.id);
            if (subscription != subscriptions_.end()) {
                const auto on_end = std::move(subscription->second.on_end);
                subscriptions_.erase(subscription);
                notify(on_end, failure_of(message));
                return {};
            }
        }
        const auto found = pending_.find(*message.id);
        if (found == pending_.end() || (failed && found->second.link != link)) {
            ++stats.dropped_answers;
            return {};
        }
        Pending& pending = found->second;
        if (failed) {
            if (!sends_again(found, message, now)) end(found, failure_of(message));
        } else if (now >= pending.deadline) {
            end(found, Failure{"expired", "the answer came after the deadline"});
        } else {
            const auto& options = pending.command.options;
            auto& delivered = delivered_[options.stream];
            if (!options.stream.empty() && !options.keep && pending.seq < delivered) {
                end(found, Failure{"stale", "a newer answer of the stream came first"});
            } else {
                delivered = std::max(delivered, pending.seq);
                end(found, answer_of(*link, pending, message, now));
            }
        }
        flush(now);
        return {};
    }

    static Answer answer_of(const Link& link, const Pending& pending, const ServerMessage& message, double now) {
        Answer answer;
        answer.id = *message.id;
        answer.reply_msgpack = message.reply;
        answer.object = message.object;
        answer.server = message.server;
        answer.queue_ms = message.queue_ms;
        answer.compute_ms = message.compute_ms;
        answer.round_trip_ms = (now - pending.submitted) * 1e3;
        const auto offset = link.clock.offset_s();
        if (offset && pending.link.get() == &link) {
            answer.up_ms = (message.received_s - *offset - pending.sent_at) * 1e3;
            answer.down_ms = (now - (message.sent_s - *offset)) * 1e3;
        }
        return answer;
    }

    /// Return whether the command is sent again later: after `busy` within its deadline, and once after `worker-lost`.
    bool sends_again(PendingMap::iterator found, const ServerMessage& failure, double now) {
        Pending& pending = found->second;
        const double pause = std::max(0.0, failure.retry_after_ms.value_or(0)) / 1e3;
        const auto& stream = pending.command.options.stream;
        if (failure.code == "busy" && pause > 0 && !stream.empty()) {
            busy_[stream] = {now + std::min(max_pause_s, pause), failure_of(failure)};
        }
        if (pending.cancelled) return false;
        if (failure.code == "worker-lost" && !std::exchange(pending.was_lost, true)) {
            detach(found->first, pending);
            return true;
        }
        const double after = now + pause;
        if (failure.code != "busy" || !(after < pending.deadline) || retries_ < 1) return false;
        retries_ -= 1;
        detach(found->first, pending);
        pending.not_before = after;
        return true;
    }

    void progressed(const std::shared_ptr<Link>& link, const ServerMessage& message) {
        const auto found = pending_.find(message.id.value_or(0));
        if (found == pending_.end() || found->second.link != link) return;
        Pending& pending = found->second;
        if (!std::exchange(pending.is_long, true)) {
            if (!pending.command.options.deadline_s) pending.deadline = never;
            if (pending.cancelled) cancel_on_server(pending);
        }
        if (pending.cancelled) return;
        const double done = std::isfinite(message.done) ? std::clamp(message.done, 0.0, 1.0) : 0.0;
        notify(pending.command.options.on_progress, done, std::string(message.what));
    }

    void updated(const std::shared_ptr<Link>& link, const ServerMessage& message) {
        const auto found = subscriptions_.find(message.id.value_or(0));
        if (found == subscriptions_.end() || link != current_) return;
        const json payload = message.payload.empty() ? json() : json::from_msgpack(message.payload);
        notify(found->second.on_update, std::string(message.key), payload);
    }

    SessionTimes times_;
    std::string sdk_;
    std::shared_ptr<Link> current_;
    PendingMap pending_;
    std::set<std::uint64_t> waiting_;
    std::map<std::uint64_t, Subscription> subscriptions_;
    std::unordered_map<std::string, std::uint64_t> sequence_, delivered_;
    std::unordered_map<std::string, Busy> busy_;  // pauses of streams on this connection, by stream
    double retries_ = max_retries, next_deadline_ = never, next_retry_ = never;
};

}  // namespace detail
}  // namespace rse_pf
