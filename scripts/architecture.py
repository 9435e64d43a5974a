"""Write ``docs/images/architecture.svg``: the packages as boxes, and the imports between them as arrows.

The picture is computed from the sources alone, so equal sources give equal bytes.  An arrow is left out
where a chain of other arrows says the same.  Boxes stand on rows: a package stands above all that it
imports.  Source: Sugiyama et al. 1981 for the rows, with barycentres for the order within a row.
"""

from __future__ import annotations

import ast
import html
import itertools
import re
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["draw", "main", "package_imports", "read_sources"]

TOPS = ("rse_pf", "client_sdk", "lambda_pnp", "ros_bridge", "stacks")
PROCESSES = {"backend", "data_server", "local", "client_sdk", "lambda_pnp", "ros_bridge", "stacks"}
ABOVE = {"cli", "experiments"}

_TITLE_PX, _LINE_PX, _PAD_PX = 22, 15, 10
_LETTER_PX, _MAX_LETTERS = 6.7, 21
_BOX_GAP_PX, _LANE_PX, _ROW_GAP_PX, _MARGIN_PX = 16, 8, 40, 12
_SWEEPS = 24

_STYLE = """
text { font-family: "DejaVu Sans", Verdana, sans-serif; font-size: 11px; fill: #333; }
.title { font-size: 13px; font-weight: bold; fill: #111; }
.box { stroke: #666; stroke-width: 1; }
.ground { fill: #eef3e6; } .process { fill: #e3edf8; } .above { fill: #f3e9f5; } .inner { fill: #ffffff; }
.edge { fill: none; stroke: #8a8a8a; stroke-width: 1.3; }
.edge.inside { stroke: #3c6ea5; }
"""


@dataclass(slots=True)
class Box:
    """A package, or a group of modules, with what is drawn in it; sizes in pixels."""

    name: str
    lines: list[str] = field(default_factory=list)
    inside: Drawing | None = None
    kind: str = "ground"
    width: float = 0.0
    height: float = 0.0
    x: float = 0.0
    y: float = 0.0


@dataclass(slots=True)
class Drawing:
    """Boxes with their places, and arrows as points from the importing box to the imported one."""

    boxes: list[Box]
    arrows: list[list[tuple[float, float]]]
    width: float
    height: float


def read_sources(repository: Path) -> dict[str, str]:
    """Return the text of every Python file of the packages in `TOPS`, by path."""
    files = (path for top in TOPS for path in sorted((repository / top).rglob("*.py")))
    return {
        str(path.relative_to(repository)): path.read_text(encoding="utf-8")
        for path in files
        if "templates" not in path.parts
    }


def package_imports(sources: Mapping[str, str]) -> dict[str, set[str]]:
    """Return the modules that each module imports, lazily, for types or at once, by dotted names."""
    modules = {_module(path) for path in sources}
    imports_of: dict[str, set[str]] = {}
    for path, text in sources.items():
        module = _module(path)
        names = imports_of.setdefault(module, set())
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                whole = {f"{node.module}.{alias.name}" for alias in node.names}
                names |= {name if name in modules else node.module for name in whole}
        names &= modules
        names.discard(module)
    return imports_of


def purpose(text: str) -> str:
    """Return the beginning of a module's docstring, up to the first mark of punctuation."""
    return re.split(r"(?<!Fig)[:;,.](?:\s|$)", ast.get_docstring(ast.parse(text)) or "", maxsplit=1)[0]


def draw(sources: Mapping[str, str]) -> str:
    """Return the picture of the packages in *sources* as SVG."""
    imports = package_imports(sources)
    modules = sorted(imports)
    rooms = sorted({_room(module) for module in modules} - {"rse_pf"})
    purposes = {_module(path): purpose(text) for path, text in sources.items()}
    boxes = [
        _room_box(room, [module for module in modules if _room(module) == room], imports, purposes)
        for room in rooms
    ]
    drawing = arrange(boxes, _edges(imports, {module: _room(module) for module in modules}, rooms))
    return _svg(drawing)


def _module(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _room(module: str) -> str:
    """Return the top package that a module belongs to; ``rse_pf.`` is left out."""
    names = module.split(".")
    return names[1] if names[0] == "rse_pf" and len(names) > 1 else names[0]


def _room_box(
    room: str, modules: list[str], imports: Mapping[str, set[str]], purposes: Mapping[str, str]
) -> Box:
    prefix = room if room in TOPS else f"rse_pf.{room}"
    below = {module: module.removeprefix(prefix).lstrip(".") for module in modules}
    folders = sorted({name.partition(".")[0] for name in below.values() if "." in name})
    kind = "process" if room in PROCESSES else "above" if room in ABOVE else "ground"
    if not folders:
        return _leaf(room, purposes.get(prefix, ""), kind)
    part_of = {module: name.partition(".")[0] for module, name in below.items() if name}
    levels = _root_levels(part_of, set(folders), imports)
    part_of |= {module: f"  {level}" for module, level in levels.items()}
    top, *lower = sorted({f"  {level}" for level in levels.values()}, reverse=True) or [""]
    inner = []
    for part in [top, *folders, *lower]:
        names = [below[module] for module in modules if part_of.get(module) == part]
        if part in folders:
            inner.append(_leaf(part, purposes.get(f"{prefix}.{part}", ""), "inner"))
        elif names:
            inner.append(_leaf(part, "  ".join(sorted(names)), "inner"))
    parts = [box.name for box in inner]
    edges = _edges({module: imports[module] & part_of.keys() for module in part_of}, part_of, parts)
    inside = arrange(inner, edges)
    return Box(
        name=room, inside=inside, kind=kind,
        width=inside.width + 2 * _PAD_PX, height=inside.height + _TITLE_PX + 2 * _PAD_PX,
    )  # fmt: skip


def _root_levels(
    part_of: Mapping[str, str], folders: set[str], imports: Mapping[str, set[str]]
) -> dict[str, int]:
    """Return the level of each module at the root of a package: above how many rows of folders it stands."""
    levels = dict.fromkeys(part_of.values(), 0)
    for _ in levels:  # a longest way has no more steps than there are parts
        for module, part in part_of.items():
            for other in {part_of[name] for name in imports[module] if name in part_of} - {part}:
                is_above = part not in folders and other in folders
                levels[part] = max(levels[part], levels[other] + is_above)
    return {module: levels[part] for module, part in part_of.items() if part not in folders}


def _leaf(name: str, words: str, kind: str) -> Box:
    lines = textwrap.wrap(words, _MAX_LETTERS)
    has_title = not name.startswith(" ")
    longest = max([len(line) for line in lines] + [1.35 * len(name) if has_title else 0])
    title = _TITLE_PX if has_title else _PAD_PX
    return Box(
        name=name, lines=lines, kind=kind, width=longest * _LETTER_PX + 2 * _PAD_PX,
        height=title + len(lines) * _LINE_PX + _PAD_PX,
    )  # fmt: skip


def _edges(
    imports: Mapping[str, set[str]], part_of: Mapping[str, str], parts: Iterable[str]
) -> dict[str, list[str]]:
    """Return the arrows between parts that no chain of other arrows implies."""
    direct: dict[str, set[str]] = {part: set() for part in parts}
    for module, names in imports.items():
        for name in names:
            upper, lower = part_of[module], part_of[name]
            if upper != lower and upper in direct and lower in direct:
                direct[upper].add(lower)
    reach: dict[str, set[str]] = {}

    def reachable(part: str) -> set[str]:
        if part not in reach:
            reach[part] = set()
            reach[part] = direct[part].union(*(reachable(lower) for lower in direct[part]))
        return reach[part]

    return {
        part: sorted(
            lower
            for lower in lowers
            if not any(lower in reachable(other) for other in lowers if other != lower)
        )
        for part, lowers in direct.items()
    }


def arrange(boxes: list[Box], edges: Mapping[str, list[str]]) -> Drawing:
    """Return *boxes* with places: each above all that it imports, near what it is joined to."""
    level: dict[str, int] = {}

    def level_of(name: str) -> int:
        if name not in level:
            level[name] = max((level_of(lower) + 1 for lower in edges[name]), default=0)
        return level[name]

    by_name = {box.name: box for box in boxes}
    rows: list[list[str]] = [[] for _ in range(max(map(level_of, by_name), default=0) + 1)]
    for name in sorted(by_name):
        rows[level[name]].append(name)
    width = {name: box.width for name, box in by_name.items()}
    chains = []
    joined: dict[str, list[str]] = {name: [] for name in by_name}
    for upper in sorted(edges):
        for lower in edges[upper]:
            chain = [upper]
            for number in range(level[upper] - 1, level[lower], -1):
                lane = f"{upper}>{lower}@{number}"
                rows[number].append(lane)
                width[lane] = _LANE_PX
                joined[lane] = []
                chain.append(lane)
            chain.append(lower)
            chains.append(chain)
            for source, other in itertools.pairwise(chain):
                joined[source].append(other)
                joined[other].append(source)
    middle = _middles(rows, width, joined)
    left = min(middle[name] - width[name] / 2 for name in middle)
    heights = [max((by_name[name].height for name in row if name in by_name), default=0) for row in rows]
    top: list[float] = [0.0] * len(rows)
    total = 0.0
    for number in range(len(rows) - 1, -1, -1):
        top[number] = total
        total += heights[number] + _ROW_GAP_PX
    for number, row in enumerate(rows):
        for name in row:
            if name in by_name:
                by_name[name].x = middle[name] - left - width[name] / 2
                by_name[name].y = top[number] + (heights[number] - by_name[name].height) / 2
    arrows = [_arrow(chain, chains, by_name, middle, left, top, heights, level) for chain in chains]
    right = max(middle[name] + width[name] / 2 for name in middle)
    return Drawing(boxes=boxes, arrows=arrows, width=right - left, height=total - _ROW_GAP_PX)


def _middles(
    rows: list[list[str]], width: Mapping[str, float], joined: Mapping[str, list[str]]
) -> dict[str, float]:
    """Order each row by barycentres, and return the middle of every box and lane."""
    place: dict[str, float] = {}

    def pack(row: list[str]) -> None:
        total = sum(width[name] + _BOX_GAP_PX for name in row)
        x = -total / 2
        for name in row:
            place[name] = x + width[name] / 2
            x += width[name] + _BOX_GAP_PX

    for row in rows:
        pack(row)
    row_of = {name: number for number, row in enumerate(rows) for name in row}

    def wanted(name: str, side: int) -> float:
        near = [place[other] for other in joined[name] if (row_of[other] - row_of[name]) * side > 0]
        return sum(near) / len(near) if near else place[name]

    for sweep in range(_SWEEPS):
        side = -1 if sweep % 2 == 0 else 1
        for row in rows if side < 0 else rows[::-1]:
            row.sort(key=lambda name: (round(wanted(name, side), 3), name))
            pack(row)
    for _ in range(_SWEEPS):
        for row in [*rows, *rows[::-1]]:
            _settle(row, place, width, joined)
    return place


def _settle(
    row: list[str],
    place: dict[str, float],
    width: Mapping[str, float],
    joined: Mapping[str, list[str]],
) -> None:
    """Move a row's boxes towards the middle of their neighbours, without changing their order."""
    goal = {
        name: sum(place[other] for other in joined[name]) / len(joined[name]) if joined[name] else place[name]
        for name in row
    }
    groups: list[tuple[float, float, list[tuple[str, float]]]] = []  # sum of goals, count, (name, offset)
    for name in row:
        weight = 3.0 if ">" in name else 1.0
        group = (goal[name] * weight, weight, [(name, 0.0)])
        while groups:
            before = groups[-1]
            last, last_offset = before[2][-1]
            start = before[0] / before[1] + last_offset + width[last] / 2 + _BOX_GAP_PX
            if start <= group[0] / group[1] - width[group[2][0][0]] / 2:
                break
            shift = last_offset + (width[last] + width[group[2][0][0]]) / 2 + _BOX_GAP_PX
            group = (
                before[0] + group[0] - shift * group[1],
                before[1] + group[1],
                before[2] + [(node, offset + shift) for node, offset in group[2]],
            )
            groups.pop()
        groups.append(group)
    for total, count, members in groups:
        for name, offset in members:
            place[name] = total / count + offset


def _arrow(
    chain: list[str],
    chains: list[list[str]],
    by_name: Mapping[str, Box],
    middle: Mapping[str, float],
    left: float,
    top: list[float],
    heights: list[float],
    level: Mapping[str, int],
) -> list[tuple[float, float]]:
    upper, lower = by_name[chain[0]], by_name[chain[-1]]
    out = sorted(
        (other_chain for other_chain in chains if other_chain[0] == chain[0]),
        key=lambda one: (middle[one[1]], one),
    )
    into = sorted(
        (other_chain for other_chain in chains if other_chain[-1] == chain[-1]),
        key=lambda one: (middle[one[-2]], one),
    )
    x = _port(upper, out.index(chain), len(out))
    number = level[chain[0]]
    points = [(x, upper.y + upper.height), (x, top[number] + heights[number])]
    for lane in chain[1:-1]:
        number = int(lane.rpartition("@")[2])
        x = middle[lane] - left
        points += [(x, top[number]), (x, top[number] + heights[number])]
    x = _port(lower, into.index(chain), len(into))
    return [*points, (x, top[level[chain[-1]]]), (x, lower.y)]


def _port(box: Box, number: int, count: int) -> float:
    spread = min(box.width - 2 * _PAD_PX, 22.0 * (count - 1))
    return box.x + box.width / 2 + (spread * (number / (count - 1) - 0.5) if count > 1 else 0.0)


def _svg(drawing: Drawing) -> str:
    width, height = drawing.width + 2 * _MARGIN_PX, drawing.height + 2 * _MARGIN_PX
    body = _shapes(drawing, _MARGIN_PX, _MARGIN_PX, "edge")
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
        f'viewBox="0 0 {width:.0f} {height:.0f}">'
    )
    marks = "".join(
        f'<marker id="{name}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
        f'orient="auto"><path d="M0 0 L8 4 L0 8 z" fill="{colour}"/></marker>'
        for name, colour in (("edge", "#8a8a8a"), ("inside", "#3c6ea5"))
    )
    return "\n".join(
        [
            head,
            "<title>The packages of RSE-PF and the imports between them</title>",
            f"<style>{_STYLE}</style>",
            f"<defs>{marks}</defs>",
            f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
            *body,
            "</svg>",
            "",
        ]
    )


def _shapes(drawing: Drawing, x: float, y: float, edge: str) -> list[str]:
    mark = "inside" if "inside" in edge else "edge"
    lines = [
        f'<path class="{edge}" marker-end="url(#{mark})" d="{_curve(points, x, y)}"/>'
        for points in drawing.arrows
    ]
    for box in sorted(drawing.boxes, key=lambda each: each.name):
        left, top = x + box.x, y + box.y
        lines.append(
            f'<rect class="box {box.kind}" rx="5" x="{left:.1f}" y="{top:.1f}" '
            f'width="{box.width:.1f}" height="{box.height:.1f}"/>'
        )
        has_title = not box.name.startswith(" ")
        if has_title:
            place = f'x="{left + _PAD_PX:.1f}" y="{top + 17:.1f}"'
            lines.append(f'<text class="title" {place}>{html.escape(box.name)}</text>')
        start = top + (_TITLE_PX if has_title else _PAD_PX) + 11
        lines += [
            f'<text x="{left + _PAD_PX:.1f}" y="{start + number * _LINE_PX:.1f}">{html.escape(line)}</text>'
            for number, line in enumerate(box.lines)
        ]
        if box.inside is not None:
            lines += _shapes(box.inside, left + _PAD_PX, top + _TITLE_PX + _PAD_PX, "edge inside")
    return lines


def _curve(points: list[tuple[float, float]], x: float, y: float) -> str:
    (first_x, first_y), *rest = points
    path = f"M{x + first_x:.1f} {y + first_y:.1f}"
    last_x, last_y = first_x, first_y
    for number, (to_x, to_y) in enumerate(rest):
        if number % 2 == 0:  # straight within a row
            path += f" L{x + to_x:.1f} {y + to_y:.1f}"
        else:
            bend = (to_y - last_y) / 2
            path += (
                f" C{x + last_x:.1f} {y + last_y + bend:.1f} {x + to_x:.1f} {y + to_y - bend:.1f} "
                f"{x + to_x:.1f} {y + to_y:.1f}"
            )
        last_x, last_y = to_x, to_y
    return path


def main() -> None:
    """Write the picture of this checkout."""
    repository = Path(__file__).resolve().parents[1]
    target = repository / "docs" / "images" / "architecture.svg"
    target.write_text(draw(read_sources(repository)), encoding="utf-8")


if __name__ == "__main__":
    main()
