// Robust estimation of a pose: LO-RANSAC with P3P samples and the MSAC cost, then a refinement over the inliers.
//
// Sources: Chum, Matas and Kittler, Locally Optimized RANSAC, DAGM 2003; Lebeda, Matas and Chum, Fixing the Locally
// Optimized RANSAC, BMVC 2012.
#pragma once

#include "p3p.hpp"
#include "planar.hpp"

namespace RSE_PF_ISA {

// Most Gauss-Newton steps of a local optimisation within RANSAC: it only has to come near the minimum, since the last
// refinement converges.
constexpr int kLocalSteps = 4;
// Most correspondences of a request that counts as small: a sample is cheap there, and one inlier more or less decides
// whether the pose is weak.
constexpr int64_t kFewRows = 32;
// Fewest RANSAC samples of a request with at most 32 correspondences, where samples are cheap and one inlier decides.
constexpr int64_t kMinTrialsOfFewRows = 30;
// Most Levenberg-Marquardt steps of the last refinement: a bound for input on which it does not converge.
constexpr int kMaxRefinementSteps = 100;
// Step (largest component, metres and radians) below which the last refinement stops: the remaining error is a tenth of
// it.
constexpr double kConvergedStep = 1e-6;

// A pseudo-random generator with a fixed seed, so that equal requests draw equal samples: SplitMix64 (Steele, Lea and
// Flood, OOPSLA 2014).
struct Sampler {
    uint64_t state;

    uint64_t next() {
        state += 0x9E3779B97F4A7C15u;
        uint64_t z = state;
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        return z ^ (z >> 31);
    }
    // Draw three different row numbers below n, which is at least 3.
    void draw_three(int64_t n, int64_t (&rows)[3]) {
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

// Return the number of samples after which at least one of them holds three inliers with the wanted probability
// (confidence), where `inliers` of n rows are inliers; infinity for fewer than three inliers, 0 where all rows are.
static inline double required_trials(int64_t inliers, int64_t n, double confidence) {
    if (inliers < 3) return kInfinity;
    const double k = static_cast<double>(inliers), all_rows = static_cast<double>(n);
    const double share = k * (k - 1.0) * (k - 2.0) / (all_rows * (all_rows - 1.0) * (all_rows - 2.0));
    if (share >= 1.0) return 0.0;
    return natural_log(1.0 - confidence) / natural_log(1.0 - share);
}

// A pose with its MSAC cost (px^2) and its number of inliers, both over all rows.
struct Hypothesis {
    Pose pose;
    double cost;
    int64_t inliers;
};

// Refine the pose of a hypothesis in place by Gauss-Newton steps under the truncated loss, until a step does not lower
// the cost, lowers it by less than 0.1 %, or kLocalSteps are done.  Cost and inliers of the hypothesis are written; the
// values before are not read.  `limit2` is the squared inlier limit (px^2).
static void refine_locally(const rse_pf::Columns<float>& rows, int64_t n, const FocalLengths& focal, double limit2,
                           Hypothesis& hypothesis) {
    Normal normal;
    hypothesis.cost =
        linearise<float, Loss::kTruncated>(rows, n, focal, hypothesis.pose, limit2, normal, hypothesis.inliers);
    for (int step = 0; step < kLocalSteps; ++step) {
        double twist[6];
        if (!solve_normal_equations(normal, 0.0, twist)) return;
        Hypothesis next;
        next.pose = apply_twist_by_cayley(twist, hypothesis.pose);
        next.cost = linearise<float, Loss::kTruncated>(rows, n, focal, next.pose, limit2, normal, next.inliers);
        if (!(next.cost < hypothesis.cost)) return;
        const bool has_converged = hypothesis.cost - next.cost < 1e-3 * hypothesis.cost;
        hypothesis = next;
        if (has_converged) return;
    }
}

struct RansacOptions {
    double limit2;      // squared inlier limit, px^2
    double confidence;  // probability with which some sample holds three inliers when RANSAC stops
    int64_t max_iterations, min_iterations;  // bounds of the number of samples; the maximum wins
};

// Find the hypothesis with the lowest MSAC cost by LO-RANSAC; return false if no sample has a pose.
static bool run_ransac(const rse_pf::Task& task, const FocalLengths& focal, const RansacOptions& options,
                       Hypothesis& best) {
    const rse_pf::Workspace& data = *task.workspace;
    const int64_t n = task.request->rows;
    Sampler sampler = {0};
    best.cost = kInfinity;
    best.inliers = 0;
    double required = static_cast<double>(options.max_iterations);
    int64_t min_trials = options.min_iterations;
    if (n <= kFewRows && min_trials < kMinTrialsOfFewRows) min_trials = kMinTrialsOfFewRows;
    for (int64_t trial = 0; trial < options.max_iterations; ++trial) {
        if (trial >= min_trials && static_cast<double>(trial) >= required) break;
        // 1. Draw three correspondences, and solve P3P for them.
        int64_t rows[3];
        sampler.draw_three(n, rows);
        Vector3 bearings[3], points[3];
        for (int i = 0; i < 3; ++i) {
            const int64_t row = rows[i];
            points[i] = {data.all.x[row], data.all.y[row], data.all.z[row]};
            bearings[i] = normalise({data.all.u[row] / focal.fx, data.all.v[row] / focal.fy, 1.0});
        }
        Pose poses[4];
        const int solutions = solve_p3p(bearings, points, poses);
        for (int i = 0; i < solutions; ++i) {
            // 2. Drop a pose as soon as its cost reaches the lowest cost so far.
            if (!(msac_cost(data.single, n, focal, poses[i], options.limit2, best.cost) < best.cost)) continue;
            // 3. Refine the pose over all rows under the truncated loss (local optimisation).
            Hypothesis hypothesis = {poses[i], 0.0, 0};
            refine_locally(data.single, n, focal, options.limit2, hypothesis);
            if (!(hypothesis.cost < best.cost)) continue;
            // 4. Keep the hypothesis as the best one, and compute anew how many samples its inlier ratio requires.
            best = hypothesis;
            required = required_trials(best.inliers, n, options.confidence);
        }
    }
    return best.cost < kInfinity;
}

// Refine a pose in place over the rows by the Levenberg-Marquardt method, undamped (Gauss-Newton) until a step fails.
// limit2 (px^2) is the scale of the loss.  Return false where the first cost is infinite, because a point lies behind
// the camera: the pose stays then.  Return true also if kMaxRefinementSteps end the refinement before it has converged.
template <Loss loss>
static bool refine(const rse_pf::Columns<double>& rows, int64_t count, const FocalLengths& focal, double limit2,
                   Pose& pose) {
    Normal normal, next_normal;
    int64_t unused_inliers = 0;
    double cost = linearise<double, loss>(rows, count, focal, pose, limit2, normal, unused_inliers), damping = 0.0;
    if (!(cost < kInfinity)) return false;
    for (int step = 0; step < kMaxRefinementSteps; ++step) {
        double twist[6];
        if (!solve_normal_equations(normal, damping, twist)) {
            damping = damping > 0.0 ? damping * 10.0 : 1e-3;
            continue;
        }
        double largest = 0.0;
        for (const double component : twist) largest = absolute(component) > largest ? absolute(component) : largest;
        const Pose next = apply_twist_by_cayley(twist, pose);
        const double next_cost =
            linearise<double, loss>(rows, count, focal, next, limit2, next_normal, unused_inliers);
        // Accept an equal cost within rounding: near the minimum, rounding hides the decrease of a step.
        if (!(next_cost <= cost * (1.0 + 1e-12))) {
            damping = damping > 0.0 ? damping * 10.0 : 1e-3;
            continue;
        }
        pose = next;
        cost = next_cost;
        normal = next_normal;
        damping = damping > 1e-9 ? damping * 0.1 : 0.0;
        if (largest < kConvergedStep) break;
    }
    return true;
}

// Copy the inliers, which are the rows whose squared error (as `project` wrote it) is at most limit2 (px^2), to
// data.inliers, and pad the last vector.  The padding repeats the point of the last inlier, so that it lies behind the
// camera only where an inlier does.  Write the ascending row numbers of the inliers unless `numbers`, memory for n
// numbers, is null.  Return the number of inliers.
static int64_t gather_inliers(const rse_pf::Workspace& data, int64_t n, double limit2, uint32_t* numbers) {
    const rse_pf::Columns<double>&from = data.all, &to = data.inliers;
    int64_t count = 0;
    for (int64_t i = 0; i < n; ++i) {  // Without branches: an outlier is overwritten by the next row.
        to.x[count] = from.x[i];
        to.y[count] = from.y[i];
        to.z[count] = from.z[i];
        to.u[count] = from.u[i];
        to.v[count] = from.v[i];
        if (numbers != nullptr) numbers[count] = static_cast<uint32_t>(i);
        count += data.error2[i] <= limit2 ? 1 : 0;
    }
    for (int64_t i = count; i < padded(count); ++i) {
        to.x[i] = to.x[count - 1];
        to.y[i] = to.y[count - 1];
        to.z[i] = to.z[count - 1];
        to.u[i] = to.v[i] = kPaddingPixel;
    }
    return count;
}

// Refine a pose in place over its inliers under the Cauchy loss, and return their number; with fewer than four the pose
// stays.  The inliers are those of the pose before it is refined.  Afterwards data.inliers holds them, and the
// projections in the workspace are those of these rows at the refined pose.
static int64_t refine_over_inliers(const rse_pf::Workspace& data, int64_t n, const FocalLengths& focal, double limit2,
                                   Pose& pose) {
    project(data.all, n, focal, pose, data);
    const int64_t count = gather_inliers(data, n, limit2, nullptr);
    // The scale of the Cauchy loss is half of the inlier limit, as in PoseLib.
    if (count >= 4) refine<Loss::kCauchy>(data.inliers, count, focal, 0.25 * limit2, pose);
    project(data.inliers, count, focal, pose, data);
    return count;
}

// Estimate a pose of the rows in the workspace; return false if there is none.  `origin` is the point of the caller's
// world (metres) that was subtracted from the points; the pose maps the shifted points to the camera.
static bool estimate_pose(const rse_pf::Task& task, const FocalLengths& focal, const RansacOptions& options,
                          const Vector3& origin, Pose& pose) {
    // 1. Search for the pose by LO-RANSAC, whose costs are computed in single precision.
    Hypothesis best;
    if (!run_ransac(task, focal, options, best)) return false;
    // 2. Refine the pose over its inliers in double precision.
    const rse_pf::Workspace& data = *task.workspace;
    const int64_t n = task.request->rows;
    pose = best.pose;
    const int64_t count = refine_over_inliers(data, n, focal, options.limit2, pose);
    // 3. For a planar scene, RANSAC may have found the worse one of its two poses: take the one with the lower MSAC
    // cost.
    if (count >= 4 && inverse_depth_variation(data, count) < kWeakPerspective) {
        Pose second;
        if (find_second_pose(data, count, focal, pose, origin, second) >= 0.0) {
            refine_over_inliers(data, n, focal, options.limit2, second);
            const double cost = msac_cost(data.single, n, focal, pose, options.limit2, kInfinity);
            if (msac_cost(data.single, n, focal, second, options.limit2, cost) < cost) pose = second;
        }
    }
    return is_finite(pose);
}

}  // namespace RSE_PF_ISA
