// The clock that deadlines are measured by.
#pragma once

#include <time.h>

namespace RSE_PF_ISA {

static int64_t now_ns() {
    timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return static_cast<int64_t>(now.tv_sec) * 1000000000 + now.tv_nsec;
}

}  // namespace RSE_PF_ISA
