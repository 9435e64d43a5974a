// A voxel grid with the mean position and colour of the points in each voxel, found by an open-addressing hash table.
#include "rse_pf_cloud.h"

namespace {

// Most points that one call adds: a limit of plausible requests.
constexpr int64_t kMaxRows = int64_t{1} << 28;
// Largest height or width of a depth image, pixels: a limit of plausible requests.
constexpr int64_t kMaxSide = int64_t{1} << 16;
// Key of an empty slot of the hash table; keys of voxels are not negative.
constexpr int64_t kEmpty = -1;

// Return a hash of a voxel's key: the first half of the finaliser of MurmurHash3 (Appleby 2011).
uint64_t hash_key(int64_t key) {
    auto mixed = static_cast<uint64_t>(key);
    mixed = (mixed ^ (mixed >> 33)) * 0xFF51AFD7ED558CCDu;
    return (mixed ^ (mixed >> 33)) >> 1;
}

// Return the index of the voxel at a coordinate (metres) along one axis, counted from the negative end of the grid; -1
// outside of the grid.
int64_t axis_index(double coordinate, double voxel_m, int64_t reach) {
    const double index = __builtin_floor(coordinate / voxel_m);
    const auto limit = static_cast<double>(reach);
    return index > -limit && index < limit ? static_cast<int64_t>(index) + reach : -1;
}

// Return the slot that holds a key, or the empty slot that ends the search for it (linear probing); count the slots
// that are read in grid.probes.
uint64_t find_slot(rse_pf_cloud_request& grid, int64_t key) {
    const auto mask = static_cast<uint64_t>(grid.slots - 1);
    uint64_t slot = hash_key(key) & mask;
    for (;; slot = (slot + 1) & mask) {
        ++grid.probes;
        if (grid.slot_keys[slot] == key || grid.slot_keys[slot] == kEmpty) return slot;
    }
}

void fill_slot(rse_pf_cloud_request& grid, uint64_t slot, int64_t row) {
    grid.slot_keys[slot] = grid.keys[row];
    grid.slot_rows[slot] = static_cast<int32_t>(row);
}

// Return the row of a voxel, which is added if it is new; -1 if the grid is full.
int64_t find_or_add_voxel(rse_pf_cloud_request& grid, int64_t key) {
    const uint64_t slot = find_slot(grid, key);
    if (grid.slot_keys[slot] != kEmpty) return grid.slot_rows[slot];
    if (grid.voxels >= grid.max_voxels) return -1;
    const int64_t row = grid.voxels++;
    grid.keys[row] = key;
    grid.counts[row] = 0;
    for (int k = 0; k < 6; ++k) grid.means[6 * row + k] = 0.0f;
    fill_slot(grid, slot, row);
    return row;
}

// The voxel of the previous point, which saves a search: neighbours in an image often fall into the same voxel.
struct PreviousVoxel {
    int64_t key = kEmpty, row = -1;
};

// Add a point (metres, world frame), which is the mean of `weight` measurements, to the running means of its voxel, and
// `weight` to grid.used.  A point outside of the grid, or in a new voxel of a full grid, is left out.
void add_point(rse_pf_cloud_request& grid, PreviousVoxel& previous, const double (&point)[3], const double (&colour)[3],
               int32_t weight) {
    const int64_t x = axis_index(point[0], grid.voxel_m, grid.reach), y = axis_index(point[1], grid.voxel_m, grid.reach);
    const int64_t z = axis_index(point[2], grid.voxel_m, grid.reach);
    if (x < 0 || y < 0 || z < 0) return;
    const int64_t key = x << 42 | y << 21 | z;
    if (key != previous.key) previous = {key, find_or_add_voxel(grid, key)};
    if (previous.row < 0) return;
    int32_t& count = grid.counts[previous.row];
    count += weight;
    grid.used += weight;
    const double share = static_cast<double>(weight) / static_cast<double>(count);
    float* const mean = grid.means + 6 * previous.row;
    for (int k = 0; k < 3; ++k) {
        mean[k] += static_cast<float>(share * (point[k] - static_cast<double>(mean[k])));
        mean[k + 3] += static_cast<float>(share * (colour[k] - static_cast<double>(mean[k + 3])));
    }
}

// Return whether two neighbouring depths belong to one surface: they differ by at most a share of `after`, the right or
// lower one of the two.
bool is_smooth(float before, float after, float share) { return __builtin_fabsf(after - before) <= after * share; }

// Return whether the depth of a pixel is in range, and not on a depth edge with one of its four neighbours in the
// image.
bool is_usable(const rse_pf_cloud_frame& frame, int64_t row, int64_t column) {
    const float* const at = frame.depth_m + row * frame.width + column;
    return *at >= frame.min_depth_m && *at <= frame.max_depth_m &&
           (column == 0 || is_smooth(at[-1], *at, frame.edge_share)) &&
           (column + 1 == frame.width || is_smooth(*at, at[1], frame.edge_share)) &&
           (row == 0 || is_smooth(at[-frame.width], *at, frame.edge_share)) &&
           (row + 1 == frame.height || is_smooth(*at, at[frame.width], frame.edge_share));
}

bool is_valid(const rse_pf_cloud_request& grid) {
    return grid.abi == RSE_PF_CLOUD_ABI && grid.rows >= 0 && grid.rows <= kMaxRows && grid.points != nullptr &&
           grid.colours != nullptr && grid.weights != nullptr && grid.voxel_m > 0.0 && grid.reach >= 1 &&
           grid.reach <= (int64_t{1} << 20) && grid.slots >= 2 && (grid.slots & (grid.slots - 1)) == 0 &&
           grid.slot_keys != nullptr && grid.slot_rows != nullptr && grid.voxels >= 0 && grid.voxels <= grid.max_voxels &&
           grid.max_voxels < grid.slots && grid.keys != nullptr && grid.means != nullptr && grid.counts != nullptr;
}

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_cloud_abi(void) { return RSE_PF_CLOUD_ABI; }

__attribute__((visibility("default"))) int32_t rse_pf_cloud_add(rse_pf_cloud_request* request) {
    if (request == nullptr || !is_valid(*request)) return -1;
    rse_pf_cloud_request& grid = *request;
    grid.used = grid.probes = 0;
    PreviousVoxel previous;
    for (int64_t i = 0; i < grid.rows; ++i) {
        const double* const point = grid.points + 3 * i;
        const float* const colour = grid.colours + 3 * i;
        add_point(grid, previous, {point[0], point[1], point[2]}, {colour[0], colour[1], colour[2]}, grid.weights[i]);
    }
    return 0;
}

__attribute__((visibility("default"))) int32_t rse_pf_cloud_add_frame(rse_pf_cloud_request* request,
                                                                      const rse_pf_cloud_frame* frame) {
    if (request == nullptr || frame == nullptr || !is_valid(*request) || frame->depth_m == nullptr ||
        frame->rgb == nullptr || frame->width < 1 || frame->height < 1 || frame->width > kMaxSide ||
        frame->height > kMaxSide || frame->every_px < 1)
        return -1;
    rse_pf_cloud_request& grid = *request;
    grid.used = grid.probes = 0;
    const auto& T = frame->T_world_camera;
    PreviousVoxel previous;
    for (int64_t row = 0; row < frame->height; row += frame->every_px)
        for (int64_t column = 0; column < frame->width; column += frame->every_px) {
            if (!is_usable(*frame, row, column)) continue;
            const auto z = static_cast<double>(frame->depth_m[row * frame->width + column]);
            const double x = (static_cast<double>(column) - frame->cx) / frame->fx * z;
            const double y = (static_cast<double>(row) - frame->cy) / frame->fy * z;
            const uint8_t* const rgb = frame->rgb + 3 * (row * frame->width + column);
            const double point[3] = {T[0] * x + T[1] * y + T[2] * z + T[3], T[4] * x + T[5] * y + T[6] * z + T[7],
                                     T[8] * x + T[9] * y + T[10] * z + T[11]};
            add_point(grid, previous, point,
                        {static_cast<double>(rgb[0]), static_cast<double>(rgb[1]), static_cast<double>(rgb[2])}, 1);
        }
    return 0;
}

__attribute__((visibility("default"))) int32_t rse_pf_cloud_index(rse_pf_cloud_request* request) {
    if (request == nullptr || !is_valid(*request)) return -1;
    rse_pf_cloud_request& grid = *request;
    grid.used = grid.probes = 0;
    for (int64_t slot = 0; slot < grid.slots; ++slot) grid.slot_keys[slot] = kEmpty;
    for (int64_t row = 0; row < grid.voxels; ++row) fill_slot(grid, find_slot(grid, grid.keys[row]), row);
    return 0;
}
}
