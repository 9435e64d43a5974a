// A robot that drives through a recording in the TUM format: each image is matched with a keyframe whose points have
// depth, the platform estimates the pose, and the trajectory is written in the TUM format.
//
// Arguments: folder of the recording (rgb.txt, depth.txt), address, token, output file, images a second.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include <opencv2/core.hpp>
#include <opencv2/features2d.hpp>
#include <opencv2/imgcodecs.hpp>

#include <rse_pf/robot.hpp>

namespace {

using Transform = cv::Matx44d;

const rse_pf::Camera camera{525, 525, 319.5, 239.5, 640, 480};  // the intrinsics that the TUM recordings suggest
constexpr double depth_units_per_m = 5000;

struct Entry {
    double time_s;
    std::string file;
};

std::vector<Entry> entries(const std::string& path) {
    std::ifstream list(path);
    std::vector<Entry> out;
    for (std::string line; std::getline(list, line);) {
        std::istringstream words(line);
        Entry entry{};
        if (line[0] != '#' && words >> entry.time_s >> entry.file) out.push_back(entry);
    }
    return out;
}

struct Keyframe {
    std::vector<cv::KeyPoint> points;
    cv::Mat descriptors;
    std::vector<float> depths_m;  // depth of each feature; 0 for a feature without a depth
    Transform T_world_camera;
};

Keyframe keyframe_of(const std::string& folder, const std::string& depth_file, std::vector<cv::KeyPoint> points, const cv::Mat& descriptors) {
    const cv::Mat depth = cv::imread(folder + "/" + depth_file, cv::IMREAD_UNCHANGED);
    Keyframe out{std::move(points), descriptors, {}, Transform::eye()};
    for (const auto& each : out.points) {
        const int column = cvRound(each.pt.x), row = cvRound(each.pt.y);
        const bool inside = depth.type() == CV_16U && row >= 0 && row < depth.rows && column >= 0 && column < depth.cols;
        out.depths_m.push_back(inside ? static_cast<float>(depth.at<std::uint16_t>(row, column) / depth_units_per_m) : 0.0F);
    }
    return out;
}

/// Return the matches of *descriptors* with the points of a keyframe that have depth, in the keyframe's frame.
rse_pf::PnpRequest request_of(const Keyframe& keyframe, const std::vector<cv::KeyPoint>& points, const cv::Mat& descriptors) {
    rse_pf::PnpRequest request;
    request.camera = camera;
    std::vector<std::vector<cv::DMatch>> pairs;
    if (descriptors.rows >= 2 && keyframe.descriptors.rows >= 2) cv::BFMatcher(cv::NORM_HAMMING).knnMatch(descriptors, keyframe.descriptors, pairs, 2);
    for (const auto& pair : pairs) {
        if (pair.size() < 2 || pair[0].distance > 0.8F * pair[1].distance || request.pixels.size() >= 400) continue;
        const double z = keyframe.depths_m[static_cast<std::size_t>(pair[0].trainIdx)];
        if (z < 0.3 || z > 8) continue;
        const auto& seen = keyframe.points[static_cast<std::size_t>(pair[0].trainIdx)].pt;
        const auto& now = points[static_cast<std::size_t>(pair[0].queryIdx)].pt;
        request.points_world.push_back({(seen.x - camera.cx) * z / camera.fx, (seen.y - camera.cy) * z / camera.fy, z});
        request.pixels.push_back({now.x, now.y});
    }
    return request;
}

/// Write a pose as time, position and quaternion.
void write_pose(std::ofstream& out, double time_s, const Transform& T) {
    const double trace = T(0, 0) + T(1, 1) + T(2, 2);
    double q[4];  // x y z w
    if (trace > 0) {
        const double s = 2 * std::sqrt(trace + 1);
        q[3] = s / 4, q[0] = (T(2, 1) - T(1, 2)) / s, q[1] = (T(0, 2) - T(2, 0)) / s, q[2] = (T(1, 0) - T(0, 1)) / s;
    } else {
        const int i = T(0, 0) > T(1, 1) && T(0, 0) > T(2, 2) ? 0 : T(1, 1) > T(2, 2) ? 1 : 2, j = (i + 1) % 3, k = (i + 2) % 3;
        const double s = 2 * std::sqrt(1 + T(i, i) - T(j, j) - T(k, k));
        q[i] = s / 4, q[j] = (T(j, i) + T(i, j)) / s, q[k] = (T(k, i) + T(i, k)) / s, q[3] = (T(k, j) - T(j, k)) / s;
    }
    char line[200];
    std::snprintf(line, sizeof line, "%.6f %.5f %.5f %.5f %.6f %.6f %.6f %.6f\n", time_s, T(0, 3), T(1, 3), T(2, 3), q[0], q[1], q[2], q[3]);
    out << line;
}

}  // namespace

int main(int argc, char** argv) {
    if (argc < 5) return std::puts("usage: rse_pf_tum_robot RECORDING ws://HOST:PORT/ws TOKEN OUT.txt [IMAGES_PER_S]"), 2;
    const std::string folder = argv[1];
    const double per_s = argc > 5 ? std::stod(argv[5]) : 10;
    rse_pf::Options options;
    options.url = argv[2];
    options.token = argv[3];
    const auto images = entries(folder + "/rgb.txt"), depths = entries(folder + "/depth.txt");
    if (images.empty() || depths.empty()) return std::fprintf(stderr, "%s holds no rgb.txt and depth.txt\n", argv[1]), 1;
    try {
        rse_pf::Robot robot(options);
        robot.connect();
        std::ofstream trajectory(argv[4]);
        const auto orb = cv::ORB::create(1000);
        Keyframe keyframe;
        std::size_t answered = 0, weak = 0;
        double worst_ms = 0;
        for (std::size_t i = 0; i < images.size(); ++i) {
            const auto next = std::chrono::steady_clock::now() + std::chrono::duration<double>(1 / per_s);
            const cv::Mat gray = cv::imread(folder + "/" + images[i].file, cv::IMREAD_GRAYSCALE);
            std::vector<cv::KeyPoint> points;
            cv::Mat descriptors;
            if (!gray.empty()) orb->detectAndCompute(gray, cv::noArray(), points, descriptors);
            const auto depth = std::min_element(depths.begin(), depths.end(), [&](const Entry& a, const Entry& b) {
                return std::abs(a.time_s - images[i].time_s) < std::abs(b.time_s - images[i].time_s);
            });
            if (i == 0) {
                keyframe = keyframe_of(folder, depth->file, points, descriptors);
                write_pose(trajectory, images[i].time_s, keyframe.T_world_camera);
                continue;
            }
            const auto request = request_of(keyframe, points, descriptors);
            try {
                if (request.pixels.size() < 12) throw rse_pf::RsePfError("too-few", "too few matches");
                const rse_pf::PoseAnswer pose = robot.solve_pnp(request).get();
                worst_ms = std::max(worst_ms, pose.round_trip_ms);
                if (!pose.ok()) throw rse_pf::RsePfError("weak", pose.reason);
                const Transform T_world_camera = keyframe.T_world_camera * Transform(pose.T_camera_world.data()).inv();
                write_pose(trajectory, images[i].time_s, T_world_camera);
                ++answered;
                const auto moved = Transform(pose.T_camera_world.data());
                const double turned = std::acos(std::clamp((moved(0, 0) + moved(1, 1) + moved(2, 2) - 1) / 2, -1.0, 1.0));
                const double far = std::hypot(moved(0, 3), moved(1, 3), moved(2, 3));
                if (far > 0.15 || turned > 0.15 || pose.inliers.size() < 100) {
                    keyframe = keyframe_of(folder, depth->file, points, descriptors);
                    keyframe.T_world_camera = T_world_camera;
                }
            } catch (const rse_pf::RsePfError& error) {  // this image has no pose; the next image may have one
                ++weak;
                std::fprintf(stderr, "image %zu: %s\n", i, error.what());
            }
            std::this_thread::sleep_until(next);
        }
        std::printf("%zu of %zu images have a pose, %zu have none; longest round trip %.1f ms\n", answered + 1, images.size(), weak, worst_ms);
    } catch (const rse_pf::RsePfError& error) {
        return std::fprintf(stderr, "%s\n", error.what()), 1;
    }
}
