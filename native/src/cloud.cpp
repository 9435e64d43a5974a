// Readings of a depth camera in voxels, by an open-addressing hash table.
#include "rse_pf_cloud.h"

namespace {

constexpr int64_t kMaxRows = int64_t{1} << 28, kMaxSide = int64_t{1} << 16, kEmpty = -1;

// The finaliser of MurmurHash3 (Appleby 2011).
uint64_t hash_of(int64_t key) {
    auto mixed = static_cast<uint64_t>(key);
    mixed = (mixed ^ (mixed >> 33)) * 0xFF51AFD7ED558CCDu;
    return (mixed ^ (mixed >> 33)) >> 1;
}

// The index of a voxel along one axis, counted from the far end; -1 beyond the reach.
int64_t index_of(double place, double voxel_m, int64_t reach) {
    const double index = __builtin_floor(place / voxel_m);
    const auto most = static_cast<double>(reach);
    return index > -most && index < most ? static_cast<int64_t>(index) + reach : -1;
}

// Return the slot that holds a key, or the empty slot that ends its search.
uint64_t slot_of(rse_pf_cloud_request& all, int64_t key) {
    const auto mask = static_cast<uint64_t>(all.slots - 1);
    uint64_t slot = hash_of(key) & mask;
    for (;; slot = (slot + 1) & mask) {
        ++all.probes;
        if (all.slot_keys[slot] == key || all.slot_keys[slot] == kEmpty) return slot;
    }
}

void put(rse_pf_cloud_request& all, uint64_t slot, int64_t row) {
    all.slot_keys[slot] = all.keys[row];
    all.slot_rows[slot] = static_cast<int32_t>(row);
}

// Return the row of a voxel, which is made where it is new; -1 where there is no room.
int64_t row_of(rse_pf_cloud_request& all, int64_t key) {
    const uint64_t slot = slot_of(all, key);
    if (all.slot_keys[slot] != kEmpty) return all.slot_rows[slot];
    if (all.size >= all.room) return -1;
    const int64_t row = all.size++;
    all.keys[row] = key;
    all.counts[row] = 0;
    for (int k = 0; k < 6; ++k) all.means[6 * row + k] = 0.0f;
    put(all, slot, row);
    return row;
}

// The voxel of the last reading: neighbours in an image fall into one voxel.
struct Last {
    int64_t key = kEmpty, row = -1;
};

void add_reading(rse_pf_cloud_request& all, Last& last, const double (&point)[3], const double (&colour)[3],
                 int32_t readings) {
    const int64_t x = index_of(point[0], all.voxel_m, all.reach), y = index_of(point[1], all.voxel_m, all.reach);
    const int64_t z = index_of(point[2], all.voxel_m, all.reach);
    if (x < 0 || y < 0 || z < 0) return;
    const int64_t key = x << 42 | y << 21 | z;
    if (key != last.key) last = {key, row_of(all, key)};
    if (last.row < 0) return;
    int32_t& count = all.counts[last.row];
    count += readings;
    all.used += readings;
    const double share = static_cast<double>(readings) / static_cast<double>(count);
    float* const mean = all.means + 6 * last.row;
    for (int k = 0; k < 3; ++k) {
        mean[k] += static_cast<float>(share * (point[k] - static_cast<double>(mean[k])));
        mean[k + 3] += static_cast<float>(share * (colour[k] - static_cast<double>(mean[k + 3])));
    }
}

// Whether two neighbours lie on one surface: the right or lower one says how far they may differ.
bool is_smooth(float before, float after, float share) { return __builtin_fabsf(after - before) <= after * share; }

// Whether a depth is in range, and those around it are of its surface.
bool is_usable(const rse_pf_cloud_frame& frame, int64_t row, int64_t column) {
    const float* const at = frame.depth_m + row * frame.width + column;
    return *at >= frame.min_depth_m && *at <= frame.max_depth_m &&
           (column == 0 || is_smooth(at[-1], *at, frame.edge_share)) &&
           (column + 1 == frame.width || is_smooth(*at, at[1], frame.edge_share)) &&
           (row == 0 || is_smooth(at[-frame.width], *at, frame.edge_share)) &&
           (row + 1 == frame.height || is_smooth(*at, at[frame.width], frame.edge_share));
}

bool is_whole(const rse_pf_cloud_request& all) {
    return all.abi == RSE_PF_CLOUD_ABI && all.rows >= 0 && all.rows <= kMaxRows && all.points != nullptr &&
           all.colours != nullptr && all.readings != nullptr && all.voxel_m > 0.0 && all.reach >= 1 &&
           all.reach <= (int64_t{1} << 20) && all.slots >= 2 && (all.slots & (all.slots - 1)) == 0 &&
           all.slot_keys != nullptr && all.slot_rows != nullptr && all.size >= 0 && all.size <= all.room &&
           all.room < all.slots && all.keys != nullptr && all.means != nullptr && all.counts != nullptr;
}

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_cloud_abi(void) { return RSE_PF_CLOUD_ABI; }

__attribute__((visibility("default"))) int32_t rse_pf_cloud_add(rse_pf_cloud_request* request) {
    if (request == nullptr || !is_whole(*request)) return -1;
    rse_pf_cloud_request& all = *request;
    all.used = all.probes = 0;
    Last last;
    for (int64_t i = 0; i < all.rows; ++i) {
        const double* const point = all.points + 3 * i;
        const float* const colour = all.colours + 3 * i;
        add_reading(all, last, {point[0], point[1], point[2]}, {colour[0], colour[1], colour[2]}, all.readings[i]);
    }
    return 0;
}

__attribute__((visibility("default"))) int32_t rse_pf_cloud_add_frame(rse_pf_cloud_request* request,
                                                                      const rse_pf_cloud_frame* frame) {
    if (request == nullptr || frame == nullptr || !is_whole(*request) || frame->depth_m == nullptr ||
        frame->rgb == nullptr || frame->width < 1 || frame->height < 1 || frame->width > kMaxSide ||
        frame->height > kMaxSide || frame->every_px < 1)
        return -1;
    rse_pf_cloud_request& all = *request;
    all.used = all.probes = 0;
    const auto& T = frame->T_world_camera;
    Last last;
    for (int64_t row = 0; row < frame->height; row += frame->every_px)
        for (int64_t column = 0; column < frame->width; column += frame->every_px) {
            if (!is_usable(*frame, row, column)) continue;
            const auto z = static_cast<double>(frame->depth_m[row * frame->width + column]);
            const double x = (static_cast<double>(column) - frame->cx) / frame->fx * z;
            const double y = (static_cast<double>(row) - frame->cy) / frame->fy * z;
            const uint8_t* const rgb = frame->rgb + 3 * (row * frame->width + column);
            const double point[3] = {T[0] * x + T[1] * y + T[2] * z + T[3], T[4] * x + T[5] * y + T[6] * z + T[7],
                                     T[8] * x + T[9] * y + T[10] * z + T[11]};
            add_reading(all, last, point,
                        {static_cast<double>(rgb[0]), static_cast<double>(rgb[1]), static_cast<double>(rgb[2])}, 1);
        }
    return 0;
}

__attribute__((visibility("default"))) int32_t rse_pf_cloud_index(rse_pf_cloud_request* request) {
    if (request == nullptr || !is_whole(*request)) return -1;
    rse_pf_cloud_request& all = *request;
    all.used = all.probes = 0;
    for (int64_t slot = 0; slot < all.slots; ++slot) all.slot_keys[slot] = kEmpty;
    for (int64_t row = 0; row < all.size; ++row) put(all, slot_of(all, all.keys[row]), row);
    return 0;
}
}
