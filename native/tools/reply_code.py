"""Write ``native/src/reply_code.hpp``: the Huffman code of a `pnp` reply's text, and its block's head.

    python native/tools/reply_code.py > native/src/reply_code.hpp

Source:
    RFC 1951, Sect. 3.2.2 and 3.2.7; the frequencies are those of the replies to `rse_pf.pnp.problems`.
"""

from __future__ import annotations

import heapq
import string
import sys

__all__ = ["FREQUENCIES", "block_head", "code_lengths", "codes_of", "main"]

FREQUENCIES = {
    ",": 1700, "0": 780, "1": 1650, "2": 870, "3": 850, "4": 850, "5": 850, "6": 850, "7": 850,
    "8": 850, "9": 850, ".": 440, "-": 330, "e": 340, '"': 320, ":": 120, "[": 30, "]": 30, "{": 20,
    "}": 20, "_": 60, "a": 40, "c": 45, "d": 40, "i": 60, "l": 50, "m": 45, "n": 60, "o": 45, "p": 40,
    "r": 60, "s": 60, "t": 50, "u": 40, "v": 40, "b": 15, "g": 20, "k": 12, "w": 10, "x": 15, "y": 12,
    "T": 10, "q": 10, "f": 10, "h": 10, "z": 2, "j": 2,
}  # fmt: skip
"""How often a character stands in about ten replies; every other one may stand there, too."""

_END = 256
_RARE, _OTHER_LETTERS = 0.05, 1.0
_MAX_BITS, _MAX_HEAD_BITS = 15, 7
_ORDER = (16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15)


def code_lengths(weights: list[float], max_bits: int) -> list[int]:
    """Return the lengths of a Huffman code of *weights*, of which none is longer than *max_bits*."""
    floor = 0.0
    while True:
        heap: list[tuple[float, int, tuple[int, ...]]] = [
            (max(weight, floor), symbol, (symbol,)) for symbol, weight in enumerate(weights) if weight > 0
        ]
        lengths = [0] * len(weights)
        heapq.heapify(heap)
        while len(heap) > 1:
            first, number, below = heapq.heappop(heap)
            second, _, beside = heapq.heappop(heap)
            for symbol in below + beside:
                lengths[symbol] += 1
            heapq.heappush(heap, (first + second, number, below + beside))
        if max(lengths) <= max_bits:
            return lengths
        floor = max(floor * 1.1, 0.001)


def codes_of(lengths: list[int]) -> list[int]:
    """Return the codes of *lengths*, the first bit lowest."""
    codes, code = [0] * len(lengths), 0
    for bits in range(1, _MAX_BITS + 1):
        for symbol, length in enumerate(lengths):
            if length == bits:
                codes[symbol] = int(f"{code:0{bits}b}"[::-1], 2)
                code += 1
        code <<= 1
    return codes


def block_head(lengths: list[int]) -> tuple[int, int]:
    """Return the bits before the first code, the first one lowest, and their number."""
    bits, count = 0x0178, 16

    def put(value: int, size: int) -> None:
        nonlocal bits, count
        bits |= value << count
        count += size

    put(1, 1)
    put(2, 2)
    steps = _run_lengths([*lengths, 0])
    used = [0.0] * 19
    for symbol, _, _ in steps:
        used[symbol] += 1
    own = code_lengths(used, _MAX_HEAD_BITS)
    own_codes = codes_of(own)
    shown = max(place for place, symbol in enumerate(_ORDER) if own[symbol]) + 1
    put(0, 5)
    put(0, 5)
    put(shown - 4, 4)
    for symbol in _ORDER[:shown]:
        put(own[symbol], 3)
    for symbol, extra, size in steps:
        put(own_codes[symbol], own[symbol])
        put(extra, size)
    return bits, count


def _run_lengths(lengths: list[int]) -> list[tuple[int, int, int]]:
    """Return the code lengths as symbol, extra bits and their number; 16 repeats the last one."""
    steps: list[tuple[int, int, int]] = []
    at = 0
    while at < len(lengths):
        run = 1
        while at + run < len(lengths) and lengths[at + run] == lengths[at]:
            run += 1
        steps.append((lengths[at], 0, 0))
        at, run = at + 1, run - 1
        while run >= 3:
            times = min(run, 6)
            steps.append((16, times - 3, 2))
            at, run = at + times, run - times
    return steps


def main() -> None:
    """Print the header."""

    def write(line: str) -> None:
        sys.stdout.write(line + "\n")

    weights = [float(FREQUENCIES.get(chr(symbol), 0)) for symbol in range(256)] + [10.0]
    for symbol in range(256):
        known = chr(symbol) in string.ascii_letters + string.digits + " /=()"
        weights[symbol] = weights[symbol] or (_OTHER_LETTERS if known else _RARE)
    lengths = code_lengths(weights, _MAX_BITS)
    codes = codes_of(lengths)
    bits, count = block_head(lengths)
    write("// Written by native/tools/reply_code.py; do not edit.")
    write("#pragma once")
    write("\n#include <cstdint>\n\nnamespace rse_pf_codec {\n")
    write("// The head of the zlib stream and of its only block; the last byte holds kHeadBits % 8 bits.")
    write(f"constexpr int32_t kHeadBits = {count};")
    head = ", ".join(f"0x{byte:02x}" for byte in bits.to_bytes((count + 7) // 8, "little"))
    write(f"constexpr uint8_t kHead[] = {{{head}}};\n")
    write("// Of each byte, and of the end at last: code << 4 | bits.")
    write("constexpr uint32_t kCodes[257] = {")
    for begin in range(0, 257, 8):
        row = zip(codes[begin : begin + 8], lengths[begin : begin + 8], strict=True)
        write("    " + " ".join(f"0x{code << 4 | length:05x}," for code, length in row))
    write("};\n\n}  // namespace rse_pf_codec")


if __name__ == "__main__":
    main()
