// Robots of the C++ client for sdk_overload.py: sdk_robots URL ROBOTS FRAMES_PER_S SECONDS COMMAND prints their
// statistics; COMMAND is a JSON file with service and payload.
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include <rse_pf/robot.hpp>

int main(int argc, char** argv) {
    if (argc != 6) return 2;
    std::ifstream file(argv[5]);
    const auto command = rse_pf::json::parse(file);
    const std::string service = command["service"];
    const int robots = std::atoi(argv[2]);
    const double period = 1 / std::atof(argv[3]);
    const auto began = std::chrono::steady_clock::now();
    const auto at = [&](double seconds) {
        std::this_thread::sleep_until(began + std::chrono::microseconds(static_cast<long long>(1e6 * seconds)));
    };
    std::vector<std::unique_ptr<rse_pf::Robot>> clients;
    for (int k = 0; k < robots; ++k) {
        rse_pf::Options options;
        options.url = argv[1];
        clients.push_back(std::make_unique<rse_pf::Robot>(std::move(options)));
        clients.back()->connect();
    }
    rse_pf::CallOptions options;
    options.stream = "camera";
    options.deadline_s = 0.25;
    const int turns = static_cast<int>(std::atof(argv[4]) / period);
    for (int turn = 0; turn < turns; ++turn) {
        for (int k = 0; k < robots; ++k) {
            at((turn + static_cast<double>(k) / robots) * period);
            clients[static_cast<std::size_t>(k)]->call(service, command["payload"], options, [](auto) {});
        }
    }
    rse_pf::json found;
    for (const auto& each : clients) {
        const auto stats = each->stats();
        found.push_back({{"held_back", stats.held_back}, {"reconnects", stats.reconnects}});
    }
    std::puts(found.dump().c_str());
    return 0;
}
