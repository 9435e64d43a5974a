// The robust estimate: samples of three, MSAC, early local refinement, and a last refinement of the inliers.
//
// Source: Chum, Matas and Kittler, Locally Optimized RANSAC, DAGM 2003; Lebeda, Matas and Chum, BMVC 2012.
#pragma once

#include "p3p.hpp"
#include "planar.hpp"

namespace RSE_PF_ISA {

constexpr int kLocalSteps = 4;
// With few rows a trial is cheap, and one row more or less decides about the verdict.
constexpr int64_t kFewRows = 32, kTrialsOfFewRows = 30;
constexpr int kLastSteps = 100;
constexpr double kDoneStep = 1e-6;  // metres and radians: what is left then is a tenth of it

// A sequence of pseudo-random numbers; Steele, Lea and Flood, OOPSLA 2014 (SplitMix64).
struct Sampler {
    uint64_t state;

    uint64_t next() {
        state += 0x9E3779B97F4A7C15u;
        uint64_t z = state;
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        return z ^ (z >> 31);
    }
    // Fill in three different rows of n >= 3.
    void three(int64_t n, int64_t (&rows)[3]) {
        const uint64_t bits = next(), range = static_cast<uint64_t>(n);
        uint64_t a = ((bits & 0x1FFFFF) * range) >> 21, b = (((bits >> 21) & 0x1FFFFF) * (range - 1)) >> 21,
                 c = (((bits >> 42) & 0x1FFFFF) * (range - 2)) >> 21;
        if (b >= a) ++b;
        const uint64_t low = a < b ? a : b, high = a < b ? b : a;
        if (c >= low) ++c;
        if (c >= high) ++c;
        rows[0] = static_cast<int64_t>(a);
        rows[1] = static_cast<int64_t>(b);
        rows[2] = static_cast<int64_t>(c);
    }
};

// How many trials find three right rows with the confidence asked for, when `agree` of n are right.
static inline double trials_for(int64_t agree, int64_t n, double confidence) {
    if (agree < 3) return kInfinity;
    const double k = static_cast<double>(agree), all_rows = static_cast<double>(n);
    const double share = k * (k - 1.0) * (k - 2.0) / (all_rows * (all_rows - 1.0) * (all_rows - 2.0));
    if (share >= 1.0) return 0.0;
    return natural_log(1.0 - confidence) / natural_log(1.0 - share);
}

struct Model {
    Pose pose;
    double cost;
    int64_t agree;
};

// Refine by Gauss-Newton steps under the truncated loss for as long as they help.
static void refine_locally(const rse_pf::Columns<float>& rows, int64_t n, const Optics& optics, double limit2,
                           Model& model) {
    Normal normal;
    model.cost = linearised<float, Loss::kTruncated>(rows, n, optics, model.pose, limit2, normal, model.agree);
    for (int step = 0; step < kLocalSteps; ++step) {
        double twist[6];
        if (!solved(normal, 0.0, twist)) return;
        Model next;
        next.pose = moved(twist, model.pose);
        next.cost = linearised<float, Loss::kTruncated>(rows, n, optics, next.pose, limit2, normal, next.agree);
        if (!(next.cost < model.cost)) return;
        const bool has_converged = model.cost - next.cost < 1e-3 * model.cost;
        model = next;
        if (has_converged) return;
    }
}

struct SearchOptions {
    double limit2;  // px^2
    double confidence;
    int64_t max_iterations, min_iterations;
};

// Find the pose that most rows agree with; say whether there is any.
static bool search(const rse_pf::Task& task, const Optics& optics, const SearchOptions& options, Model& best) {
    const rse_pf::Workspace& data = *task.workspace;
    const int64_t n = task.request->rows;
    Sampler sampler = {0};
    best.cost = kInfinity;
    best.agree = 0;
    double needed = static_cast<double>(options.max_iterations);
    int64_t least = options.min_iterations;
    if (n <= kFewRows && least < kTrialsOfFewRows) least = kTrialsOfFewRows;
    for (int64_t trial = 0; trial < options.max_iterations; ++trial) {
        if (trial >= least && static_cast<double>(trial) >= needed) break;
        int64_t rows[3];
        sampler.three(n, rows);
        Vector3 bearings[3], points[3];
        for (int i = 0; i < 3; ++i) {
            const int64_t row = rows[i];
            points[i] = {data.all.x[row], data.all.y[row], data.all.z[row]};
            bearings[i] = normalised({data.all.u[row] / optics.fx, data.all.v[row] / optics.fy, 1.0});
        }
        Pose poses[4];
        const int found = p3p(bearings, points, poses);
        for (int i = 0; i < found; ++i) {
            if (!(score(data.single, n, optics, poses[i], options.limit2, best.cost) < best.cost)) continue;
            Model model = {poses[i], 0.0, 0};
            refine_locally(data.single, n, optics, options.limit2, model);
            if (!(model.cost < best.cost)) continue;
            best = model;
            needed = trials_for(best.agree, n, options.confidence);
        }
    }
    return best.cost < kInfinity;
}

// Refine over the rows by Levenberg and Marquardt's method; false where it cannot start.
template <Loss loss>
static bool refine(const rse_pf::Columns<double>& rows, int64_t count, const Optics& optics, double limit2,
                   Pose& pose) {
    Normal normal, next_normal;
    int64_t agree = 0;
    double cost = linearised<double, loss>(rows, count, optics, pose, limit2, normal, agree), damping = 0.0;
    if (!(cost < kInfinity)) return false;
    for (int step = 0; step < kLastSteps; ++step) {
        double twist[6];
        if (!solved(normal, damping, twist)) {
            damping = damping > 0.0 ? damping * 10.0 : 1e-3;
            continue;
        }
        double length = 0.0;
        for (const double each : twist) length = absolute(each) > length ? absolute(each) : length;
        const Pose next = moved(twist, pose);
        const double next_cost =
            linearised<double, loss>(rows, count, optics, next, limit2, next_normal, agree);
        // Rounding hides the gain of the last step.
        if (!(next_cost <= cost * (1.0 + 1e-12))) {
            damping = damping > 0.0 ? damping * 10.0 : 1e-3;
            continue;
        }
        pose = next;
        cost = next_cost;
        normal = next_normal;
        damping = damping > 1e-9 ? damping * 0.1 : 0.0;
        if (length < kDoneStep) break;
    }
    return true;
}

// Copy the rows whose squared error in the view is at most limit2, and note their numbers; return how many.
static int64_t gather(const rse_pf::Workspace& data, int64_t n, double limit2, uint32_t* numbers) {
    const rse_pf::Columns<double>&from = data.all, &to = data.inliers;
    int64_t count = 0;
    for (int64_t i = 0; i < n; ++i) {
        to.x[count] = from.x[i];
        to.y[count] = from.y[i];
        to.z[count] = from.z[i];
        to.u[count] = from.u[i];
        to.v[count] = from.v[i];
        if (numbers != nullptr) numbers[count] = static_cast<uint32_t>(i);
        count += data.error2[i] <= limit2 ? 1 : 0;
    }
    for (int64_t i = count; i < padded(count); ++i) {
        to.x[i] = to.y[i] = to.z[i] = 0.0;
        to.u[i] = to.v[i] = kNowhere;
    }
    return count;
}

// Refine the pose over the rows that agree with it; they are gathered, and the view then holds them only.
static int64_t refine_inliers(const rse_pf::Workspace& data, int64_t n, const Optics& optics, double limit2,
                              Pose& pose) {
    project(data.all, n, optics, pose, data);
    const int64_t count = gather(data, n, limit2, nullptr);
    // Half of the inlier limit is the scale of Cauchy's loss, as in PoseLib.
    if (count >= 4) refine<Loss::kCauchy>(data.inliers, count, optics, 0.25 * limit2, pose);
    project(data.inliers, count, optics, pose, data);
    return count;
}

// Find the robust pose of the rows as they stand in the workspace; say whether there is any.
static bool propose(const rse_pf::Task& task, const Optics& optics, const SearchOptions& options,
                      const Vector3& origin, Pose& pose) {
    Model best;
    if (!search(task, optics, options, best)) return false;
    const rse_pf::Workspace& data = *task.workspace;
    const int64_t n = task.request->rows;
    pose = best.pose;
    const int64_t count = refine_inliers(data, n, optics, options.limit2, pose);
    if (count >= 4 && depth_variation(data, count) < kWeakPerspective) {
        // The search may have ended in the worse one of the two poses of a plane.
        Pose twin;
        if (second_pose(data, count, optics, pose, origin, twin) >= 0.0) {
            refine_inliers(data, n, optics, options.limit2, twin);
            const double cost = score(data.single, n, optics, pose, options.limit2, kInfinity);
            if (score(data.single, n, optics, twin, options.limit2, cost) < cost) pose = twin;
        }
    }
    return is_finite(pose);
}

}  // namespace RSE_PF_ISA
