// The pose of a camera that sees 27 points of a grid. Arguments: the platform's address and a robot's token.
#include <cstdio>
#include <rse_pf/client.hpp>

int main(int argc, char** argv) {
    if (argc < 2) return std::puts("usage: rse_pf_first_pose ws://HOST:PORT/ws [TOKEN]"), 2;
    rse_pf::Options options;
    options.url = argv[1];
    options.token = argc > 2 ? argv[2] : "";

    rse_pf::PnpRequest request;
    request.camera = {525, 525, 319.5, 239.5, 640, 480};
    for (int at = 0; at < 27; ++at) {  // a grid two metres ahead, looked at without a rotation
        const double x = 0.4 * (at % 3 - 1), y = 0.3 * (at / 3 % 3 - 1), z = 2.0 + 0.3 * (at / 9);
        request.points_world.push_back({x, y, z});
        request.pixels.push_back({525 * x / z + 319.5, 525 * y / z + 239.5});
    }
    try {
        rse_pf::Client client(options);
        client.connect();
        const rse_pf::Pose pose = client.pnp(request).get();
        for (int row = 0; row < 4; ++row) {
            for (int column = 0; column < 4; ++column) std::printf("%9.5f ", pose.T_camera_world[static_cast<std::size_t>(4 * row + column)]);
            std::puts("");
        }
        std::printf("%s, %zu inliers, %.2f ms by %s\n", pose.verdict.c_str(), pose.inliers.size(), pose.round_trip_ms, pose.server.c_str());
    } catch (const rse_pf::Error& error) {
        return std::fprintf(stderr, "%s\n", error.what()), 1;
    }
}
