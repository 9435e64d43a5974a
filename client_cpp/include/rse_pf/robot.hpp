// A robot's connection to the platform: commands, poses, subscriptions; safe to call from any thread.
//
// A robot has two threads: one for its connection, and one for the callbacks of the program. A callback may call every
// method and wait for the future of a call; while it runs, only other callbacks wait. `Stats` counts its exceptions.
#pragma once

#include <atomic>
#include <future>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <utility>

#include "detail/callbacks.hpp"
#include "detail/connection.hpp"
#include "pnp.hpp"

namespace rse_pf {

class Robot {
  public:
    /// Store how to connect; nothing is opened yet. Throws RsePfError `usage` if the address cannot be used.
    explicit Robot(Options options)
        : callbacks_(std::make_shared<detail::Callbacks>()), core_(std::make_shared<Core>(with_deferred(std::move(options)))) {}

    ~Robot() { close(); }
    Robot(const Robot&) = delete;
    Robot& operator=(const Robot&) = delete;

    /// Connect and wait for the first Welcome; throws RsePfError if no server answers or the servers refuse the robot. Call it
    /// once. A robot that was connected once reconnects for ever; while its servers refuse it, calls end with the reason.
    void connect() {
        if (core_->started.exchange(true)) throw RsePfError("usage", "connect was called twice", "make another Robot");
        auto opened = std::make_shared<std::promise<std::optional<Failure>>>();
        auto result = opened->get_future();
        const bool posted = post([core = core_, opened] {
            core->connection->open([opened](std::optional<Failure> failure) { opened->set_value(std::move(failure)); });
        });
        if (!posted) throw RsePfError("disconnected", "the robot was closed", "make another Robot");
        {
            const std::lock_guard one_at_a_time(core_->posting);
            thread_ = std::thread([core = core_] {
                core->connection->io.run();  // nothing below it throws
                core->ended.set_value();
            });
            callback_thread_ = std::thread([callbacks = callbacks_] { callbacks->run(); });
        }
        if (auto failure = result.get()) {
            close();
            throw RsePfError(std::move(*failure));
        }
    }

    /// Close the connection; unanswered commands end as `disconnected`. The destructor does the same. Any thread may call it,
    /// also repeatedly. It returns after the last callback has returned, unless a callback calls it.
    void close() {
        std::thread connection, callbacks;
        {
            const std::lock_guard one_at_a_time(core_->posting);
            if (!core_->closed.exchange(true) && core_->started) {  // earlier posts run before this one, and there are no later ones
                boost::asio::post(core_->connection->io, [core = core_] {
                    core->connection->shut({"disconnected", "the robot closed its connection"});
                    core->guard.reset();
                });
            }
            connection.swap(thread_);
            callbacks.swap(callback_thread_);
        }
        if (!connection.joinable()) return callbacks_->wait();
        connection.join();
        callbacks_->end();
        if (callbacks.get_id() == std::this_thread::get_id()) callbacks.detach();  // the thread shares the queue of callbacks until it ends
        else callbacks.join();
    }

    /// Send a command. *payload* is JSON (`array` makes arrays of numbers).
    Call<Answer> call(const std::string& service, const json& payload, CallOptions options = {}) {
        auto promise = std::make_shared<std::promise<Answer>>();
        auto result = promise->get_future();
        const auto id = submit(service, encoded(payload), std::move(options), [promise](Outcome<Answer> outcome) { settle(*promise, std::move(outcome)); });
        return {id, std::move(result)};
    }
    /// Send a command and return its id; *on_end* is called once, on the thread of callbacks. If `connect` was not called, or
    /// the robot was closed, *on_end* is called before this method returns.
    std::uint64_t call(const std::string& service, const json& payload, CallOptions options, OnEnd<Answer> on_end) {
        return send(service, encoded(payload), std::move(options), std::move(on_end));
    }
    /// Send a command, as `call` does, whose payload is already MessagePack.
    std::uint64_t send(const std::string& service, std::string payload, CallOptions options, OnEnd<Answer> on_end) {
        return submit(service, std::move(payload), std::move(options), detail::deferred(callbacks_, on_end), on_end);
    }

    /// Estimate the pose of one image. By default the command is in the stream `pose`, of which the newest image wins.
    Call<PoseAnswer> solve_pnp(const PnpRequest& request, CallOptions options = in_stream("pose")) {
        auto promise = std::make_shared<std::promise<PoseAnswer>>();
        auto result = promise->get_future();
        const auto id = submit("pnp", encoded(request), std::move(options), [promise](Outcome<Answer> outcome) { settle(*promise, pose_in(outcome)); });
        return {id, std::move(result)};
    }
    std::uint64_t solve_pnp(const PnpRequest& request, CallOptions options, OnEnd<PoseAnswer> on_end) {
        return send("pnp", encoded(request), std::move(options), [on_end = std::move(on_end)](Outcome<Answer> outcome) {
            if (on_end) on_end(pose_in(outcome));
        });
    }

    /// Cancel a command: it ends as `cancelled`; the server is asked to cancel a long command as well.
    void cancel(std::uint64_t id) {
        post([core = core_, id] {
            core->connection->session.cancel(id);
            core->connection->pump();
        });
    }

    /// Subscribe to *topic*, such as `live/MAP`, on this connection and all later ones; returns an id for `unsubscribe`.
    /// *on_update* receives the present value of every key, and newer values later. While a value waits for the thread of
    /// callbacks, a newer value of its key replaces it.
    std::uint64_t subscribe(const std::string& topic, OnUpdate on_update, OnSubscriptionEnd on_end = {}) {
        const std::uint64_t id = core_->next_id++;
        on_update = detail::newest(callbacks_, std::move(on_update), id, [](const std::string& key, const json&) { return key; });
        post([core = core_, id, topic, on_update = std::move(on_update), on_end = detail::deferred(callbacks_, std::move(on_end))] {
            auto& connection = *core->connection;
            if (connection.fatal) {
                connection.session.notify(on_end, *connection.fatal);
                return;
            }
            connection.session.subscribe(id, topic, on_update, on_end, detail::now_s());
            connection.pump();
        });
        return id;
    }
    void unsubscribe(std::uint64_t id) {
        post([core = core_, id] {
            core->connection->session.unsubscribe(id, detail::now_s());
            core->connection->pump();
        });
    }

    /// Use *token* on later connections, and renew this connection, which then stays open as long as *token* is valid.
    void renew(const std::string& token) {
        post([core = core_, token] { core->connection->use_token(token); });
    }

    /// Return the counters since the robot was made.
    Stats stats() const {
        const auto read = [core = core_, callbacks = callbacks_] {
            Stats stats = core->connection->session.stats;
            auto [errors, last] = callbacks->errors();
            stats.callback_errors += errors;
            if (stats.last_error.empty()) stats.last_error = std::move(last);
            stats.unanswered = core->connection->session.unanswered();
            return stats;
        };
        if (!core_->started) return read();
        auto promise = std::make_shared<std::promise<Stats>>();
        auto result = promise->get_future();
        if (post([promise, read] { promise->set_value(read()); })) return result.get();
        core_->has_ended.wait();
        return read();
    }

    /// Return options for a command of *stream*.
    static CallOptions in_stream(std::string stream) {
        CallOptions options;
        options.stream = std::move(stream);
        return options;
    }

  private:
    struct Core {
        explicit Core(Options options)
            : connection(std::make_shared<detail::Connection>(options, times_of(options))), guard(connection->io.get_executor()) {}
        static detail::SessionTimes times_of(const Options& options) {
            detail::SessionTimes times;
            times.answer_timeout = options.answer_timeout_s;
            return times;
        }
        std::shared_ptr<detail::Connection> connection;
        boost::asio::executor_work_guard<boost::asio::io_context::executor_type> guard;
        std::atomic<std::uint64_t> next_id{1};
        std::atomic<bool> started{false}, closed{false};
        std::mutex posting;
        std::promise<void> ended;
        std::shared_future<void> has_ended = ended.get_future().share();
    };

    Options with_deferred(Options options) const {
        options.on_change = detail::deferred(callbacks_, std::move(options.on_change));
        return options;
    }

    /// Send a command. *on_end* is called on the thread of the connection. If the connection is not running, *at_once* (by
    /// default *on_end*) is called on this thread, with the failure.
    std::uint64_t submit(const std::string& service, std::string payload, CallOptions options, OnEnd<Answer> on_end, OnEnd<Answer> at_once = {}) {
        if (!at_once) at_once = on_end;
        const std::uint64_t id = core_->next_id++;
        options.on_progress = detail::newest(callbacks_, std::move(options.on_progress), id, [](double, const std::string&) { return std::string(); });
        auto command = std::make_shared<detail::Command>(detail::Command{id, service, std::move(payload), std::move(options), std::move(on_end)});
        const bool posted = core_->started && post([core = core_, command] {
            auto& connection = *core->connection;
            if (const Failure* why = connection.reason()) {
                connection.session.refuse(*command, *why);
                return;
            }
            connection.session.submit(std::move(*command), detail::now_s());
            connection.pump();
        });
        if (!posted && at_once) callbacks_->call([&at_once] { at_once(Failure{"disconnected", "the robot is not connected", "call connect first"}); });
        return id;
    }

    /// Run *work* on the thread of the connection; return false, without running it, if the robot was closed.
    template <class Work> bool post(Work&& work) const {
        const std::lock_guard one_at_a_time(core_->posting);
        if (core_->closed) return false;
        boost::asio::post(core_->connection->io, std::forward<Work>(work));
        return true;
    }

    template <class T> static void settle(std::promise<T>& promise, Outcome<T> outcome) {
        if (outcome.ok()) promise.set_value(std::move(outcome).value());
        else promise.set_exception(std::make_exception_ptr(RsePfError(outcome.failure())));
    }
    static Outcome<PoseAnswer> pose_in(const Outcome<Answer>& outcome) {
        if (!outcome.ok()) return outcome.failure();
        try {
            return pose_of(outcome.value());
        } catch (const RsePfError& error) {
            return error.failure();
        }
    }

    std::shared_ptr<detail::Callbacks> callbacks_;
    std::shared_ptr<Core> core_;
    std::thread thread_, callback_thread_;
};

}  // namespace rse_pf
