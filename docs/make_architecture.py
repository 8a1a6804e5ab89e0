"""Draw the rooms of the code and their imports: ``python docs/make_architecture.py``.

Reads every import with `ast` and writes ``docs/images/architecture.svg`` and the table in ``docs/architecture.md``. A
room is a folder directly under ``slam``, or one of the packages ``frontends`` and ``backends``; the modules in
``slam`` itself make up the room ``slam``. Imports inside functions and for type checking count as well. The same code
gives the same bytes. ``slam/__main__.py`` is the command line and counts to ``commands``.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PICTURE = Path("docs/images/architecture.svg")
PAGE = Path("docs/architecture.md")
START, END = "<!-- rooms: written by docs/make_architecture.py -->", "<!-- end of rooms -->"
CORE = "slam"  # drawn as a bar beside the layers: nearly every room uses its data types
PACKAGES = ("slam", "frontends", "backends")

Edge = tuple[str, str]
Node = tuple[int, str]  # layer, and a room or the name of a bend in an arrow


# --- Reading the code ------------------------------------------------------------------------------------------------


def rooms(root: Path) -> dict[str, list[Path]]:
    """The rooms by name, with their modules."""
    found: dict[str, list[Path]] = {CORE: sorted((root / CORE).glob("*.py"))}
    folders = [*(root / CORE).iterdir(), *(root / name for name in PACKAGES[1:])]
    for folder in sorted(folders):
        if folder.is_dir() and any(folder.glob("*.py")):
            found[folder.name] = sorted(folder.rglob("*.py"))
    start = root / CORE / "__main__.py"
    if "commands" in found and start in found[CORE]:
        found[CORE].remove(start)
        found["commands"].append(start)
    return found


def imports(root: Path) -> Counter[Edge]:
    """How many names each room imports from each other room."""
    known = rooms(root)
    count: Counter[Edge] = Counter()
    for room, files in known.items():
        for file in files:
            for name in imported(file, root):
                target = room_of(name, known)
                if target is not None and target != room:
                    count[room, target] += 1
    return count


def imported(file: Path, root: Path) -> Iterable[str]:
    """Full names of everything that a module imports."""
    package = file.relative_to(root).parts[:-1]
    for up, name in import_statements(file.read_text(encoding="utf-8")):
        yield ".".join([*package[: len(package) - up + 1], name]) if up else name


@cache
def import_statements(text: str) -> tuple[tuple[int, str], ...]:
    """Imported names in the text of a module, each with the number of leading dots of a relative import."""
    found: list[tuple[int, str]] = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [(0, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = f"{node.module}." if node.module else ""
            found += [(node.level, f"{start}{alias.name}") for alias in node.names]
    return tuple(found)


def room_of(name: str, known: Iterable[str]) -> str | None:
    """The room of a full name such as ``slam.geometry.se3.Array``; None where it belongs to another package."""
    package, _, rest = name.partition(".")
    if package not in PACKAGES:
        return None
    inner = rest.partition(".")[0]
    return inner if package == CORE and inner in known else package


def duty(files: Sequence[Path], room: str) -> str:
    """First line of the docstring of a room's ``__init__``."""
    init = next((f for f in files if f.name == "__init__.py" and f.parent.name == room), None)
    text = ast.get_docstring(ast.parse(init.read_text(encoding="utf-8"))) if init is not None else None
    return text.splitlines()[0].replace("|", "\\|") if text else "–"


# --- Layers ----------------------------------------------------------------------------------------------------------


def reachable(start: str, edges: Iterable[Edge]) -> set[str]:
    """Everything that follows from a room along the edges."""
    edges, found, todo = set(edges), set[str](), [start]
    while todo:
        at = todo.pop()
        new = {b for a, b in edges if a == at} - found
        found |= new
        todo += sorted(new)
    return found


def reduced(edges: set[Edge]) -> set[Edge]:
    """The edges without those that a chain of others implies; those of a circle all stay."""
    kept = set(edges)
    for edge in sorted(edges):
        a, b = edge
        if a not in reachable(b, edges) and b in reachable(a, kept - {edge}):
            kept.discard(edge)
    return kept


def layers(names: Sequence[str], edges: set[Edge]) -> dict[str, int]:
    """Layer of each room, 0 at the bottom; a room stands above all that it imports, rooms in a circle side by side."""
    reach = {name: reachable(name, edges) for name in names}
    level: dict[str, int] = {}
    for name in sorted(names, key=lambda n: (len(reach[n] | {n}), n)):
        below = [level[b] + 1 for b in reach[name] if name not in reach[b] and b in level]
        level[name] = max(below, default=0)
    for name in names:  # the rooms of a circle share the highest of their layers
        level[name] = max([level[name], *(level[b] for b in reach[name] if name in reach[b])])
    return level


def chains(edges: set[Edge], level: dict[str, int]) -> list[list[Node]]:
    """Each arrow as the nodes that it passes, from the top: a bend in every layer between its ends."""
    result = []
    for a, b in sorted(edges):
        if level[a] > level[b]:
            bends = [(k, f"{a}>{b}") for k in range(level[a] - 1, level[b], -1)]
            result.append([(level[a], a), *bends, (level[b], b)])
    return result


def crossings(rows: list[list[Node]], links: set[tuple[Node, Node]]) -> tuple[int, int]:
    """How many pairs of arrows cross, and how far the arrows go sideways; those of a circle count most."""
    at = {node: (i - (len(row) - 1) / 2) for row in rows for i, node in enumerate(row)}
    count = 0
    ordered = sorted(links)
    for i, (a, b) in enumerate(ordered):
        for c, d in ordered[i + 1 :]:
            if a[0] == c[0] and b[0] == d[0] and (at[a] - at[c]) * (at[b] - at[d]) < 0:
                count += 1
    return count, int(2 * sum(abs(at[a] - at[b]) * (100 if a[0] == b[0] else 1) for a, b in links))


def arranged(nodes: set[Node], links: set[tuple[Node, Node]]) -> list[list[Node]]:
    """Rows from the bottom, ordered so that no exchange of two nodes of a row leaves fewer crossings."""
    rows = [sorted(n for n in nodes if n[0] == k) for k in range(max(n[0] for n in nodes) + 1)]
    best, improved = crossings(rows, links), True
    while improved:
        improved = False
        for row in rows:
            for i in range(len(row)):
                for j in range(i):
                    row[i], row[j] = row[j], row[i]
                    now = crossings(rows, links)
                    if now < best:
                        best, improved = now, True
                    else:
                        row[i], row[j] = row[j], row[i]
    return rows


# --- Drawing ---------------------------------------------------------------------------------------------------------

WIDTH, HEIGHT, GAP, STEP = 118.0, 40.0, 22.0, 96.0  # of a box; between boxes; from layer to layer [px]
BAR, MARGIN = 140.0, 24.0  # width of the bar; around everything [px]
INK, LINE, FILL, MARK, WRONG = "#222222", "#607d8b", "#eceff1", "#3f51b5", "#d32f2f"


@dataclass
class Placed:
    """A node's centre [px] and half its width."""

    x: float
    y: float
    half: float
    wide: bool = False  # alone in its layer: as wide as the drawing


def spread(wanted: Sequence[float], least: Sequence[float]) -> list[float]:
    """Places in order that are at least `least` apart, and nearest to those wanted (pool adjacent violators)."""
    offsets = [sum(least[:i]) for i in range(len(wanted))]
    pools: list[tuple[float, int]] = []
    for value in (w - o for w, o in zip(wanted, offsets)):
        pools.append((value, 1))
        while len(pools) > 1 and pools[-2][0] > pools[-1][0]:
            (a, n), (b, m) = pools[-2:]
            pools[-2:] = [((a * n + b * m) / (n + m), n + m)]
    flat = [value for value, n in pools for _ in range(n)]
    return [v + o for v, o in zip(flat, offsets)]


def places(rows: list[list[Node]], links: set[tuple[Node, Node]]) -> dict[Node, Placed]:
    """Where each node is drawn: each near the middle of its neighbours, without overlap."""
    half = {n: WIDTH / 2 if ">" not in n[1] else 4.0 for row in rows for n in row}
    apart = [[half[a] + half[b] + GAP for a, b in pairwise(row)] for row in rows]
    x = {n: p for row, d in zip(rows, apart) for n, p in zip(row, spread([0.0] * len(row), d))}
    near: dict[Node, list[Node]] = {n: [] for n in x}
    for a, b in sorted(links):
        near[a].append(b)
        near[b].append(a)
    for _ in range(50):
        for row, d in zip(rows, apart):
            wanted = [sum(x[m] for m in near[n]) / len(near[n]) if near[n] else x[n] for n in row]
            x |= dict(zip(row, spread(wanted, d)))
    left = min(x[n] - half[n] for n in x) - (2 * MARGIN + BAR + GAP)
    top = len(rows) - 1
    y = {n: MARGIN + HEIGHT / 2 + STEP * (top - n[0]) for n in x}
    placed = {n: Placed(x[n] - left, y[n], half[n]) for n in x}
    first, last = min(p.x - p.half for p in placed.values()), max(p.x + p.half for p in placed.values())
    for row in rows:
        if len(row) == 1:
            placed[row[0]] = Placed((first + last) / 2, y[row[0]], (last - first) / 2, wide=True)
    return placed


def curve(points: Sequence[tuple[float, float]]) -> str:
    """A path through points, upright in each."""
    text = f"M{points[0][0]:.1f} {points[0][1]:.1f}"
    for (x0, y0), (x1, y1) in pairwise(points):
        bend = (y1 - y0) / 2
        text += f" C{x0:.1f} {y0 + bend:.1f} {x1:.1f} {y1 - bend:.1f} {x1:.1f} {y1:.1f}"
    return text


def ports(chain_list: list[list[Node]], at: dict[Node, Placed]) -> dict[tuple[int, int], float]:
    """Where each arrow leaves (end 0) and enters (end 1) its rooms: x by (arrow, end).

    Side by side in the order of the other ends; on a room as wide as the drawing straight above or below them.
    """
    ends: dict[tuple[Node, int], list[tuple[float, int]]] = {}
    for k, chain in enumerate(chain_list):
        ends.setdefault((chain[0], 0), []).append((at[chain[1]].x, k))
        ends.setdefault((chain[-1], 1), []).append((at[chain[-2]].x, k))
    result = {}
    for (node, end), others in sorted(ends.items(), key=lambda item: (at[item[0][0]].wide, item[0])):
        step = 2 * (at[node].half - 12) / max(len(others), 2)
        first = at[node].x - step * (len(others) - 1) / 2
        for i, (x, k) in enumerate(sorted(others)):
            beside = x if len(chain_list[k]) > 2 else result.get((k, 1 - end), x)
            result[k, end] = beside if at[node].wide else first + step * i
    return result


def box(place: Placed, name: str, edges: set[Edge]) -> list[str]:
    """A room, and on its left edge whether it imports from the core or the core from it."""
    left, top = place.x - place.half, place.y - HEIGHT / 2
    lines = [
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{2 * place.half:.1f}" height="{HEIGHT:.1f}" rx="6" '
        f'fill="{FILL}" stroke="{LINE}"/>',
        f'<text x="{place.x:.1f}" y="{place.y + 5:.1f}" text-anchor="middle">{escape(name)}</text>',
    ]
    uses, used = (name, CORE) in edges, (CORE, name) in edges
    if uses:
        lines.append(triangle(left - 3, place.y + (8 if used else 0), -1))
    if used:
        lines.append(triangle(left - 3, place.y - (8 if uses else 0), 1))
    return lines


def triangle(x: float, y: float, way: int) -> str:
    """A mark whose middle is (x, y): points left (-1) to the bar, or right (+1) to the room."""
    a, b = x - 5 * way, x + 5 * way
    return f'<path d="M{a:.1f} {y - 5:.1f} L{a:.1f} {y + 5:.1f} L{b:.1f} {y:.1f} Z" fill="{MARK}"/>'


def bar(height: float, groups: dict[str, list[str]], level: float) -> list[str]:
    """The core beside the layers, with its modules."""
    middle = MARGIN + BAR / 2
    lines = [
        f'<rect x="{MARGIN:.1f}" y="{level:.1f}" width="{BAR:.1f}" height="{height:.1f}" rx="6" fill="#e8eaf6" '
        f'stroke="{MARK}"/>',
        f'<text x="{middle:.1f}" y="{level + 26:.1f}" text-anchor="middle">{CORE}</text>',
    ]
    y = level + 30
    for title, modules in groups.items():
        y += 28
        lines.append(f'<text x="{middle:.1f}" y="{y:.1f}" text-anchor="middle" class="s" fill="{MARK}">{title}</text>')
        for name in modules:
            y += 20
            lines.append(f'<text x="{middle:.1f}" y="{y:.1f}" text-anchor="middle" class="s">{name}</text>')
    return lines


def core_modules(root: Path) -> dict[str, list[str]]:
    """The core's modules: those that use the rooms, and those that the rooms share."""
    known = rooms(root)
    groups: dict[str, list[str]] = {"use the rooms:": [], "shared by all rooms:": []}
    for file in known[CORE]:
        used = {room_of(name, known) for name in imported(file, root)} - {None, CORE, "geometry", "runtime"}
        if file.stem != "__init__":
            groups["use the rooms:" if used else "shared by all rooms:"].append(file.stem)
    return groups


def legend(y: float, circle: bool) -> tuple[list[str], float]:
    """What the marks mean, and where the line ends [px]."""
    x = 2 * MARGIN + BAR + GAP
    texts = [
        ("imports from (not drawn where a chain of arrows leads there)", LINE),
        (f"imports from {CORE}", -1),
        (f"is imported by {CORE}", 1),
    ]
    if circle:
        texts.append(("they import each other", WRONG))
    lines = []
    for text, mark in texts:
        if isinstance(mark, str):
            lines.append(arrow(f"M{x:.1f} {y:.1f} L{x + 22:.1f} {y:.1f}", mark))
        else:
            lines.append(triangle(x + 12, y, mark))
        lines.append(f'<text x="{x + 30:.1f}" y="{y + 4:.1f}" class="s">{text}</text>')
        x += 48 + 6.2 * len(text)
    return lines, x - MARGIN


def arrow(path: str, colour: str) -> str:
    """A path with a head at its end."""
    head = "wrong" if colour == WRONG else "head"
    return f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.4" marker-end="url(#{head})"/>'


def circle_arrows(edges: set[Edge], level: dict[str, int], at: dict[Node, Placed]) -> list[str]:
    """Arrows between rooms of the same layer, above or below them: they make a circle, which should not be."""
    lines = []
    for a, b in sorted(edges):
        if level[a] == level[b]:
            p, q = at[level[a], a], at[level[b], b]
            way = 1 if q.x > p.x else -1
            x0, x1, y = p.x + way * (p.half - 14), q.x - way * (q.half - 14), p.y + way * HEIGHT / 2
            bend = y + way * (20 + abs(x1 - x0) / 10)
            lines.append(arrow(f"M{x0:.1f} {y:.1f} Q{(x0 + x1) / 2:.1f} {bend:.1f} {x1:.1f} {y + 2 * way:.1f}", WRONG))
    return lines


def picture(root: Path) -> str:
    """The drawing as SVG."""
    edges = set(imports(root))
    names = [name for name in rooms(root) if name != CORE]
    between = reduced({e for e in edges if CORE not in e})
    level = layers(names, between)
    chain_list = chains(between, level)
    links = {link for chain in chain_list for link in pairwise(chain)}
    links |= {((level[a], a), (level[b], b)) for a, b in between if level[a] == level[b]}
    rows = arranged({(level[n], n) for n in names} | {n for chain in chain_list for n in chain}, links)
    at = places(rows, links)
    port = ports(chain_list, at)
    groups = core_modules(root)
    tall = max(STEP * (len(rows) - 1) + HEIGHT, 110 + 20 * sum(map(len, groups.values())))
    parts = bar(tall, groups, MARGIN)
    for k, chain in enumerate(chain_list):
        bends = [(at[n].x, at[n].y + dy) for n in chain[1:-1] for dy in (-HEIGHT / 2, HEIGHT / 2)]
        start = (port[k, 0], at[chain[0]].y + HEIGHT / 2)
        end = (port[k, 1], at[chain[-1]].y - HEIGHT / 2 - 2)
        parts.append(arrow(curve([start, *bends, end]), LINE))
    circle = circle_arrows(between, level, at)
    parts += circle
    for row in reversed(rows):
        for node in row:
            if ">" not in node[1]:
                parts += box(at[node], node[1], edges)
    line, end = legend(MARGIN + tall + 34, bool(circle))
    width = max([end, *(p.x + p.half for p in at.values())]) + MARGIN
    return framed([*parts, *line], width, tall + 2 * MARGIN + 44)


def framed(parts: Sequence[str], width: float, height: float) -> str:
    """The whole file."""
    heads = [
        f'<marker id="{name}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        f'<path d="M0 0 L8 4 L0 8 Z" fill="{colour}"/></marker>'
        for name, colour in (("head", LINE), ("wrong", WRONG))
    ]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" font-size="15" '
            f'font-family="sans-serif" fill="{INK}">',
            "<style>.s { font-size: 12px; }</style>",
            f"<defs>{''.join(heads)}</defs>",
            f'<rect width="{width:.0f}" height="{height:.0f}" fill="white"/>',
            *parts,
            "</svg>",
            "",
        ]
    )


# --- The table -------------------------------------------------------------------------------------------------------


def table(root: Path) -> str:
    """Room, duty and imports as a Markdown table; the core first, then the layers from the top."""
    found, edges = rooms(root), imports(root)
    names = [name for name in found if name != CORE]
    level = layers(names, {e for e in edges if CORE not in e})
    order = [CORE, *sorted(names, key=lambda n: (-level[n], n))]
    lines = ["| room | its duty | imports from |", "| --- | --- | --- |"]
    for room in order:
        targets = ", ".join(f"`{other}`" for other in order if (room, other) in edges) or "–"
        lines.append(f"| `{room}` | {duty(found[room], room)} | {targets} |")
    return "\n".join(lines)


def page(text: str, root: Path) -> str:
    """The page with its table rebuilt."""
    before, start, rest = text.partition(START)
    _, end, after = rest.partition(END)
    if not (start and end):
        raise SystemExit(f"{PAGE}: no place for the table; it stands between {START!r} and {END!r}")
    return f"{before}{start}\n\n{table(root)}\n\n{end}{after}"


def main() -> None:
    """Write picture and table."""
    (ROOT / PICTURE).write_text(picture(ROOT), encoding="utf-8")
    path = ROOT / PAGE
    path.write_text(page(path.read_text(encoding="utf-8"), ROOT), encoding="utf-8")


if __name__ == "__main__":
    main()
