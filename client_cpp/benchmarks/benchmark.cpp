// Measure the client: CPU time of a command, round trips of poses and echoes, and memory over time.
//
// Arguments: address, token, PACE (commands a second; 0: as many as the limits allow), number of poses, and duration of
// the memory test in seconds. Prints JSON. CPU time is of all threads of this process; memory is that of the allocator.
#include <algorithm>
#include <condition_variable>
#include <cstdio>
#include <ctime>
#include <malloc.h>
#include <mutex>
#include <random>
#include <sys/resource.h>
#include <thread>

#include <rse_pf/robot.hpp>

namespace {

double cpu_s() {
    timespec time{};
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

/// Return 300 points in front of the camera, with noise of 0.5 px (standard deviation) in their pixels.
rse_pf::PnpRequest problem(std::mt19937& random) {
    std::uniform_real_distribution<double> place(-1, 1);
    std::normal_distribution<double> noise(0, 0.5);
    rse_pf::PnpRequest request;
    request.camera = {525, 525, 319.5, 239.5, 640, 480};
    for (int i = 0; i < 300; ++i) {
        const double x = place(random), y = place(random), z = 3 + place(random);
        request.points_world.push_back({x, y, z});
        request.pixels.push_back({525 * x / z + 319.5 + noise(random), 525 * y / z + 239.5 + noise(random)});
    }
    return request;
}

rse_pf::json percentiles(std::vector<double> values) {
    std::sort(values.begin(), values.end());
    const auto at = [&](double share) { return values.empty() ? 0.0 : values[static_cast<std::size_t>(share * static_cast<double>(values.size() - 1))]; };
    return {{"n", values.size()}, {"p50", at(0.5)}, {"p95", at(0.95)}, {"p99", at(0.99)}};
}

/// Return the CPU time of one call of *work*, in microseconds: the mean of *n* calls.
template <class Work> double each_us(int n, Work work) {
    const double begin = cpu_s();
    for (int i = 0; i < n; ++i) work();
    return (cpu_s() - begin) / n * 1e6;
}

std::size_t heap_bytes() {
    const auto info = mallinfo2();
    return info.uordblks + info.hblkhd;
}

}  // namespace

int main(int argc, char** argv) {
    if (argc < 3) return std::puts("usage: rse_pf_benchmark URL TOKEN [PACE] [POSES] [MEMORY_S]"), 2;
    const double pace = argc > 3 ? std::stod(argv[3]) : 100;
    const int poses = argc > 4 ? std::stoi(argv[4]) : 1000;
    const double memory_s = argc > 5 ? std::stod(argv[5]) : 0;
    std::mt19937 random(1);
    const auto request = problem(random);
    try {
        rse_pf::Options options;
        options.url = argv[1];
        options.token = argv[2];
        rse_pf::Robot robot(options);
        robot.connect();
        const rse_pf::json value = {{"value", rse_pf::array(std::vector<double>(400, 0.5))}};
        const auto rest = std::chrono::duration<double>(pace > 0 ? 1 / pace : 0);
        std::vector<double> pose_ms, echo_ms, pose_net_ms;
        double pose_cpu = 0, echo_cpu = 0;
        rusage before{}, after{};
        getrusage(RUSAGE_SELF, &before);
        for (int i = 0; i < poses; ++i) {  // in turn, so that both see the same machine
            double begin = cpu_s();
            const auto pose = robot.solve_pnp(request, {}).get();
            pose_cpu += cpu_s() - begin;
            pose_ms.push_back(pose.round_trip_ms);
            pose_net_ms.push_back(pose.round_trip_ms - pose.compute_ms);
            std::this_thread::sleep_for(rest);
            begin = cpu_s();
            const auto echo = robot.call("echo", value).get();
            echo_cpu += cpu_s() - begin;
            echo_ms.push_back(echo.round_trip_ms - echo.compute_ms);
            std::this_thread::sleep_for(rest);
        }
        rse_pf::json out = {{"pose_ms", percentiles(pose_ms)}, {"pose_less_compute_ms", percentiles(pose_net_ms)},
                            {"echo_less_compute_ms", percentiles(echo_ms)},
                            {"cpu_us_a_pose", pose_cpu / poses * 1e6}, {"cpu_us_an_echo", echo_cpu / poses * 1e6}};
        getrusage(RUSAGE_SELF, &after);
        const auto us = [](const timeval& a, const timeval& b) { return static_cast<double>(b.tv_sec - a.tv_sec) * 1e6 + static_cast<double>(b.tv_usec - a.tv_usec); };
        out["cpu_us_a_command"] = {{"user", us(before.ru_utime, after.ru_utime) / 2 / poses}, {"system", us(before.ru_stime, after.ru_stime) / 2 / poses}};
        const auto answer = robot.call("pnp", rse_pf::json::from_msgpack(rse_pf::encoded(request))).get();
        const auto tree = rse_pf::json::from_msgpack(rse_pf::encoded(request));
        out["encode_us"] = {{"own", each_us(2000, [&] { rse_pf::encoded(request); })}, {"tree", each_us(2000, [&] { rse_pf::encoded(tree); })}};
        out["decode_us"] = {{"own", each_us(2000, [&] { rse_pf::pose_of(answer); })}, {"tree", each_us(2000, [&] { answer.reply(); })}};
        if (memory_s > 0) {
            std::vector<std::size_t> heap;
            std::mutex mutex;
            std::condition_variable changed;
            int open = 0;
            const double end = rse_pf::detail::now_s() + memory_s;
            std::uint64_t sent = 0;
            const double cpu_before = cpu_s();
            for (double sample = 0; rse_pf::detail::now_s() < end; ++sent) {
                std::unique_lock lock(mutex);
                changed.wait(lock, [&] { return open < 8; });
                ++open;
                lock.unlock();
                robot.solve_pnp(request, rse_pf::Robot::in_stream("front"), [&](rse_pf::Outcome<rse_pf::PoseAnswer>) {
                    const std::lock_guard inside(mutex);
                    --open;
                    changed.notify_one();
                });
                std::this_thread::sleep_for(rest);
                if (rse_pf::detail::now_s() >= sample) {
                    lock.lock();
                    changed.wait(lock, [&] { return open == 0; });
                    heap.push_back(heap_bytes());
                    sample = rse_pf::detail::now_s() + memory_s / 40;
                }
            }
            std::unique_lock lock(mutex);
            changed.wait(lock, [&] { return open == 0; });
            heap.erase(heap.begin(), heap.begin() + static_cast<std::ptrdiff_t>(heap.size() / 4));  // the allocator warms up
            out["memory"] = {{"commands", sent}, {"first_bytes", heap.front()}, {"last_bytes", heap.back()},
                             {"most_bytes", *std::max_element(heap.begin(), heap.end())}, {"seconds", memory_s},
                             {"cpu_us_a_pose", (cpu_s() - cpu_before) / static_cast<double>(sent) * 1e6}};
        }
        std::printf("%s\n", out.dump(1).c_str());
    } catch (const rse_pf::RsePfError& error) {
        return std::fprintf(stderr, "%s\n", error.what()), 1;
    }
}
