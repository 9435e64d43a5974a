// icp-cpp: align one cloud of points to another (iterative closest point, point to point).
#include "icp.hpp"
#include "rse_pf_service.hpp"

namespace {

constexpr std::size_t kFewest = 3, kMost = 2000;

const std::vector<double> &cloud(const rse_pf::Fields &request, const char *name) {
  const std::vector<double> &points = request.rows(name, 3);
  if (points.size() < 3 * kFewest || points.size() > 3 * kMost)
    throw rse_pf::BadRequest(std::string(name) + " must have 3 to 2000 points");
  return points;
}

}  // namespace

struct Service {
  // Request: source, target (rows of 3 metres), iterations.  Reply: T_target_source (16, row-major), rmse_m.
  rse_pf::Fields call(const rse_pf::Fields &request) {
    const auto &source = cloud(request, "source"), &target = cloud(request, "target");
    int iterations = request.count("iterations") ? static_cast<int>(request.at("iterations").as_number()) : 30;
    icp::Motion T;
    double rmse =
        icp::align(source.data(), source.size() / 3, target.data(), target.size() / 3, iterations, T);
    rse_pf::Fields reply;
    reply["T_target_source"] = rse_pf::Field::array({T.begin(), T.end()}, {16});
    reply["rmse_m"] = rse_pf::Field::number(rmse);
    return reply;
  }
};

RSE_PF_SERVICE(Service)
