// Checks of a test program: a failed check prints its text, and the program then exits with 1.
#pragma once

#include <cstdio>
#include <string>

inline int& failures() {
    static int count = 0;
    return count;
}

inline void expect(bool holds, const std::string& what) {
    if (holds) return;
    std::printf("FAILED: %s\n", what.c_str());
    ++failures();
}

template <class Work> void expect_error(const std::string& code, Work work, const std::string& what) {
    try {
        work();
        expect(false, what + ": no error");
    } catch (const rse_pf::RsePfError& error) {
        expect(error.code() == code, what + ": " + error.what());
    }
}
