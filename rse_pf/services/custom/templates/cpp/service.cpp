// @NAME@: compute the centroid and the radius of a point cloud.
#include <algorithm>
#include <cmath>

#include "rse_pf_service.hpp"

struct Service {
  // Request: points, the 3n coordinates of n points, metres, row by row.
  // Reply: centroid, 3 coordinates in metres; radius, the largest distance of a point from it, metres.
  rse_pf::Fields call(const rse_pf::Fields &request) {
    const std::vector<double> &points = request.rows("points", 3);
    std::size_t n = points.size() / 3;
    if (n == 0) throw rse_pf::BadRequest("there are no points");
    std::vector<double> centroid(3, 0.0);
    for (std::size_t i = 0; i < points.size(); ++i) centroid[i % 3] += points[i] / n;
    double radius = 0.0;
    for (std::size_t i = 0; i < n; ++i)
      radius = std::max(radius, std::hypot(points[3 * i] - centroid[0], points[3 * i + 1] - centroid[1],
                                           points[3 * i + 2] - centroid[2]));
    rse_pf::Fields reply;
    reply["centroid"] = rse_pf::Field::array(centroid, {3});
    reply["radius"] = rse_pf::Field::number(radius);
    return reply;
  }
};

RSE_PF_SERVICE(Service)
