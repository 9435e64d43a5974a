// Connect, ask for the pose of a camera that sees 27 points of a grid, and print it.
// Arguments: the address of the platform and the token of a robot.
#include <cstdio>
#include <rse_pf/robot.hpp>

int main(int argc, char** argv) {
    if (argc < 2) return std::puts("usage: rse_pf_first_pose ws://HOST:PORT/ws [TOKEN]"), 2;
    rse_pf::Options options;
    options.url = argv[1];
    options.token = argc > 2 ? argv[2] : "";

    rse_pf::PnpRequest request;
    const rse_pf::Camera camera{525, 525, 319.5, 239.5, 640, 480};
    request.camera = camera;
    // The camera is at the origin of the world and looks along z, so its pose is the identity.
    for (int at = 0; at < 27; ++at) {
        const double x = 0.4 * (at % 3 - 1), y = 0.3 * (at / 3 % 3 - 1), z = 2.0 + 0.3 * (at / 9);
        request.points_world.push_back({x, y, z});
        request.pixels.push_back({camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z});
    }
    try {
        rse_pf::Robot robot(options);
        robot.connect();
        const rse_pf::PoseAnswer pose = robot.solve_pnp(request).get();
        for (std::size_t row = 0; row < 4; ++row) {
            for (std::size_t column = 0; column < 4; ++column) std::printf("%9.5f ", pose.T_camera_world[4 * row + column]);
            std::puts("");
        }
        std::printf("%s, %zu inliers, %.2f ms by %s\n", pose.verdict.c_str(), pose.inliers.size(), pose.round_trip_ms, pose.server.c_str());
    } catch (const rse_pf::RsePfError& error) {
        return std::fprintf(stderr, "%s\n", error.what()), 1;
    }
}
