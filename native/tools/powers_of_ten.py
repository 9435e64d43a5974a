"""Write ``native/src/powers_of_ten.hpp``: the 128 leading bits of every power of ten that a double needs.

    python native/tools/powers_of_ten.py > native/src/powers_of_ten.hpp

Source:
    Lemire, "Number Parsing at a Gigabyte per Second", Software: Practice and Experience 51(8), 2021, Sect. 5.
"""

from __future__ import annotations

import sys

__all__ = ["HIGHEST", "LOWEST", "leading_bits", "main"]

LOWEST, HIGHEST = -342, 324


def leading_bits(exponent: int) -> int:
    """Return the 128 leading bits of ``10 ** exponent``, which are those of ``5 ** exponent``.

    They are rounded down, and from -27 to -1 rounded up.
    """
    power = 5 ** abs(exponent)
    if exponent >= 0:
        shift = power.bit_length() - 128
        return power >> shift if shift > 0 else power << -shift
    size = power.bit_length()
    if exponent >= -27:
        return (1 << (size + 127)) // power + 1
    bits = ((1 << (2 * size + 128)) // power) + 1
    return bits >> (bits.bit_length() - 128)


def main() -> None:
    """Print the header."""

    def write(line: str) -> None:
        sys.stdout.write(line + "\n")

    write("// Written by native/tools/powers_of_ten.py; do not edit.")
    write("#pragma once")
    write("\n#include <cstdint>\n")
    write("namespace rse_pf_codec {\n")
    write(f"constexpr int32_t kLowestPower = {LOWEST}, kHighestPower = {HIGHEST};\n")
    write("// The high and the low half of the 128 leading bits of each power of ten.")
    write("constexpr uint64_t kPowersOfTen[][2] = {")
    for exponent in range(LOWEST, HIGHEST + 1):
        bits = leading_bits(exponent)
        write(f"    {{0x{bits >> 64:016x}u, 0x{bits & (2**64 - 1):016x}u}},  // {exponent}")
    write("};\n\n}  // namespace rse_pf_codec")


if __name__ == "__main__":
    main()
