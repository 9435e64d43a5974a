// The service `pnp`: the pose of a camera from matches of world points to pixels.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "answer.hpp"

namespace rse_pf {

/// Intrinsics of an image; pixels are undistorted, and the centre of the first pixel is (0, 0).
struct Camera {
    double fx = 0, fy = 0, cx = 0, cy = 0;  // px
    std::uint32_t width = 0, height = 0;    // px
};

/// Settings of RANSAC; the server chooses each setting without a value.
struct PnpOptions {
    std::string engine{};  ///< `native` or `opencv`
    std::optional<double> inlier_px{}, confidence{};
    std::optional<std::uint32_t> max_iterations{}, min_iterations{};
};

/// Depth z has the standard deviation base_m + growth_per_m * max(0, z - from_m)^2 metres.
struct DepthNoise {
    double base_m = 0.0012, growth_per_m = 0.0019, from_m = 0.4;
};

struct PnpRequest {
    Camera camera{};
    std::vector<std::array<double, 3>> points_world{};  ///< metres, world frame; 4 to 5,000
    std::vector<std::array<double, 2>> pixels{};        ///< undistorted, px; row i observes point i
    PnpOptions options{};
    std::vector<double> depths_m{};  ///< depths in metres at the pixels, 0 for a pixel without a depth; empty: no depths
    std::optional<DepthNoise> depth_noise{};
    /// Send numbers as float64; float32 is half the size and moves a pose by less than 0.02 mm.
    bool is_double = false;
};

/// The pose of one image.
struct PoseAnswer {
    /// Row-major 4x4: maps world points into the camera's frame (x right, y down, z forward).
    std::array<double, 16> T_camera_world{};
    std::vector<std::uint32_t> inliers{};  ///< sorted row numbers, from 0
    double rmse_px = 0;
    /// Upper triangle of the 6x6 covariance of the twist (metres, then radians) on the left of the pose.
    std::array<double, 21> covariance{};
    std::string verdict{};  ///< `ok` or `weak`
    std::string reason{};   ///< why the verdict is `weak`
    std::string engine{};
    double queue_ms = 0, compute_ms = 0, round_trip_ms = 0;
    std::string server{};

    bool ok() const { return verdict == "ok"; }
};

/// Return the request in MessagePack; throws RsePfError `usage` unless points, pixels and depths (if any) are equally many.
inline std::string encoded(const PnpRequest& request) {
    const std::size_t n = request.points_world.size();
    if (request.pixels.size() != n || (!request.depths_m.empty() && request.depths_m.size() != n)) {
        throw RsePfError("usage", std::to_string(n) + " points and " + std::to_string(request.pixels.size()) + " pixels do not match",
                    "give one pixel, and one depth or none at all, for each point");
    }
    std::string out;
    out.reserve(n * 6 * (request.is_double ? 8 : 4) + 256);
    msgpack::Writer writer(out);
    const auto numbers = [&](const double* values, std::size_t count) {
        if (request.is_double) writer.doubles(values, count);
        else writer.floats(values, count);
    };
    const Camera& camera = request.camera;
    writer.map(4 + (request.depths_m.empty() ? 0 : 1) + (request.depth_noise ? 1 : 0));
    writer.text("camera").map(6).text("fx").number(camera.fx).text("fy").number(camera.fy).text("cx").number(camera.cx);
    writer.text("cy").number(camera.cy).text("width").integer(camera.width).text("height").integer(camera.height);
    writer.text("points_world");
    numbers(n == 0 ? nullptr : request.points_world[0].data(), 3 * n);
    writer.text("pixels");
    numbers(n == 0 ? nullptr : request.pixels[0].data(), 2 * n);
    const PnpOptions& options = request.options;
    writer.text("options").map(static_cast<std::uint32_t>(!options.engine.empty() + options.inlier_px.has_value() + options.confidence.has_value() +
                                                          options.max_iterations.has_value() + options.min_iterations.has_value()));
    if (!options.engine.empty()) writer.text("engine").text(options.engine);
    if (options.inlier_px) writer.text("inlier_px").number(*options.inlier_px);
    if (options.confidence) writer.text("confidence").number(*options.confidence);
    if (options.max_iterations) writer.text("max_iterations").integer(*options.max_iterations);
    if (options.min_iterations) writer.text("min_iterations").integer(*options.min_iterations);
    if (!request.depths_m.empty()) {
        writer.text("depths_m");
        numbers(request.depths_m.data(), n);
    }
    if (request.depth_noise) {
        writer.text("depth_noise").map(3).text("base_m").number(request.depth_noise->base_m);
        writer.text("growth_per_m").number(request.depth_noise->growth_per_m).text("from_m").number(request.depth_noise->from_m);
    }
    return out;
}

/// Return the pose in an answer of `pnp`; throws RsePfError `bad-message` if the answer holds no pose.
inline PoseAnswer pose_of(const Answer& answer) {
    PoseAnswer pose;
    msgpack::Reader reader(answer.reply_msgpack);
    const auto fill = [](auto& array, const std::vector<double>& values) {
        if (values.size() != array.size()) throw RsePfError("bad-message", "the pose has another number of elements");
        std::copy(values.begin(), values.end(), array.begin());
    };
    bool has_pose = false;
    for (std::uint32_t n = reader.map(); n > 0; --n) {
        const auto key = reader.text();
        if (reader.nil()) continue;
        if (key == "T_camera_world") fill(pose.T_camera_world, reader.numbers()), has_pose = true;
        else if (key == "covariance") fill(pose.covariance, reader.numbers());
        else if (key == "rmse_px") pose.rmse_px = reader.number();
        else if (key == "verdict") pose.verdict = reader.text();
        else if (key == "reason") pose.reason = reader.text();
        else if (key == "engine") pose.engine = reader.text();
        else if (key == "inliers") {
            for (const double row : reader.numbers()) pose.inliers.push_back(row >= 0 && row < 4294967296.0 ? static_cast<std::uint32_t>(row) : 0);
        } else reader.value();
    }
    if (!has_pose) throw RsePfError("bad-message", "the reply holds no pose");
    pose.queue_ms = answer.queue_ms;
    pose.compute_ms = answer.compute_ms;
    pose.round_trip_ms = answer.round_trip_ms;
    pose.server = answer.server;
    return pose;
}

}  // namespace rse_pf
