// The client with servers that refuse it, are silent or speak another protocol, and with calls from many threads.
#include <rse_pf/rse_pf.hpp>

#include "check.hpp"

using namespace rse_pf;
namespace asio = boost::asio;
using asio::ip::tcp;

namespace {

/// A server on loopback that answers each connection with the same bytes, or with nothing.
class Server {
  public:
    explicit Server(std::string answer) : answer_(std::move(answer)), acceptor_(io_, {asio::ip::address_v4::loopback(), 0}) {
        accept();
        thread_ = std::thread([this] { io_.run(); });
    }
    ~Server() {
        io_.stop();
        thread_.join();
    }
    std::string url() const { return "ws://127.0.0.1:" + std::to_string(acceptor_.local_endpoint().port()) + "/ws"; }
    std::atomic<int> connections{0};

  private:
    void accept() {
        acceptor_.async_accept([this](boost::system::error_code failed, tcp::socket socket) {
            if (failed) return;
            ++connections;
            auto held = std::make_shared<tcp::socket>(std::move(socket));
            open_.push_back(held);
            auto request = std::make_shared<std::string>(4096, ' ');
            held->async_read_some(asio::buffer(*request), [this, held, request](boost::system::error_code, std::size_t) {
                boost::system::error_code ignored;
                if (answer_.empty()) return;
                asio::write(*held, asio::buffer(answer_), ignored);
                held->close(ignored);
            });
            accept();
        });
    }
    std::string answer_;
    asio::io_context io_;
    tcp::acceptor acceptor_;
    std::vector<std::shared_ptr<tcp::socket>> open_;
    std::thread thread_;
};

Options to(const std::string& url) {
    Options options;
    options.url = url;
    options.connect_timeout_s = 0.2;
    options.reconnect_base_s = options.reconnect_max_s = 0.01;
    options.first_tries = 2;
    return options;
}

void addresses_are_checked_before_anything_is_opened() {
    for (const char* url : {"", "robot", "ftp://a/ws", "ws://", "ws://a:b/ws", "ws://u@a/ws", "ws://a/ws?token=x", "ws://a:1 /ws"}) {
        expect_error("usage", [&] { Robot robot(to(url)); }, url);
    }
    const auto address = detail::address_of("wss://[::1]:8443/ws");
    expect(address.secure && address.host == "::1" && address.port == "8443" && address.authority() == "[::1]:8443", "an address of IPv6");
    Options options = to("wss://localhost/ws");
    options.ca_file = "missing.pem";
    expect_error("usage", [&] { Robot robot(options); }, "a file that is missing");
}

void nobody_listens() {
    Robot robot(to("ws://127.0.0.1:1/ws"));
    expect_error("connect", [&] { robot.connect(); }, "no server");
    expect_error("disconnected", [&] { robot.call("echo", {}).get(); }, "a call without a connection");
    expect_error("usage", [&] { robot.connect(); }, "connected twice");
}

std::string answer_401(const std::string& body) {
    return "HTTP/1.1 401 Unauthorized\r\nContent-Type: application/json\r\nContent-Length: " + std::to_string(body.size()) + "\r\n\r\n" + body;
}

const std::string refusal = answer_401(R"({"platform":"rse-pf","code":"unauthorized","message":"no","hint":"ask for a token"})");

void a_refusal_without_the_mark_of_a_server_is_temporary() {
    using rse_pf::detail::refused;
    for (const unsigned status : {401U, 403U}) {
        const auto firewall = refused("ws://host/ws", status, "60", "<html>Forbidden</html>");
        expect(!firewall.is_refusal && firewall.after_s == 60, "a firewall");
        expect(!refused("ws://host/ws", status, "", R"({"code":"forbidden"})").is_refusal, "a body without the mark");
        expect(refused("ws://host/ws", status, "", R"({"platform":"rse-pf","code":"forbidden"})").is_refusal, "a server");
    }
    expect(!refused("ws://host/ws", 429, "60", "").is_refusal, "too fast");
    Server server(answer_401(""));
    Options quick = to(server.url());
    quick.first_tries = 3;
    expect_error("unauthorized", [&] { Robot(quick).connect(); }, "not ours");
    expect(server.connections == 3, "tried again");
}

void a_refusal_keeps_its_code_and_ends_the_first_connect() {
    Server server(refusal);
    Robot robot(to(server.url()));
    try {
        robot.connect();
        expect(false, "connected");
    } catch (const RsePfError& error) {
        expect(error.code() == "unauthorized" && error.failure().hint == "ask for a token", error.what());
    }
    expect(server.connections == 1, "tried once");
}

void a_refusal_names_the_time_from_which_tokens_are_accepted() {
    using rse_pf::detail::refused;
    const std::string mark = R"({"platform":"rse-pf","code":"unauthorized","message":"m","hint":"h",)";
    const auto cut_off = refused("a", 401, "", mark + R"("cause":"cut-off","valid_from_s":1700000000.0})");
    expect(cut_off.refuses_any && cut_off.valid_from == 1700000000.0 && cut_off.failure.message == "m", "a cut-off");
    expect(!refused("a", 401, "", mark + R"("cause":"cut-off","valid_from_s":-1})").valid_from, "no time");
    expect(!refused("a", 401, "", mark + R"("cause":"expired"})").refuses_any, "a later token helps");
}

void another_program_answers() {
    Server talks("220 mail.example.org ESMTP\r\n"), is_silent(""), web("HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n");
    expect_error("connect", [&] { Robot(to(talks.url())).connect(); }, "a mail server");
    expect_error("connect", [&] { Robot(to(is_silent.url())).connect(); }, "a silent server");
    expect_error("unsupported", [&] { Robot(to(web.url())).connect(); }, "a web server");
    Options tls = to("wss" + is_silent.url().substr(2));
    expect_error("connect", [&] { Robot(tls).connect(); }, "a server without TLS");
    DataOptions quick;
    quick.deadline_s = 0.1;
    expect_error("connect", [&] { DataClient(talks.url(), "", quick).download(sha256("x")); }, "no data service");
}

void a_token_function_is_asked_again_after_a_refusal() {
    Server server(refusal);
    Options options = to(server.url());
    std::atomic<int> asked{0};
    options.token = [&] { return "token-" + std::to_string(++asked); };
    expect_error("unauthorized", [&] { Robot(options).connect(); }, "refused");
    expect(asked == 2, "a fresh token was tried");
    options.token = []() -> std::string { throw std::runtime_error("no file"); };
    expect_error("connect", [&] { Robot(options).connect(); }, "a token function that throws");
}

void a_token_function_that_hangs_is_given_up_and_asked_again() {
    Server server(refusal);
    Options options = to(server.url());
    const auto asked = std::make_shared<std::atomic<int>>(0);
    std::promise<void> release;
    options.token = [asked, may_answer = release.get_future().share()] {
        ++*asked;
        may_answer.wait();
        return std::string("late");
    };
    detail::SessionTimes times;
    times.token_timeout = 0.05;
    auto connection = std::make_shared<detail::Connection>(options, times);
    std::optional<Failure> failure;
    connection->open([&](std::optional<Failure> failed) {
        failure = std::move(failed);
        release.set_value();
        connection->shut(*failure);
    });
    connection->io.run_for(std::chrono::seconds(20));
    expect(failure && failure->code == "connect" && failure->message.find("no answer in time") != std::string::npos, "given up");
    expect(*asked == 2 && connection->session.stats.callback_errors == 2, "each call counts as failed");
    expect(server.connections == 0, "no late token is used");
}

void calls_of_many_threads_end_when_the_client_closes() {
    Server server("");
    for (int round = 0; round < 5; ++round) {
        std::atomic<int> ended{0};
        {
            Robot robot(to(server.url()));
            std::thread opens([&] {
                try {
                    robot.connect();
                } catch (const RsePfError&) {
                }
            });
            std::vector<std::thread> threads;
            for (int i = 0; i < 4; ++i) {
                threads.emplace_back([&] {
                    for (int k = 0; k < 50; ++k) {
                        const auto id = robot.call("echo", {{"value", k}}, {}, [&](Outcome<Answer>) { ++ended; });
                        if (k % 7 == 0) robot.cancel(id);
                        if (k % 11 == 0) robot.renew("token");
                    }
                });
            }
            for (auto& each : threads) each.join();
            opens.join();
        }
        expect(ended == 200, "each call ended once: " + std::to_string(ended));
    }
}

/// A server that speaks the protocol on one connection: answers commands with their payload, and sends an update at once.
class SpeakingServer {
  public:
    SpeakingServer() : acceptor_(io_, {asio::ip::address_v4::loopback(), 0}), thread_([this] { serve(); }) {}
    ~SpeakingServer() { thread_.join(); }
    std::string url() const { return "ws://127.0.0.1:" + std::to_string(acceptor_.local_endpoint().port()) + "/ws"; }
    std::atomic<int> commands{0};

  private:
    void serve() {
        namespace websocket = boost::beast::websocket;
        websocket::stream<tcp::socket> socket(acceptor_.accept());
        socket.set_option(websocket::stream_base::decorator(
            [](websocket::response_type& answer) { answer.set("Sec-WebSocket-Protocol", "rse-pf.v1.bin"); }));
        boost::system::error_code failed;
        socket.accept(failed);
        socket.binary(true);
        for (boost::beast::flat_buffer buffer; !failed; buffer.clear()) {
            socket.read(buffer, failed);
            if (failed) return;
            const auto* data = static_cast<const char*>(buffer.data().data());
            const json said = json::from_msgpack(data, data + buffer.size());
            const std::string type = said["type"];
            json answer;
            if (type == "hello") answer = {{"type", "welcome"}, {"server", "s"}, {"limits", {{"max_in_flight", 8}}}};
            else if (type == "ping") answer = {{"type", "pong"}, {"sent_s", said["sent_s"]}, {"received_s", 1.0}, {"answered_s", 1.0}};
            else if (type == "subscribe") answer = {{"type", "update"}, {"id", said["id"]}, {"topic", said["topic"]}, {"seq", 1}, {"key", "k"}, {"payload", 1}};
            else if (type == "command") answer = {{"type", "result"}, {"id", said["id"]}, {"reply", said["payload"]}};
            commands += type == "command";
            if (!answer.is_null()) socket.write(asio::buffer(encoded(answer)), failed);
        }
    }
    asio::io_context io_;
    tcp::acceptor acceptor_;
    std::thread thread_;
};

template <class T> bool ends_soon(std::future<T>& result) { return result.wait_for(std::chrono::seconds(20)) == std::future_status::ready; }

void callbacks_neither_hold_up_nor_end_the_connection() {
    SpeakingServer server;
    Robot robot(to(server.url()));
    robot.connect();
    std::promise<void> began, release, over;
    auto has_begun = began.get_future(), is_over = over.get_future();
    auto may_end = release.get_future().share();
    robot.subscribe("a", [&](const std::string&, const json&) {
        began.set_value();
        may_end.wait();
        throw std::runtime_error("of a callback");
    });
    expect(ends_soon(has_begun), "an update");
    auto answered = robot.call("echo", 1);
    expect(ends_soon(answered.result), "an answer while a callback blocks");
    release.set_value();
    robot.call("echo", 2, {}, [&](Outcome<Answer> outcome) {
        auto own = robot.call("echo", 3);
        expect(outcome.ok() && ends_soon(own.result), "a callback calls its own robot");
        const Stats stats = robot.stats();
        expect(stats.callback_errors == 1 && stats.last_error == "of a callback", "counted once");
        robot.close();
        robot.close();
        over.set_value();
    });
    expect(ends_soon(is_over), "a callback closes its robot");
    expect(server.commands == 3, "nothing was sent twice");
    expect_error("disconnected", [&] { robot.call("echo", 4).get(); }, "a call after the end");
}

void no_exception_of_a_callback_leaves_a_call() {
    Robot robot(to("ws://127.0.0.1:1/ws"));
    std::string codes;
    const auto fails = [&](auto outcome) {
        codes += outcome.failure().code + " ";
        throw std::runtime_error("of a callback");
    };
    const auto call_twice = [&](const std::string& when) {
        try {
            robot.call("echo", 1, {}, fails);
            robot.solve_pnp({}, {}, fails);
        } catch (const std::exception& error) {
            expect(false, when + ": " + error.what());
        }
    };
    call_twice("before connect");
    robot.close();
    call_twice("after close");
    const Stats stats = robot.stats();
    expect(codes == "disconnected disconnected disconnected disconnected ", "each is called once: " + codes);
    expect(stats.callback_errors == 4 && stats.last_error == "of a callback", "counted");
}

void a_newer_value_replaces_one_that_waits_and_answers_all_stay() {
    const auto callbacks = std::make_shared<detail::Callbacks>();
    std::string called;
    std::function<void(const std::string&, const json&)> on_update = [&](const std::string& key, const json& value) { called += key + value.dump() + " "; };
    std::function<void(int)> on_end = [&](int number) { called += "answer" + std::to_string(number) + " "; };
    const auto key_of = [](const std::string& key, const json&) { return key; };
    const auto first = detail::newest(callbacks, on_update, 1, key_of), second = detail::newest(callbacks, on_update, 2, key_of);
    const auto ends = detail::deferred(callbacks, on_end);
    for (int i = 0; i < 1000; ++i) {
        first("a", i);
        if (i < 2) ends(i);
        first("b", i);
        second("a", i + 1000);
    }
    callbacks->end();
    callbacks->run();
    expect(called == "a999 answer0 b999 a1999 answer1 ", "the newest of each key: " + called.substr(0, 80));
}

void digests_are_those_of_sha256() {
    expect(sha256("abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad", "abc");
}

}  // namespace

int main() {
    addresses_are_checked_before_anything_is_opened();
    nobody_listens();
    a_refusal_without_the_mark_of_a_server_is_temporary();
    a_refusal_keeps_its_code_and_ends_the_first_connect();
    a_refusal_names_the_time_from_which_tokens_are_accepted();
    another_program_answers();
    a_token_function_is_asked_again_after_a_refusal();
    a_token_function_that_hangs_is_given_up_and_asked_again();
    calls_of_many_threads_end_when_the_client_closes();
    callbacks_neither_hold_up_nor_end_the_connection();
    no_exception_of_a_callback_leaves_a_call();
    a_newer_value_replaces_one_that_waits_and_answers_all_stay();
    digests_are_those_of_sha256();
    std::printf(failures() == 0 ? "all hold\n" : "%d do not hold\n", failures());
    return failures() == 0 ? 0 : 1;
}
