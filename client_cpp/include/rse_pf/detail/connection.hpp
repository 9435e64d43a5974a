// The sockets of a robot: connect, read, write, reconnect, move. `Session` holds the rules. Only one thread may call it.
#pragma once

#include <algorithm>
#include <chrono>
#include <functional>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <utility>
#include <variant>

#include "http_answer.hpp"
#include "session.hpp"
#include "transport.hpp"

namespace rse_pf {

/// The robot's token (empty: none), or a function that returns a fresh token for each connection and each renewal. The
/// function is called on a thread of its own, one call at a time. A call that throws or takes more than 30 s counts as
/// failed: a later answer of that call is ignored, and the next call does not wait for it.
using Token = std::variant<std::string, std::function<std::string()>>;

/// Receives a change of the connection: `link-lost` or `refused` and the reason, `link-back` or `moved` and the name of
/// the server. The first connection is not reported: `Robot::connect` returns or throws. A robot that was connected
/// once reconnects for ever; `refused` says why its servers refuse it.
using OnChange = std::function<void(const std::string& what, const std::string& why)>;

/// The address of the platform, and the settings of a robot's connection.
struct Options {
    std::string url{};             ///< ws://HOST:PORT/ws or wss://HOST/ws
    Token token{};                 ///< a connection with a fixed token is closed when the token expires
    std::string sdk = "rse-pf-cpp/1";  ///< name and version of the program, for the server's log
    std::string ca_file{};         ///< file of trusted authorities in PEM; empty: the authorities of the machine
    double connect_timeout_s = 2, reconnect_base_s = 0.1, reconnect_max_s = 1;
    double reconnect_long_max_s = 40;  ///< longest pause between attempts; after a refusal a pause is at least half of this
    double answer_timeout_s = 5;   ///< deadline of a command without `CallOptions::deadline_s`
    int first_tries = 4;           ///< attempts of `Robot::connect` before it gives up
    OnChange on_change{};          ///< called on the thread of callbacks
};

namespace detail {

/// Return the refusal that a WebSocket close code means; a Failure with an empty code if the robot may reconnect at once.
inline Failure refusal_of(unsigned code, const std::string& reason) {
    const std::string why = reason.empty() ? "" : ": " + reason;
    switch (code) {
        case 4403: return {"unauthorized", "the robot was disabled, or its token revoked" + why, "ask the operator"};
        case 4406: return {"unsupported", "the server speaks another version of the protocol" + why, "update the client"};
        case 4409: return {"conflict", "the same robot opened a newer connection" + why, "give each robot a token of its own"};
        case 1002: case 1007: case 1008: case 1009: case 4400:
            return {"protocol", "the server closed the connection with " + std::to_string(code) + why, "report this as a defect of the client"};
        default: return {};
    }
}

class Connection : public std::enable_shared_from_this<Connection> {
  public:
    Connection(Options options, SessionTimes times)
        : session(times, options.sdk), options_(std::move(options)), address_(address_of(options_.url)),
          tls_(tls_context(address_, {options_.ca_file})), token_timeout_s_(times.token_timeout), tick_(io), retry_(io), token_timer_(io), resolver_(io), random_(std::random_device{}()) {
        if (address_.target.empty()) address_.target = "/ws";
        if (const auto* fixed = std::get_if<std::string>(&options_.token)) token_ = *fixed;
    }
    ~Connection() {
        if (token_thread_.joinable()) token_thread_.detach();
    }

    asio::io_context io{1};
    Session session;
    std::optional<Failure> fatal;    ///< why there will be no further connection: the robot was closed, or never connected
    std::optional<Failure> refusal;  ///< why all servers refuse this robot now

    /// Return why a command cannot be sent; null if the command may wait for a connection.
    const Failure* reason() const { return fatal ? &*fatal : refusal ? &*refusal : nullptr; }

    /// Connect; *on_open* is called once, without a value after the first Welcome, or with the failure.
    void open(std::function<void(std::optional<Failure>)> on_open) {
        on_open_ = std::move(on_open);
        restart_pauses();
        tick();
        dial();
    }

    /// Write the messages that the session has queued, and close the old connections that have no unanswered command.
    void pump() {
        if (const auto& now = channel_) write(now);
        for (const auto& each : leaving_) write(each);
        const auto old = leaving_;
        for (const auto& each : old) {
            if (session.unanswered_on(each->link) == 0 && each->link->outgoing.empty() && !each->writing) close(each);
        }
        if (session.next_due(now_s()) < next_tick_ - 1e-3) schedule_tick();
    }

    void use_token(const std::string& token) {
        token_ = token;
        if (channel_) {
            renewing_ = token;
            session.renew(*channel_->link, token, now_s());
            pump();
        } else if (refusal) {
            retry_in(0);
        }
    }

    /// Close all connections and end all commands with *failure*; the io_context then runs out of work.
    void shut(const Failure& failure) {
        if (std::exchange(shut_, true)) return;
        if (!fatal) fatal = failure;
        session.abandon(*fatal);
        tick_.cancel();
        retry_.cancel();
        token_timer_.cancel();
        resolver_.cancel();
        if (dialing_) drop(dialing_);
        const auto old = leaving_;
        for (const auto& each : old) close(each);
        if (channel_) close(channel_);
        opened(*fatal);
        if (token_thread_.joinable() && !token_pending_) token_thread_.join();
    }

    bool connected() const { return channel_ != nullptr; }

  private:
    /// Longest duration of a TCP handshake. Linux repeats an unanswered SYN after 1, 3 and 7 s; a new attempt is faster.
    static constexpr double tcp_timeout_s = 1;

    /// The state of one WebSocket.
    struct Channel {
        Channel(asio::io_context& io, std::shared_ptr<asio::ssl::context> tls) : ws(io, std::move(tls)), timer(io), lookup_timer(io) {}
        websocket::stream<Transport, false> ws;
        asio::steady_timer timer, lookup_timer;
        beast::flat_buffer buffer;
        websocket::response_type response;
        std::shared_ptr<Link> link;
        std::string sent, token, wrong;
        bool writing = false, ended = false, closing = false, timed_out = false, connecting = false, accepted = false;
        int bad_messages = 0;
    };
    using ChannelPtr = std::shared_ptr<Channel>;

    // --- connecting -------------------------------------------------------------------------------

    /// Begin an attempt to connect: first the token, then the socket.
    void dial() {
        if (shut_ || fatal || dialing_ || token_pending_) return;
        dial_began_ = now_s();
        if (has_token_function()) {
            ask_token([this](std::optional<std::string> token) {
                if (token) connect_socket(*token);
                else dial_failed({{"connect", "no token: the token function failed: " + token_error_, "fix the function in options.token"}});
            });
        } else {
            connect_socket(token_);
        }
    }

    void connect_socket(const std::string& token) {
        auto channel = std::make_shared<Channel>(io, tls_);
        channel->token = token;
        dialing_ = channel;
        limit(channel, std::min(tcp_timeout_s, options_.connect_timeout_s));
        const auto self = shared_from_this();
        if (!std::exchange(looking_, true)) {
            resolver_.async_resolve(address_.host, address_.port, [self](error_code failed, auto found) { self->looked_up(failed, found); });
        }
        if (known_.empty()) return;
        // After 250 ms connect to the known addresses; the lookup continues, and the next attempt uses its result.
        channel->lookup_timer.expires_after(std::chrono::milliseconds(250));
        channel->lookup_timer.async_wait([self, channel](error_code stopped) {
            if (!stopped) self->connect_tcp(channel);
        });
    }

    void looked_up(error_code failed, const tcp::resolver::results_type& found) {
        looking_ = false;
        if (!failed) known_.assign(found.begin(), found.end());
        if (shut_ || !dialing_ || dialing_->connecting) return;
        if (!known_.empty()) connect_tcp(dialing_);
        else has_ended(dialing_, failed);
    }

    /// Connect to the known addresses, one after the other.
    void connect_tcp(const ChannelPtr& channel) {
        if (channel != dialing_ || std::exchange(channel->connecting, true)) return;
        channel->lookup_timer.cancel();
        const auto self = shared_from_this();
        asio::async_connect(channel->ws.next_layer().socket(), known_, [self, channel](error_code unreachable, const tcp::endpoint&) {
            channel->accepted = !unreachable || unreachable == asio::error::connection_refused || unreachable == asio::error::connection_reset;
            if (self->has_ended(channel, unreachable)) return;
            self->limit(channel, self->options_.connect_timeout_s);
            error_code ignored;
            channel->ws.next_layer().socket().set_option(tcp::no_delay(true), ignored);
            channel->ws.next_layer().async_secure(self->address_.host, [self, channel](error_code untrusted) {
                if (!self->has_ended(channel, untrusted)) self->handshake(channel);
            });
        });
    }

    /// End the attempt unless its next step completes within *seconds*.
    void limit(const ChannelPtr& channel, double seconds) {
        const auto self = shared_from_this();
        channel->timer.expires_after(std::chrono::duration_cast<std::chrono::milliseconds>(std::chrono::duration<double>(seconds)));
        channel->timer.async_wait([self, channel](error_code stopped) {
            if (stopped || channel->link || channel->ended) return;
            channel->timed_out = true;
            if (channel->connecting) channel->ws.next_layer().close();
            else self->has_ended(channel, asio::error::timed_out);
        });
    }

    void handshake(const ChannelPtr& channel) {
        auto& ws = channel->ws;
        websocket::stream_base::timeout times{std::chrono::seconds(2), websocket::stream_base::none(), false};
        ws.set_option(times);
        ws.auto_fragment(false);
        ws.write_buffer_bytes(16384);
        ws.read_message_max(16 << 20);
        ws.binary(true);
        // The stream keeps this function, so it must not keep the channel.
        ws.set_option(websocket::stream_base::decorator([token = channel->token](websocket::request_type& request) {
            request.set(http::field::sec_websocket_protocol, "rse-pf.v1.bin");
            if (!token.empty()) request.set(http::field::authorization, "Bearer " + token);
        }));
        const auto self = shared_from_this();
        ws.async_handshake(channel->response, address_.authority(), address_.target, [self, channel](error_code failed) {
            const auto& response = channel->response;
            if (failed == websocket::error::upgrade_declined && channel == self->dialing_) {
                self->drop(channel);
                self->dial_failed(refused(self->address_.shown(), response.result_int(), std::string(response[http::field::retry_after]), response.body()));
                return;
            }
            if (self->has_ended(channel, failed)) return;
            channel->timer.cancel();
            if (response[http::field::sec_websocket_protocol] != "rse-pf.v1.bin") {
                self->drop(channel);
                self->dial_failed({{"unsupported", self->address_.shown() + " does not speak rse-pf.v1.bin", "is it an RSE-PF server?"}, 0, false, true});
                return;
            }
            channel->link = self->session.open(now_s());
            self->write(channel);
            self->read(channel);
        });
    }

    /// Return whether the attempt of *channel* has ended; if *failed* is an error, end the attempt first.
    bool has_ended(const ChannelPtr& channel, error_code failed) {
        if (channel != dialing_) return true;
        if (!failed) return false;
        const std::string cause = channel->timed_out ? "no answer in time" : cause_of(failed);
        drop(channel);
        const std::string hint = cause == untrusted_certificate ? "name its authority in ca_file, or in the variable SSL_CERT_FILE" : "is the platform running? is the address right?";
        DialFailure failure{{"connect", "cannot connect to " + address_.shown() + ": " + cause, hint}};
        failure.unanswered = !channel->accepted;
        // The addresses are tried one after the other: the next attempt begins with another address.
        if (failure.unanswered && known_.size() > 1) std::rotate(known_.begin(), known_.begin() + 1, known_.end());
        dial_failed(failure);
        return true;
    }

    void dial_failed(DialFailure failed) {
        session.stats.last_error = failed.failure.message;
        if (shut_) return;
        if (failed.is_refusal && !failed.refuses_any && has_token_function() && failed.failure.code == "unauthorized" && !std::exchange(asked_again_, true)) {
            failed.is_refusal = false;
        }
        const bool first = on_open_ != nullptr;
        if (!failed.unanswered || first) ++attempt_;
        if (first && (lasts(failed) || failed.wrong_address || attempt_ >= options_.first_tries)) {
            end(failed.failure);
            return;
        }
        if (channel_ && now_s() >= move_until_) return;
        if (failed.is_refusal) {
            refused_now(failed);
            return;
        }
        if (!failed.unanswered && failing_since_ == never) failing_since_ = now_s();
        const double spent = now_s() - dial_began_;
        // Jitter, so that robots that receive the same Retry-After do not reconnect at the same moment.
        const double asked = failed.after_s * uniform(1, 1.25);
        retry_in(std::max(asked, (failed.unanswered ? uniform(1, 1.25) : pause_s()) - spent));
    }

    /// Return whether *failed* is a refusal that is not known to end within 2 s.
    static bool lasts(const DialFailure& failed) {
        return failed.is_refusal && !(failed.valid_from && *failed.valid_from - wall_s() <= 2);
    }

    /// Schedule the next attempt after a refusal: in 20 to 40 s, or as soon as tokens are accepted after a cut-off. Until a
    /// server accepts the robot, calls end with the refusal.
    void refused_now(const DialFailure& failed) {
        double wait = uniform(options_.reconnect_long_max_s / 2, options_.reconnect_long_max_s);
        if (failed.valid_from) wait = std::min(wait, std::max(0.0, *failed.valid_from - wall_s()) + uniform(0, 0.5));
        clock_offset_ = wall_s() - now_s();
        retry_in(std::max(wait, failed.after_s));
        if (!lasts(failed) || channel_) return;
        const bool is_news = !refusal || refusal->code != failed.failure.code || refusal->hint != failed.failure.hint;
        refusal = failed.failure;
        session.stats.last_error = failed.failure.message;
        session.end_commands(failed.failure);
        if (is_news) changed("refused", failed.failure.code + ": " + failed.failure.message);
    }

    double uniform(double least, double most) { return std::uniform_real_distribution<double>(least, most)(random_); }

    double pause_s() {
        // Pauses grow with the time since the first failure: a firewall counts the attempts of an address.
        const double longest = std::min(options_.reconnect_long_max_s, failing_since_ == never ? 0 : (now_s() - failing_since_) / 3);
        if (longest > options_.reconnect_max_s) return uniform(longest / 2, longest);
        return uniform(0, std::min(options_.reconnect_max_s, options_.reconnect_base_s * std::pow(2.0, std::min(attempt_, 20))));
    }

    void restart_pauses() {
        attempt_ = 0;
        failing_since_ = never;
    }

    void retry_in(double seconds) {
        retry_.expires_after(std::chrono::microseconds(static_cast<std::int64_t>(std::max(0.0, seconds) * 1e6)));
        const auto self = shared_from_this();
        retry_.async_wait([self](error_code stopped) {
            if (!stopped && (!self->channel_ || now_s() < self->move_until_)) self->dial();
        });
    }

    void welcomed(const ChannelPtr& channel) {
        if (channel != dialing_) return;
        dialing_.reset();
        asked_again_ = false;
        refusal.reset();
        if (channel_ && channel->link->server == channel_->link->server && now_s() < move_until_) {
            close(channel);  // the load balancer chose the server that asked the robot to move
            ++attempt_;
            retry_in(pause_s());
            return;
        }
        const bool moved = channel_ != nullptr;
        if (moved) leaving_.push_back(channel_);
        channel_ = channel;
        move_until_ = 0;
        adopted_ = now_s();
        session.adopt(channel->link, adopted_);
        if (moved) ++session.stats.moves;
        else if (!on_open_) ++session.stats.reconnects;
        if (moved) changed("moved", channel->link->server);
        else if (!on_open_) changed("link-back", channel->link->server);
        opened(std::nullopt);
    }

    // --- one socket -------------------------------------------------------------------------------

    void read(const ChannelPtr& channel) {
        const auto self = shared_from_this();
        channel->ws.async_read(channel->buffer, [self, channel](error_code failed, std::size_t size) {
            if (failed) {
                self->lost(channel, failed == websocket::error::closed ? "closed" : cause_of(failed));
                return;
            }
            self->session.stats.bytes_in += size;
            self->receive(channel);
            if (!channel->ended) self->read(channel);
        });
    }

    void receive(const ChannelPtr& channel) {
        const auto data = channel->buffer.cdata();
        ServerRequest request;
        try {
            if (!channel->ws.got_binary()) throw RsePfError("bad-message", "the server sent text");
            request = session.receive(channel->link, {static_cast<const char*>(data.data()), data.size()}, now_s());
        } catch (const std::exception& error) {
            session.stats.last_error = error.what();
            if (++channel->bad_messages > 10) lost(channel, "too many messages that cannot be decoded");
        }
        channel->buffer.consume(channel->buffer.size());
        switch (request.kind) {
            case ServerRequest::welcome: welcomed(channel); break;
            case ServerRequest::move:
                if (channel == channel_ && !shut_) {
                    move_until_ = now_s() + request.within_s;
                    restart_pauses();
                    dial();
                }
                break;
            case ServerRequest::renewed:
                if (!renewing_.empty()) channel->token = renewing_;
                break;
            case ServerRequest::notice: session.stats.last_error = request.failure.code + ": " + request.failure.message; break;
            case ServerRequest::nothing: break;
        }
        pump();
    }

    void write(const ChannelPtr& channel) {
        auto& outgoing = channel->link->outgoing;
        if (channel->writing || channel->ended || channel->closing || outgoing.empty()) return;
        channel->writing = true;
        channel->sent = std::move(outgoing.front());
        outgoing.pop_front();
        session.stats.bytes_out += channel->sent.size();
        const auto self = shared_from_this();
        channel->ws.async_write(asio::buffer(channel->sent), [self, channel](error_code failed, std::size_t) {
            channel->writing = false;
            if (failed) self->lost(channel, cause_of(failed));
            else if (channel->link->outgoing.empty()) self->pump();
            else self->write(channel);
        });
    }

    /// Begin the closing handshake; the timeout of the WebSocket closes the connection if the server does not answer.
    void close(const ChannelPtr& channel) {
        if (channel->ended || std::exchange(channel->closing, true)) return;
        const auto self = shared_from_this();
        channel->ws.async_close(websocket::close_code::normal, [self, channel](error_code) { self->lost(channel, "closed by the robot"); });
    }

    void drop(const ChannelPtr& channel) {
        channel->ended = true;
        channel->timer.cancel();
        channel->lookup_timer.cancel();
        channel->ws.next_layer().close();
        if (channel->link) session.lose(channel->link);
        if (dialing_ == channel) dialing_.reset();
    }

    void lost(const ChannelPtr& channel, const std::string& why) {
        if (channel->ended) return;
        const bool was_dialing = channel == dialing_, was_current = channel == channel_;
        drop(channel);
        leaving_.erase(std::remove(leaving_.begin(), leaving_.end(), channel), leaving_.end());
        if (was_current) channel_.reset();
        if (shut_ || channel->closing) return;
        const auto code = channel->ws.reason().code;
        const std::string reason(channel->ws.reason().reason.data(), channel->ws.reason().reason.size());
        DialFailure ends{refusal_of(code, reason)};
        if (code == 4401 && !has_token_function() && channel->token == token_) {
            ends.failure = {"unauthorized", "the token has expired", "set options.token to a function, or call renew in time"};
        }
        // Times in tokens are whole seconds: a fresh token has to be issued in a later second than the cut-off.
        if (code == 4403 && has_token_function()) ends.valid_from = wall_s() + 1;
        if (!ends.failure.code.empty() && (was_dialing || was_current)) {
            ends.is_refusal = ends.refuses_any = true;
            if (was_current) changed("link-lost", ends.failure.message);
            if (was_current && now_s() - adopted_ > 10) restart_pauses();
            dial_failed(ends);
            pump();
            return;
        }
        if (was_dialing) {
            dial_failed({{"connect", address_.shown() + " sent no Welcome: " + why, "is it an RSE-PF server?"}});
        } else if (was_current) {
            session.stats.last_error = why;
            changed("link-lost", why);
            if (now_s() - adopted_ > 10) restart_pauses();
            retry_in(code == 4429 ? 6 : pause_s());
        }
        pump();
    }

    void end(const Failure& failure) {
        if (fatal) return;
        fatal = failure;
        session.stats.last_error = failure.message;
        session.abandon(failure);
        if (dialing_) drop(dialing_);
        opened(failure);
        if (channel_) close(channel_);
    }

    void opened(std::optional<Failure> failure) {
        const auto on_open = std::exchange(on_open_, nullptr);
        if (on_open) on_open(std::move(failure));
    }

    bool has_token_function() const { return options_.token.index() == 1; }

    void changed(const char* what, const std::string& why) { session.notify(options_.on_change, std::string(what), why); }

    // --- time and tokens --------------------------------------------------------------------------

    void tick() {
        if (shut_) return;
        const double now = now_s();
        session.due(now);
        // The clock of this robot was set: the next token may be accepted.
        if (refusal && std::abs(wall_s() - now - clock_offset_) > 0.5) {
            clock_offset_ = wall_s() - now;
            retry_in(0);
        }
        auto all = leaving_;
        if (channel_) all.push_back(channel_);
        if (dialing_ && dialing_->link) all.push_back(dialing_);
        for (const auto& each : all) {
            bool renewal = false;
            if (const char* why = session.check(each->link, now, renewal)) lost(each, why);
            else if (renewal && has_token_function() && each == channel_ && !token_pending_) renew_from_function();
        }
        pump();
        schedule_tick();
    }

    void schedule_tick() {
        next_tick_ = std::max(session.next_due(now_s()), now_s() + 1e-3);
        tick_.expires_after(std::chrono::microseconds(static_cast<std::int64_t>((next_tick_ - now_s()) * 1e6) + 1));
        const auto self = shared_from_this();
        tick_.async_wait([self](error_code stopped) {
            if (!stopped) self->tick();
        });
    }

    void renew_from_function() {
        ask_token([this](std::optional<std::string> token) {
            if (token) use_token(*token);
            if (!channel_ || now_s() < move_until_) retry_in(pause_s());
        });
    }

    /// Call the token function on a thread of its own; the thread of the connection handles the token.
    void ask_token(std::function<void(std::optional<std::string>)> then) {
        token_pending_ = true;
        const auto number = ++token_calls_;
        if (token_thread_.joinable()) token_thread_.join();
        const auto self = shared_from_this();
        token_timer_.expires_after(std::chrono::duration_cast<std::chrono::milliseconds>(std::chrono::duration<double>(token_timeout_s_)));
        token_timer_.async_wait([self, number, then](error_code stopped) {
            if (stopped || !self->is_awaited(number)) return;
            self->token_thread_.detach();
            self->answered(std::nullopt, "no answer in time", then);
        });
        token_thread_ = std::thread([self, number, then = std::move(then), source = std::get<std::function<std::string()>>(options_.token)] {
            std::optional<std::string> token;
            std::string error;
            try {
                token = source();
            } catch (const std::exception& failed) {
                error = failed.what();
            } catch (...) {
                error = "an exception";
            }
            asio::post(self->io, [weak = std::weak_ptr<Connection>(self), number, then, token, error] {
                const auto here = weak.lock();
                if (here && here->is_awaited(number)) here->answered(token, error, then);
            });
        });
    }

    /// Return whether call *number* of the token function has no answer yet, and was not given up.
    bool is_awaited(std::uint64_t number) const { return token_pending_ && number == token_calls_; }

    void answered(const std::optional<std::string>& token, const std::string& error, const std::function<void(std::optional<std::string>)>& then) {
        token_pending_ = false;
        token_timer_.cancel();
        token_error_ = error;
        if (!token) {
            ++session.stats.callback_errors;
            session.stats.last_error = "no token: " + error;
        }
        if (!shut_) then(token);
    }

    Options options_;
    Address address_;
    std::shared_ptr<asio::ssl::context> tls_;
    std::string token_, renewing_, token_error_;
    double token_timeout_s_;
    asio::steady_timer tick_, retry_, token_timer_;
    asio::ip::basic_resolver<tcp, asio::io_context::executor_type> resolver_;
    std::vector<tcp::endpoint> known_;
    std::mt19937_64 random_;
    ChannelPtr channel_, dialing_;
    std::vector<ChannelPtr> leaving_;
    std::function<void(std::optional<Failure>)> on_open_;
    std::thread token_thread_;
    double next_tick_ = 0, dial_began_ = 0, adopted_ = 0, move_until_ = 0, failing_since_ = never, clock_offset_ = 0;
    int attempt_ = 0;
    std::uint64_t token_calls_ = 0;
    bool shut_ = false, token_pending_ = false, asked_again_ = false, looking_ = false;
};

}  // namespace detail
}  // namespace rse_pf
